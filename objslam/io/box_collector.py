"""Collect boxes image by image, and check them together at the end."""

from dataclasses import dataclass, field

import numpy as np

from objslam.core.appearance.features import MAX_FEATURES, unit_vectors
from objslam.core.arrays import Array, Bools, Floats, Floats32
from objslam.core.diagnostics import Ledger
from objslam.core.types import Detections, label_table
from objslam.core.validity import box_rules, is_name, valid_corners, valid_depths
from objslam.io.text import drop_rows, in_order

UNUSABLE_FEATURES = "features of a box that are zero, not finite, or of another length than most (the box stays)"
"""The reason in the ledger for each box whose appearance vector is left out."""


@dataclass
class BoxCollector:
    """Camera frames (images) and their boxes. An unknown depth is NaN, and an unknown track id is -1.

    The keys of `corners` (of fiducials) and `features` (appearance vectors) are indices of boxes. Each frame and box has a
    place, such as file:line. The ledger shows the place if the frame or box is dropped.
    """

    stamps: list[float] = field(default_factory=list)
    frame_places: list[str] = field(default_factory=list)
    frame: list[int] = field(default_factory=list)
    boxes: list[list[float]] = field(default_factory=list)
    labels: list[str] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    depths: list[float] = field(default_factory=list)
    track_ids: list[int] = field(default_factory=list)
    box_places: list[str] = field(default_factory=list)
    corners: dict[int, list[list[float]]] = field(default_factory=dict)
    features: dict[int, Array] = field(default_factory=dict)

    def add_frame(self, stamp: float, place: str) -> None:
        """Start a frame at timestamp `stamp` (s). The boxes that are added next belong to this frame."""
        self.stamps.append(stamp)
        self.frame_places.append(place)

    def add_box(
        self,
        box: list[float],
        label: str,
        score: float,
        place: str,
        depth: float = np.nan,
        track_id: int = -1,
        corners: list[list[float]] | None = None,
        features: list[float] | None = None,
    ) -> None:
        """Add a box x1, y1, x2, y2 (px) to the last frame. depth: the depth z along the optical axis, m.

        corners: the four corners x, y (px) of a square fiducial. features: the appearance vector of the box, of any length.
        """
        if features is not None:
            self.features[len(self.boxes)] = np.array(features)
        if corners is not None:
            self.corners[len(self.boxes)] = corners
        self.frame.append(len(self.stamps) - 1)
        self.boxes.append(box)
        self.labels.append(label)
        self.scores.append(score)
        self.depths.append(depth)
        self.track_ids.append(track_id)
        self.box_places.append(place)

    def checked(self, ledger: Ledger) -> Detections:
        """Return the valid detections. Frames out of time order and invalid boxes are dropped and counted in the ledger.

        Some values of a valid box become unknown, and are counted. They are a depth that is too large or not above zero,
        corners that form no square, and an appearance vector for the reasons of `UNUSABLE_FEATURES`.
        """
        stamps = np.array(self.stamps, dtype=np.float64)
        forward = in_order(stamps)
        drop_rows("detection frame with a stamp that repeats or goes back", ~forward, self.frame_places, ledger)
        frame = np.array(self.frame, dtype=np.int64)
        boxes = np.array(self.boxes, dtype=np.float64).reshape(-1, 4)
        scores = np.array(self.scores, dtype=np.float64)
        names = np.array([is_name(label) for label in self.labels], dtype=bool)
        good = forward[frame]
        for fine, reason in box_rules(boxes, scores, names):
            drop_rows(reason, good & ~fine, self.box_places, ledger)
            good &= fine
        depths = np.array(self.depths, dtype=np.float64)
        wrong = ~np.isnan(depths) & ~valid_depths(depths)
        drop_rows(
            "depth of a box that is not above zero or too large (taken as unknown)", good & wrong, self.box_places, ledger
        )
        depths[wrong] = np.nan
        corners = self._valid_corners(good, ledger) if self.corners else None
        features = self._valid_features(good, ledger) if self.features else None
        label_names, label = label_table([self.labels[i] for i in np.flatnonzero(good)])
        return Detections(
            frame_stamps=stamps[forward],
            frame=(np.cumsum(forward) - 1)[frame[good]],
            boxes=boxes[good],
            label=label,
            scores=scores[good],
            depths=depths[good],
            track_ids=np.array(self.track_ids, dtype=np.int64)[good],
            label_names=label_names,
            corners=None if corners is None else corners[good],
            features=None if features is None else features[good],
        )

    def _valid_corners(self, good: Bools, ledger: Ledger) -> Floats:
        """Return the corners (M, 4, 2), px, of all M boxes. Unknown and invalid corners are NaN.

        good: (M,) the boxes whose invalid corners are counted.
        """
        corners = np.full((len(self.boxes), 4, 2), np.nan)
        corners[list(self.corners)] = np.array(list(self.corners.values()), dtype=np.float64)
        wrong = np.isin(np.arange(len(corners)), list(self.corners)) & ~valid_corners(corners)
        reason = "corners that do not form a square (taken as unknown)"
        drop_rows(reason, good & wrong, self.box_places, ledger)
        corners[wrong] = np.nan
        return corners

    def _valid_features(self, good: Bools, ledger: Ledger) -> Floats32 | None:
        """Return the unit appearance vectors (M, D) of all boxes, or None if no vector is valid.

        A box without a valid vector has NaN. D is the most frequent length of the vectors. If two lengths are equally
        frequent, D is the one that occurs first. Vectors of other lengths are invalid.
        """
        boxes = np.array(list(self.features), dtype=np.int64)
        lengths = np.array([vector.size for vector in self.features.values()])
        known, first, count = np.unique(lengths, return_index=True, return_counts=True)
        possible = (known > 0) & (known <= MAX_FEATURES)
        length = int(known[np.lexsort((first, -count, ~possible))[0]]) if possible.any() else 1
        mine = lengths == length
        features = np.full((len(self.boxes), length), np.nan, dtype=np.float32)
        scaled = np.zeros(len(self.boxes), dtype=bool)
        if mine.any():
            vectors = np.stack([vector for vector, fits in zip(self.features.values(), mine, strict=True) if fits])
            features[boxes[mine]], scaled[boxes[mine]] = unit_vectors(vectors)
        wrong = np.isin(np.arange(len(scaled)), boxes) & ~scaled
        drop_rows(UNUSABLE_FEATURES, good & wrong, self.box_places, ledger)
        return features if scaled.any() else None
