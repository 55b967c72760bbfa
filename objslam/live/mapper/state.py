"""The state of a live map: graph, course, keyframes, rays, landmarks and tracks."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from objslam.association.observations import Observations
from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.calibration import Calibration
from objslam.core.camera import Camera
from objslam.core.noise import NOMINAL, NoiseFactors, range_noise
from objslam.core.types import Keyframes
from objslam.errors import SolveError
from objslam.frontend.boxes.part_finder import RobotPartFinder
from objslam.frontend.boxes.second_labels import SecondLabelFinder
from objslam.graph.factors.rays import Bearings
from objslam.graph.isam2 import IncrementalGraph
from objslam.live.counters import Counters
from objslam.live.label_kinds import LabelKinds
from objslam.live.mapper.course import Course
from objslam.live.mapper.landmark_table import LandmarkTable, box_centres, to_centres
from objslam.live.mapper.tables import KeyframeTable, RayTable
from objslam.live.mapper.tracks import Track

_AT_ONCE = 400
"""The most keyframes of a graph that is solved at once after a correction of its measurements. A graph with more keyframes
is rebuilt in slices, between frames. With a larger number, the next frame waits longer."""
_ITERATIONS = 8
"""The most iterations of the solve after a correction. More iterations delay the next frame for longer."""
_RELINEARISATIONS = 3  # The number of relinearisations after a large change. More of them are more exact, and take longer.


@dataclass
class NextIds:
    """The next free number of each kind. No number is used twice."""

    keyframe: int = 0
    ray: int = 0
    landmark: int = 0
    track: int = 0


@dataclass
class LocalizationState:
    """The state of the localisation. pending: the ids of the keyframes that wait for a localised pose.

    received: the number of poses so far. planar: whether all poses lie in one plane. noise: the noise of the localised poses
    and the time for which their errors last, by the last calibration. The other factors of `noise` are 1.
    """

    received: int = 0
    pending: list[int] = field(default_factory=list)
    planar: bool = True
    noise: NoiseFactors = NOMINAL


@dataclass
class PairEvidence:
    """What frames say about pairs of landmarks of one label. A key holds the two ids, the smaller one first.

    together: the number of frames that showed both landmarks. apart: the pairs that were tested and not merged. The value of
    a pair is from its last test: the frame count of the landmark with fewer frames, divided by 5 and rounded down. A pair is
    tested again when this value has changed.
    """

    together: Counter[tuple[int, int]] = field(default_factory=Counter)
    apart: dict[tuple[int, int], int] = field(default_factory=dict)

    def forget(self, ids: set[int]) -> None:
        """Remove the pairs of removed landmarks."""
        self.together = Counter({pair: n for pair, n in self.together.items() if not ids & set(pair)})
        self.apart = {pair: n for pair, n in self.apart.items() if not ids & set(pair)}


@dataclass
class MaintenanceSchedule:
    """When the maintenance tasks last ran.

    solved, culled: the number of keyframes at the last full solve, and at the last culling. relinearisations: how many early
    relinearisations remain. compared: the input of the last search for loops, None before the first search. It holds the ids
    of the recently seen landmarks, and the number of long unseen landmarks.
    """

    solved: int = 0
    culled: int = 0
    relinearisations: int = 0
    compared: tuple[tuple[int, ...], int] | None = None

    def relinearise_soon(self) -> None:
        """Schedule early relinearisations after a large change of the estimate."""
        self.relinearisations = _RELINEARISATIONS


@dataclass
class MapState:
    """The whole state of a session's map.

    graph: the factors and the estimate. cameras, labels: indexed by their numbers. rays: `owner` gives each ray's landmark.
    tracks: in the order of their first observation. kinds: which labels are names so far. landmark_of_track: id of the last
    landmark of each detector track. novelty: share of boxes that match no landmark, as an exponential average over about 50
    frames. pose_covariance: (6, 6) covariance of the newest keyframe's predicted pose, in its camera frame, rad and m,
    rotation first. It is NaN if the odometry does not determine the pose. frames: number of frames of each camera on the
    course. rng: seeded by the settings. robot_parts: the finder of robot parts of each camera, by the camera's number.
    second_labels: the finder of second labels for all cameras. ignored: the number of boxes of each ignored label.

    errors: the shared errors that are corrected in all measurements, by name. calibration: the last estimate of the shared
    errors, at first from the calibration file, or None without either. given: the settings as given. settings: the same
    settings, with odometry noise that fits the corrected distances. sent_cameras: the cameras as received. cameras: the same
    cameras, with the errors corrected. changed_cameras: the names of cameras that got another lens or image size after their
    first boxes.
    """

    settings: Settings
    counters: Counters
    graph: IncrementalGraph
    course: Course
    kinds: LabelKinds
    rng: np.random.Generator
    given: Settings
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
    frames: Counter[int] = field(default_factory=Counter)
    localization: LocalizationState = field(default_factory=LocalizationState)
    schedule: MaintenanceSchedule = field(default_factory=MaintenanceSchedule)
    next_id: NextIds = field(default_factory=NextIds)
    sent_cameras: list[Camera] = field(default_factory=list)
    changed_cameras: set[str] = field(default_factory=set)
    robot_parts: dict[int, RobotPartFinder] = field(default_factory=dict)
    second_labels: SecondLabelFinder = field(default_factory=SecondLabelFinder)
    ignored: Counter[str] = field(default_factory=Counter)
    errors: dict[str, float] = field(default_factory=dict)
    calibration: Calibration | None = None

    @property
    def by_label(self) -> bool:
        """Whether every label is the name of one object so far."""
        return self.kinds.all_names

    def newest_before(self, stamp: float) -> int | None:
        """Return the row of the newest keyframe at or before a stamp, s, or None without such a keyframe."""
        stamps = self.keyframes.stamp
        if len(stamps) and stamps[-1] <= stamp:
            return len(stamps) - 1
        older = np.flatnonzero(stamps <= stamp)
        return int(older[stamps[older].argmax()]) if len(older) else None

    def time_order(self) -> Ints:
        """Return the rows of the keyframes (K,) in the order of their stamps."""
        return np.argsort(self.keyframes.stamp, kind="stable")

    def keyframe_arrays(self, rows: Ints) -> Keyframes:
        """Return the keyframes in these rows (n,) as `Keyframes`."""
        k = self.keyframes
        localized, reckoned = bool(k.localized.any()), bool(k.by_odometry[rows].any())
        noise = self.localization.noise
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
            given_stamps=k.sent[rows],
            pose_noise=(noise.heading, noise.place),
            lasting=noise.lasting,
        )

    def rows_of(self, ids: Ints) -> Ints:
        """Return the rows of landmarks by their ids, which must be in the table."""
        return np.searchsorted(self.landmarks.id, ids)

    def camera_of_rays(self, at: Ints) -> Ints:
        """Return the number of the camera of each ray in rows (n,)."""
        k = self.keyframes
        return np.asarray(k.camera[np.searchsorted(k.id, self.rays.keyframe[at])])

    def half_widths(self, at: Ints) -> Floats:
        """Return half the width of the thing in the box of each ray in rows (n,), as `surface_ranges.half_widths`."""
        return self.rays.size[at, 0] / 2

    def bearings(self, at: Ints) -> Bearings:
        """Return the rays in rows (n,) for the graph.

        The ranges of a landmark share a bias, which does not average out. So the noise of each range grows with the number
        of ranges.
        """
        rays = self.rays
        sigma = rays.range_sigma[at]
        if np.isfinite(sigma).any():
            camera = self.camera_of_rays(at)
            _, bias = range_noise(rays.range[at], self.half_widths(at), camera, self.sent_cameras, self.settings)
            sigma = np.sqrt(sigma**2 + (self.landmarks.seen[self.rows_of(rays.owner[at])] + 1) * bias**2)
        direction, noise = self.to_landmarks(at)
        columns = {name: getattr(rays, name)[at] for name in ("number", "keyframe", "range")}
        return Bearings(**columns, direction=direction, sigma=noise, landmark=rays.owner[at], range_sigma=sigma)

    def to_landmarks(self, at: Ints) -> tuple[Floats, Floats]:
        """Return the directions (n, 3) of the rays in rows (n,) to their landmarks, in the camera frame, and their noise
        (n,), rad."""
        rays = self.rays
        direction = rays.direction[at] + rays.to_centre[at]
        return direction / np.linalg.norm(direction, axis=1, keepdims=True), np.hypot(rays.sigma[at], rays.centre_sigma[at])

    def to_centres(self, at: Ints) -> tuple[Floats, Floats]:
        """Return vectors (n, 3) to add to the directions of the rays in rows (n,), so that the rays point to the centres of
        bodies.

        The second array (n,) is the noise of the vectors, rad. The poses are from the last refresh of the graph.
        """
        ids, index = np.unique(self.rays.keyframe[at], return_inverse=True)
        rows, poses = self.rows_of(self.rays.owner[at]), self.graph.poses(ids)[index]
        beside, sigma = box_centres(self.landmarks, rows, self.cameras, self.camera_of_rays(at), poses)
        return to_centres(self.landmarks.position[rows] - poses[:, :3, 3], beside, sigma, poses[:, :3, :3])

    def sight(self, at: Ints) -> Observations:
        """Return the rays in rows (n,) in the frame map, by the camera poses at the graph's last refresh."""
        rays = self.rays
        ids, index = np.unique(rays.keyframe[at], return_inverse=True)
        poses = self.graph.poses(ids)[index]
        direction, sigma = self.to_landmarks(at)
        ahead = np.einsum("rij,rj->ri", poses[:, :3, :3], direction)
        return Observations.of_lines(poses[:, :3, 3], ahead, sigma, rays.range[at], rays.range_sigma[at])

    def read_positions(self) -> None:
        """Copy the current positions of all landmarks from the graph."""
        self.landmarks.position[:] = self.graph.points(self.landmarks.id)

    def rebuild_in_slices(self) -> None:
        """Start a rebuild of the graph in slices, and copy the positions of all landmarks."""
        self.graph.rebuild_in_slices(self.keyframes.id[self.time_order()])
        self.read_positions()

    def solve_corrected(self) -> None:
        """Solve the graph after a correction of its measurements. If it is large or the solve fails, rebuild it in slices.

        Only the next full solve tests for outliers, because until then the rays of one object may look like the rays of two
        objects.
        """
        if len(self.keyframes) <= _AT_ONCE:
            try:
                self.graph.solve(_ITERATIONS)
                self.read_positions()
                return
            except SolveError:
                self.counters.accept("solves given up")
        self.rebuild_in_slices()

    def move(self, new_T_old: Floats) -> None:
        """Move the whole map by a pose (4, 4). The caller must first remove the factors of absolute poses."""
        self.graph.move(new_T_old)
        turn, landmarks = new_T_old[:3, :3], self.landmarks
        landmarks.position[:] = landmarks.position @ turn.T + new_T_old[:3, 3]
        landmarks.information[:] = turn @ landmarks.information @ turn.T
        landmarks.yaw[:] += np.arctan2(turn[1, 0], turn[0, 0])
        self.move_tracks(new_T_old, -np.inf)

    def move_tracks(self, new_T_old: Floats, since: float) -> None:
        """Move the tracks that were seen at or after the stamp `since`, s, by a pose (4, 4)."""
        for track in self.tracks:
            if track.last >= since:
                track.move(new_T_old)

    def note_class(self, label: int, judged: bool = False) -> None:
        """Allow several objects for a label. Drop the label's track, whose rays were grouped by label alone. judged: as in
        `LabelKinds.add_class`."""
        self.kinds.add_class(label, judged)
        self._drop_old_tracks()

    def note_name(self, label: int) -> None:
        """Allow only one object for a label, as a solve did. The caller must leave the label at most one landmark."""
        self.kinds.add_name(label, self.next_id.ray)
        self._drop_old_tracks()

    def note_moving(self, label: int) -> None:
        """Leave the boxes of a label out of the map, because they show things that move. The caller must drop its
        landmarks."""
        self.kinds.add_moving(label)
        self._drop_old_tracks()

    def _drop_old_tracks(self) -> None:
        """Drop the tracks that were begun when their label was of another kind."""
        label = np.array([track.label for track in self.tracks], dtype=np.int64)
        stays = zip(self.tracks, self.kinds.name(label).tolist(), self.kinds.moves(label).tolist(), strict=True)
        self.tracks = [track for track, named, moves in stays if track.by_label == named and not moves]
