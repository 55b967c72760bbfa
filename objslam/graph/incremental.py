"""The graph that grows while the robot drives: iSAM2 with the same factors as offline, every one of them kept.

An update that throws is no lost map: the graph is built anew from the factors kept, by Levenberg-Marquardt from the last
good estimate, which damps what nothing holds yet.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from objslam.config import Settings
from objslam.errors import SolveError
from objslam.graph import factors
from objslam.graph.factors import l_key, x_key
from objslam.graph.optimise import levenberg_marquardt, read_points, read_poses
from objslam.types import Floats, Ints

_RELINEARISE = (0.02, 0.05)  # rad, m; a variable that moved by more is linearised anew
_EVERY = 1_000_000  # updates, where nobody asks for it: the caller knows when there is time
_HELD = 1.0  # m; a prior on every landmark for a graph that is indeterminate without
_HELD_POSE = (0.5, 2.0)  # rad, m; and on every pose, for one that is even then
_EQ1_SIGMA, _L1_RADIANS = 0.05, 1e-4  # as `grow` has them


@dataclass(frozen=True)
class Bearings:
    """Rays for the graph: number (n,) of their own, keyframe (n,), landmark (n,), direction (n, 3) in the camera, sigma (n,)
    rad, range (n,) m or NaN, range_sigma (n,) m."""

    number: Ints
    keyframe: Ints
    landmark: Ints
    direction: Floats
    sigma: Floats
    range: Floats
    range_sigma: Floats


@dataclass
class _Kept:
    """Every factor that is to be in the graph, by what it belongs to."""

    chain: dict[int, gtsam.NonlinearFactor] = field(default_factory=dict)
    absolute: dict[int, gtsam.NonlinearFactor] = field(default_factory=dict)
    rays: dict[int, list[gtsam.NonlinearFactor]] = field(default_factory=dict)
    landmarks: dict[int, gtsam.NonlinearFactor] = field(default_factory=dict)

    def graph(self) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for group in (self.chain, self.absolute, self.landmarks):
            for factor in group.values():
                graph.push_back(factor)
        for ray in self.rays.values():
            for factor in ray:
                graph.push_back(factor)
        return graph


class IncrementalGraph:
    """Poses X(k) of keyframes and places L(j) of landmarks, numbered by the caller; `update` works in what was added.

    rebuilds: how often an update threw and the graph was built anew.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._isam = self._empty()
        self._kept = _Kept()
        self._poses: dict[int, Floats] = {}
        self._points: dict[int, Floats] = {}
        self._new = gtsam.NonlinearFactorGraph()
        self._values = gtsam.Values()
        self._stale = False
        self.rebuilds = 0

    def add_keyframe(self, k: int, map_T_camera: Floats) -> None:
        """X(k) at its first guess (4, 4). Something must hold it before the next update: a motion or an absolute pose."""
        self._poses[k] = map_T_camera
        self._values.insert(x_key(k), gtsam.Pose3(map_T_camera))

    def add_motion(self, before: int, after: int, motion: Floats, covariance: Floats) -> None:
        """The camera motion (4, 4) with covariance (6, 6) from X(before) to X(after), by odometry."""
        self._add(self._kept.chain, after, factors.between(before, after, motion, covariance))

    def add_anchor(self, k: int, map_T_camera: Floats) -> None:
        """X(k) held where it is."""
        self._add(self._kept.absolute, k, gtsam.PriorFactorPose3(x_key(k), gtsam.Pose3(map_T_camera), _isotropic(6, 1e-4)))

    def add_absolute(self, k: int, factor: gtsam.NonlinearFactor) -> None:
        """A factor on X(k) alone: a localisation."""
        self._add(self._kept.absolute, k, factor)

    def add_landmark(self, j: int, position: Floats) -> None:
        """L(j) at its first place (3,), under a weak prior there. Rays must follow before the next update."""
        self._points[j] = position
        self._values.insert(l_key(j), position)
        weak = _isotropic(3, self._settings.joint.prior_sigma)
        self._add(self._kept.landmarks, j, gtsam.PriorFactorPoint3(l_key(j), position, weak))

    def add_rays(self, rays: Bearings) -> None:
        """The factors of some rays, with Huber's loss, and of their ranges, with Cauchy's."""
        for number, group in zip(rays.number.tolist(), ray_groups(rays, self._settings), strict=True):
            self._kept.rays[number] = group
            for factor in group:
                self._new.push_back(factor)

    def update(self, relinearise: bool = False) -> None:
        """Work in what was added. relinearise: look for variables that moved, now rather than some time."""
        try:
            self._update(relinearise)
        except RuntimeError:  # indeterminate: counted, and the graph goes on from the factors kept
            self.rebuilds += 1
            self._rescue()
        self._clear()
        self._stale = True

    def pose(self, k: int) -> Floats:
        """map_T_camera (4, 4) of X(k) as of now."""
        if self._stale and not self._values.exists(x_key(k)):
            self._poses[k] = self._isam.calculateEstimatePose3(x_key(k)).matrix()
        return self._poses[k]

    def points(self, landmarks: Ints) -> Floats:
        """(n, 3) the places of landmarks as of now."""
        if self._stale:
            for j in landmarks.tolist():
                if not self._values.exists(l_key(j)):
                    self._points[j] = self._isam.calculateEstimatePoint3(l_key(j))
        return np.array([self._points[j] for j in landmarks.tolist()]).reshape(-1, 3)

    def refresh(self) -> None:
        """Read everything off the graph."""
        if not self._stale:
            return
        self._read(self._isam.calculateEstimate())
        self._stale = False

    def poses(self, keyframes: Ints) -> Floats:
        """(n, 4, 4) the poses of keyframes as of the last `refresh`."""
        return np.array([self._poses[k] for k in keyframes.tolist()]).reshape(-1, 4, 4)

    def pose_covariance(self, k: int) -> Floats:
        """Covariance (6, 6) of X(k), rotation first, in the camera's frame; NaN where the graph does not tell."""
        return self._covariance(x_key(k), 6)

    def point_covariance(self, j: int) -> Floats:
        """Covariance (3, 3) of L(j), m^2; NaN where the graph does not tell."""
        return self._covariance(l_key(j), 3)

    def save(self) -> tuple[object, ...]:
        """What `restore` goes back to."""
        self.refresh()
        k = self._kept
        rays = {number: list(group) for number, group in k.rays.items()}
        kept = _Kept(dict(k.chain), dict(k.absolute), rays, dict(k.landmarks))
        return kept, dict(self._poses), dict(self._points)

    def restore(self, saved: tuple[object, ...]) -> None:
        """The graph as it was when it was saved."""
        self._kept, self._poses, self._points = saved  # type: ignore[assignment]
        self._stale = False
        self._fill(self._kept.graph())
        self._clear()

    def bend(self, ids: Ints, poses: Floats, landmarks: Ints, points: Floats) -> None:
        """Keyframes ids (K,) at other poses (K, 4, 4), landmarks (n,) at other points (n, 3); `rebuild` must follow."""
        self.refresh()
        self._poses.update(zip(ids.tolist(), poses, strict=True))
        self._points.update(zip(landmarks.tolist(), points, strict=True))

    def solve(self, iterations: int) -> None:
        """All variables by Levenberg-Marquardt from where they are, for so many iterations, and iSAM2 anew from there.

        SolveError, and nothing changed, where the cost runs away or nothing holds some variable.
        """
        self.refresh()
        graph = self._kept.graph()
        self._read(levenberg_marquardt(graph, self._start(), iterations, 1e-5).values)
        self.rebuild()

    def rebuild(self) -> None:
        """iSAM2 anew from the factors kept, linearised where the estimate is now."""
        self.refresh()
        try:
            self._fill(self._kept.graph())
        except RuntimeError:
            self.rebuilds += 1
            self._rescue()
        self._clear()

    def drop_rays(self, numbers: Ints) -> None:
        """Rays that are to go; `rebuild` makes it so."""
        for number in numbers.tolist():
            self._kept.rays.pop(number, None)

    def drop_landmarks(self, landmarks: Ints) -> None:
        """Landmarks that are to go; their rays must go too, and `rebuild` makes it so."""
        self.refresh()
        for j in landmarks.tolist():
            self._kept.landmarks.pop(j, None)
            self._points.pop(j, None)

    def drop_keyframes(self, keyframes: Ints) -> None:
        """Keyframes that are to go; their rays and the motions from them must go too, and `rebuild` makes it so."""
        self.refresh()
        for k in keyframes.tolist():
            self._kept.chain.pop(k, None)
            self._kept.absolute.pop(k, None)
            self._poses.pop(k, None)

    def drop_absolute(self) -> None:
        """Nothing absolute any more; `rebuild` makes it so."""
        self._kept.absolute.clear()

    def move(self, new_T_old: Floats) -> None:
        """The whole estimate moved by a pose (4, 4); what holds it must have gone, and `rebuild` must follow."""
        self.refresh()
        for k, pose in self._poses.items():
            self._poses[k] = new_T_old @ pose
        for j, point in self._points.items():
            self._points[j] = new_T_old[:3, :3] @ point + new_T_old[:3, 3]
            weak = _isotropic(3, self._settings.joint.prior_sigma)
            self._kept.landmarks[j] = gtsam.PriorFactorPoint3(l_key(j), self._points[j], weak)

    def place(self, j: int, position: Floats) -> None:
        """L(j) somewhere else (3,); `rebuild` makes it so."""
        self.refresh()
        self._points[j] = position

    def _update(self, relinearise: bool) -> None:
        self._isam.update(self._new, self._values, [], None, None, None, relinearise)

    def _add(self, kept: dict[int, gtsam.NonlinearFactor], key: int, factor: gtsam.NonlinearFactor) -> None:
        kept[key] = factor
        self._new.push_back(factor)

    def _clear(self) -> None:
        self._new, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def _empty(self) -> gtsam.ISAM2:
        parameters = gtsam.ISAM2Params()
        turn, way = _RELINEARISE
        limits = gtsam.ISAM2ThresholdMap()
        limits.insert(("x", np.array([turn] * 3 + [way] * 3)))
        limits.insert(("l", np.array([way] * 3)))
        parameters.setRelinearizeThreshold(limits)
        parameters.relinearizeSkip = _EVERY
        return gtsam.ISAM2(parameters)

    def _fill(self, graph: gtsam.NonlinearFactorGraph) -> None:
        isam = self._empty()
        isam.update(graph, self._start())
        isam.calculateEstimate()  # throws now, if it does
        self._isam = isam
        self._stale = True

    def _start(self) -> gtsam.Values:
        values = gtsam.Values()
        for k, pose in self._poses.items():
            values.insert(x_key(k), gtsam.Pose3(pose))
        for j, point in self._points.items():
            values.insert(l_key(j), point)
        return values

    def _read(self, values: gtsam.Values) -> None:
        self._poses = dict(zip(sorted(self._poses), read_poses(values), strict=True))
        self._points = dict(zip(sorted(self._points), read_points(values), strict=True))

    def _rescue(self) -> None:
        """iSAM2 anew after it threw, with priors on what nothing holds, as strong as it takes."""
        self._stale = False
        for held in (None, _HELD, _HELD_POSE):
            graph = self._kept.graph()
            if held is not None:
                for j, point in self._points.items():
                    graph.push_back(gtsam.PriorFactorPoint3(l_key(j), point, _isotropic(3, _HELD)))
            if held is _HELD_POSE:
                turn, way = _HELD_POSE
                noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([turn] * 3 + [way] * 3))
                for k, pose in self._poses.items():
                    graph.push_back(gtsam.PriorFactorPose3(x_key(k), gtsam.Pose3(pose), noise))
            try:
                self._read(levenberg_marquardt(graph, self._start(), 10, 1e-4).values)
                self._fill(graph)
                return
            except (RuntimeError, SolveError) as error:
                reason = error
        raise SolveError(f"the graph cannot be built anew: {reason}")

    def _covariance(self, key: int, dimension: int) -> Floats:
        try:
            return np.asarray(self._isam.marginalCovariance(key))
        except RuntimeError:
            return np.full((dimension, dimension), np.nan)


def ray_groups(rays: Bearings, settings: Settings) -> list[list[gtsam.NonlinearFactor]]:
    """The factors of each ray: bearing or point-to-line as set, and its range where it has one."""
    if settings.joint.factor == "bearing":
        noise = factors.robust("huber", rays.sigma, 2, _L1_RADIANS)
        groups = [[f] for f in factors.bearing(rays.keyframe, rays.direction, rays.landmark, noise)]
    else:
        noise = factors.robust("huber", np.full(len(rays.number), _EQ1_SIGMA), 2)
        groups = [[f] for f in factors.point_to_line(rays.keyframe, rays.direction, rays.landmark, noise)]
    ranged = np.flatnonzero(np.isfinite(rays.range))
    if len(ranged):
        noise = factors.robust("cauchy", rays.range_sigma[ranged], 1)
        found = factors.ranges(rays.keyframe[ranged], rays.range[ranged], rays.landmark[ranged], noise)
        for i, factor in zip(ranged.tolist(), found, strict=True):
            groups[i].append(factor)
    return groups


def _isotropic(dimension: int, sigma: float) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Isotropic.Sigma(dimension, sigma)
