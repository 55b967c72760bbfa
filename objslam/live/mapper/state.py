"""A live map as data: what is known at a moment of keyframes, bearings, landmarks and tracks.

The modules beside change it; `mapper` says in which order.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from objslam.association.observations import Observations
from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera
from objslam.core.types import Keyframes
from objslam.graph.factors.rays import Bearings
from objslam.graph.isam2 import IncrementalGraph
from objslam.live.counters import Counters
from objslam.live.mapper.course import Course
from objslam.live.mapper.landmark_table import LandmarkTable
from objslam.live.mapper.tables import KeyframeTable, RayTable
from objslam.live.mapper.tracks import Track

_RELINEARISATIONS = 3
"""Updates that look for variables that moved, after a loop has closed; more settle the map further, and take time."""


@dataclass
class NextIds:
    """The number that the next one of each kind gets; no number is given twice."""

    keyframe: int = 0
    ray: int = 0
    landmark: int = 0
    track: int = 0


@dataclass
class LocalizationState:
    """What the localisation has said of the map.

    received: poses that came. pending: ids of the keyframes that it may still get to. planar: whether all poses that
    keyframes got of it keep one height, roll and pitch.
    """

    received: int = 0
    pending: list[int] = field(default_factory=list)
    planar: bool = True


@dataclass
class PairEvidence:
    """What tells whether two landmarks of one label are one; by their ids, the smaller first.

    together: frames that showed both. apart: a fifth of the frames that showed the one seen less, when the two were last
    found to be apart.
    """

    together: dict[tuple[int, int], int] = field(default_factory=dict)
    apart: dict[tuple[int, int], int] = field(default_factory=dict)

    def forget(self, ids: set[int]) -> None:
        """Landmarks that are gone."""
        self.together = {pair: n for pair, n in self.together.items() if not ids & set(pair)}
        self.apart = {pair: n for pair, n in self.apart.items() if not ids & set(pair)}


@dataclass
class MaintenanceSchedule:
    """When the seldom duties were last done.

    solved, culled: keyframes that there had been when the whole graph was last solved, and keyframes were last left out.
    relinearisations: that are still to come sooner than usual, since a loop moved the estimate far. compared: ids of the
    landmarks seen lately, and how many were long unseen, when a loop was last looked for; None before.
    """

    solved: int = 0
    culled: int = 0
    relinearisations: int = 0
    compared: tuple[tuple[int, ...], int] | None = None

    def relinearise_soon(self) -> None:
        """The estimate has moved far: the next few turns look for variables that moved."""
        self.relinearisations = _RELINEARISATIONS


@dataclass
class MapState:
    """The map of a session, with all that the next message needs to go on from it.

    Attributes:
        graph: the factors, and the estimate of keyframes and landmarks.
        course: the paths that place frames.
        cameras, labels: by their numbers.
        keyframes, rays, landmarks: tables; rays.owner tells who is whose.
        tracks: things seen that are no landmarks yet, in the order in which they were first seen.
        by_label: whether every label is one object so far.
        pairs: evidence for and against two landmarks being one.
        landmark_of_track: id of the landmark that each track of the detector was given last.
        novelty: share of boxes that showed nothing known, averaged over about the last 50 frames with weights that fade.
        pose_covariance: (6, 6) of the newest keyframe's pose as it was predicted, in its camera's frame, rad and m, rotation
            first; NaN where the odometry does not tell.
        frames: frames of each camera that the course placed.
        localization, schedule, next_id: as their types say.
        rng: for what is drawn at random, seeded by the settings.
    """

    settings: Settings
    counters: Counters
    graph: IncrementalGraph
    course: Course
    by_label: bool
    rng: np.random.Generator
    cameras: list[Camera] = field(default_factory=list)
    labels: list[str] = field(default_factory=list)
    keyframes: KeyframeTable = field(default_factory=KeyframeTable)
    rays: RayTable = field(default_factory=RayTable)
    landmarks: LandmarkTable = field(default_factory=LandmarkTable)
    tracks: list[Track] = field(default_factory=list)
    pairs: PairEvidence = field(default_factory=PairEvidence)
    landmark_of_track: dict[int, int] = field(default_factory=dict)
    novelty: float = 1.0
    pose_covariance: Floats = field(default_factory=lambda: np.full((6, 6), np.nan))
    frames: dict[int, int] = field(default_factory=dict)
    localization: LocalizationState = field(default_factory=LocalizationState)
    schedule: MaintenanceSchedule = field(default_factory=MaintenanceSchedule)
    next_id: NextIds = field(default_factory=NextIds)

    @classmethod
    def new(cls, settings: Settings, counters: Counters) -> MapState:
        """An empty map."""
        by_label, rng = settings.association.method != "global", np.random.default_rng(settings.seed)
        return cls(settings, counters, IncrementalGraph(settings), Course(settings), by_label, rng)

    def newest_before(self, stamp: float) -> int | None:
        """The row of the newest keyframe that is not newer than a stamp."""
        stamps = self.keyframes.stamp
        if len(stamps) and stamps[-1] <= stamp:
            return len(stamps) - 1
        older = np.flatnonzero(stamps <= stamp)
        return int(older[stamps[older].argmax()]) if len(older) else None

    def in_order(self) -> Ints:
        """The ids of the keyframes (K,) by their stamps."""
        return np.asarray(self.keyframes.id[np.argsort(self.keyframes.stamp, kind="stable")])

    def keyframe_arrays(self, rows: Ints) -> Keyframes:
        """The keyframes at these rows (n,), in the type that the offline estimation uses."""
        k = self.keyframes
        localized, reckoned = bool(k.localized.any()), bool(k.by_odometry[rows].any())
        return Keyframes(
            stamps=k.stamp[rows],
            camera=k.camera[rows],
            frame=k.frame[rows],
            base_T_camera=k.base_T_camera[rows],
            map_T_base=k.map_T_base[rows],
            localized_every=max(1.0, self.next_id.keyframe / max(self.localization.received, 1)) if localized else 0.0,
            odom_T_base=k.start_T_base[rows] if reckoned else None,
            drift=k.drift[rows] if reckoned else None,
            stretch=np.where(k.by_odometry[rows], k.piece[rows], -1) if reckoned else None,
        )

    def rows_of(self, ids: Ints) -> Ints:
        """The rows of landmarks by their ids, which must be there."""
        return np.searchsorted(self.landmarks.id, ids)

    def bearings(self, at: Ints) -> Bearings:
        """Rows (n,) of the rays for the graph; ranges of one object share a bias, which no number of them takes away."""
        rays = self.rays
        sigma = rays.range_sigma[at]
        if np.isfinite(sigma).any():
            row = np.searchsorted(self.landmarks.id, rays.owner[at])
            sigma = np.sqrt(sigma**2 + (self.landmarks.seen[row] + 1) * self.settings.depth.bias**2)
        return Bearings(
            number=rays.number[at],
            keyframe=rays.keyframe[at],
            landmark=rays.owner[at],
            direction=rays.direction[at],
            sigma=rays.sigma[at],
            range=rays.range[at],
            range_sigma=sigma,
        )

    def sight(self, at: Ints) -> Observations:
        """Rows (n,) of the rays as lines in map, as of the graph's last refresh."""
        rays = self.rays
        ids, index = np.unique(rays.keyframe[at], return_inverse=True)
        poses = self.graph.poses(ids)[index]
        ahead = np.einsum("rij,rj->ri", poses[:, :3, :3], rays.direction[at])
        return Observations.of_lines(poses[:, :3, 3], ahead, rays.sigma[at], rays.range[at], rays.range_sigma[at])

    def read_positions(self) -> None:
        """The places of all landmarks, as the graph has them now."""
        self.landmarks.position[:] = self.graph.points(self.landmarks.id)

    def move_tracks(self, new_T_old: Floats, since: float) -> None:
        """Tracks seen from a stamp on moved by a pose (4, 4), as the path was."""
        for track in self.tracks:
            if track.last >= since:
                track.move(new_T_old)

    def tell_apart_within_labels(self) -> None:
        """From now on a label may have several objects: what shares nothing but the label is no track any more."""
        self.by_label = False
        self.tracks = [track for track in self.tracks if not track.by_label]
