"""The rays of a log, in which four rays to the corners replace the one ray of a fiducial."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.types import Association, Rays
from objslam.graph.tags.placement import placed
from objslam.graph.tags.shapes import CLOCKWISE, COUNTER_CLOCKWISE, goes_clockwise
from objslam.graph.tags.square_fit import Corners, independent


@dataclass(frozen=True)
class TagCorners:
    """The T fiducials among N objects. The four corners of each fiducial become landmarks, M = N + 3 T landmarks in all.

    The rays to corners replace the rays to fiducials. source: (n,) the original ray of each ray, non-decreasing. corner:
    (n,) the corner of each ray, 0 to 3, -1 for a ray that is not to a corner. association: the landmark of each ray. The
    first corner of a fiducial has the number of its object. count: N. object: (T,) the object of each fiducial. landmarks:
    (T, 4) its corners. shape: (T, 4, 3) the corners at side 1. side: (T,) m, NaN if unknown. first: (V,) the ray to the
    first corner in each view of a fiducial. The rays to the other corners follow it. tag: (V,) the fiducial of each view.
    """

    source: Ints
    corner: Ints
    association: Association
    count: int
    object: Ints
    landmarks: Ints
    shape: Floats
    side: Floats
    first: Ints
    tag: Ints

    @classmethod
    def of(cls, rays: Rays, association: Association, settings: Settings) -> Self | None:
        """Return the fiducials among the objects of rays (R,), None if there are none.

        A fiducial is an object with corners in any of its rays. Its rays without corners belong to no landmark.
        """
        if rays.corners is None or rays.corner_sigma is None:
            return None
        owner = association.object
        squares = np.isfinite(rays.corner_sigma) & (owner >= 0)
        if not squares.any():
            return None
        object_, tag_of_view = np.unique(owner[squares], return_inverse=True)
        of_tag = np.isin(owner, object_)
        source = np.repeat(np.arange(len(rays)), np.where(squares, 4, 1))
        first = np.flatnonzero(squares[source])[::4]
        corner = np.full(len(source), -1)
        for c in range(4):
            corner[first + c] = c
        landmarks = association.count + 3 * np.arange(len(object_))[:, None] + np.arange(-1, 3)
        landmarks[:, 0] = object_
        landmark = np.where(of_tag & ~squares, -1, owner)[source]
        for c in range(4):
            landmark[first + c] = landmarks[tag_of_view, c]
        label = np.concatenate([association.label, np.repeat(association.label[object_], 3)])
        turns = np.where(goes_clockwise(rays.corners[squares]), 1, -1)
        clockwise = np.bincount(tag_of_view, turns) > 0
        return cls(
            source=source,
            corner=corner,
            association=Association(landmark, label),
            count=association.count,
            object=object_,
            landmarks=landmarks,
            shape=np.where(clockwise[:, None, None], CLOCKWISE, COUNTER_CLOCKWISE),
            side=_sides(rays.label_names, association.label[object_], settings),
            first=first,
            tag=tag_of_view,
        )

    def sized(self, names: Sequence[str], settings: Settings) -> Self:
        """Return the fiducials with the sizes of the settings. names: the names of the labels."""
        return replace(self, side=_sides(names, self.association.label[self.object], settings))

    def rays(self, rays: Rays) -> Rays:
        """Return the rays (n,) in which rays to corners replace the rays to fiducials. rays: (R,) the original rays. A ray
        to a corner has the noise of a corner, and no range."""
        assert rays.corners is not None
        assert rays.corner_sigma is not None
        new = rays.take(self.source)
        at = self.corner >= 0
        source, corner = self.source[at], self.corner[at]
        direction, sigma, range_ = new.direction.copy(), new.sigma.copy(), new.range.copy()
        direction[at], sigma[at], range_[at] = rays.corners[source, corner], rays.corner_sigma[source], np.nan
        return replace(new, direction=direction, sigma=sigma, range=range_, corners=None, corner_sigma=None)

    def seen(self, rays: Rays, map_T_camera: Floats) -> Corners:
        """Return the corners in all views of fiducials, at the camera poses (K, 4, 4). rays: (n,) the new rays."""
        views = (self.first[:, None] + np.arange(4)).ravel()
        origin, direction = rays.take(views).in_map(map_T_camera)
        return Corners(
            self.tag, origin[::4], direction.reshape(-1, 4, 3), rays.sigma[self.first], independent(len(self.first))
        )

    def placed(self, rays: Rays, map_T_camera: Floats, positions: Floats) -> Floats:
        """Return the positions (M, 3) m of landmarks with each fiducial at its best pose, as `placement.placed` does."""
        return placed(self.seen(rays, map_T_camera), self.shape, self.side, self.landmarks, positions)

    def measured_motions(self, rays: Rays, count: int) -> Bools:
        """Return for each motion (count - 1,) between consecutive poses whether both poses see the same fiducial."""
        seen = np.unique(rays.keyframe[self.first] * len(self.object) + self.tag)
        again = np.intersect1d(seen + len(self.object), seen) // len(self.object) - 1
        return np.isin(np.arange(count - 1), again)

    def tied(self, landmarks: Ints) -> Ints:
        """Return the fiducials (t,) whose four corners are all among the landmarks (m,)."""
        return np.flatnonzero(np.isin(self.landmarks, landmarks).all(axis=1))

    def of_objects(self, values: Floats) -> Floats:
        """Return the values of the objects (N, ...) from values of the landmarks (M, ...). A fiducial has the mean value of
        its corners."""
        found = values[: self.count].copy()
        found[self.object] = values[self.landmarks].mean(axis=1)
        return found

    def is_corner(self) -> Bools:
        """Return which landmarks (M,) are corners of fiducials."""
        return np.isin(np.arange(self.association.count), self.landmarks)

    def object_of_landmark(self) -> Ints:
        """Return the object (M,) of each landmark. The object of a corner is its fiducial."""
        objects = np.arange(self.association.count)
        objects[self.landmarks] = self.object[:, None]
        return objects


def _sides(names: Sequence[str], labels: Ints, settings: Settings) -> Floats:
    """Return the sides (T,), m, of fiducials with labels (T,), NaN if unknown."""
    sides = [settings.tags.size_of(names[i]) for i in labels.tolist()]
    return np.array([np.nan if side is None else side for side in sides])
