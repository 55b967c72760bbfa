"""The graph that grows while the robot drives: iSAM2 with the same factors as offline, every one of them kept.

An update that throws is no lost map: the graph is built anew from the factors kept, by Levenberg-Marquardt from the last
good estimate, which damps what nothing holds yet.
"""

from __future__ import annotations

import gtsam
import numpy as np

from objslam.config import Settings
from objslam.errors import SolveError
from objslam.graph import factors
from objslam.graph.factors import L0, X0, l_key, x_key
from objslam.graph.kept import Bearings, Kept, KeptRay, ray_groups
from objslam.graph.layout import elimination_groups
from objslam.graph.optimise import levenberg_marquardt, read_points, read_poses
from objslam.graph.turns import Turns, new_isam
from objslam.types import Floats, Ints

_AT_ONCE = 400  # keyframes; a larger graph is built anew in turns,
_TURN = 100  # keyframes each
_FRESH = 10  # updates; a landmark that none of these was about has sunk in the tree
_HELD = 1.0  # m; a prior on every landmark for a graph that is indeterminate without
_HELD_POSE = (0.5, 2.0)  # rad, m; and on every pose, for one that is even then


class IncrementalGraph:
    """Poses X(k) of keyframes and places L(j) of landmarks, numbered by the caller; `update` works in what was added.

    rebuilds: how often an update threw and the graph was built anew.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._isam = new_isam()
        self._kept = Kept()
        self._turns: Turns | None = None
        self._poses: dict[int, Floats] = {}
        self._points: dict[int, Floats] = {}
        self._new = gtsam.NonlinearFactorGraph()
        self._values = gtsam.Values()
        self._stale = self._unfinished = False
        self._newest, self._updates = -1, 0
        self._touched: dict[int, int] = {}
        self.rebuilds = 0

    def add_keyframe(self, k: int, map_T_camera: Floats) -> None:
        """X(k) at its first guess (4, 4). Something must hold it before the next update: a motion or an absolute pose."""
        self._poses[k], self._newest = map_T_camera, k
        self._values.insert(x_key(k), gtsam.Pose3(map_T_camera))
        if self._turns is not None:
            self._turns.add_keyframe(k)

    def add_motion(self, before: int, after: int, motion: Floats, covariance: Floats) -> None:
        """The camera motion (4, 4) with covariance (6, 6) from X(before) to X(after), by odometry."""
        self._add(self._kept.chain, after, factors.between(before, after, motion, covariance))

    def before(self, k: int) -> int | None:
        """The keyframe that the motion to X(k) comes from, if there is one."""
        motion = self._kept.chain.get(k)
        return None if motion is None else int(motion.keys()[0]) - X0

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
        if self._turns is not None:
            self._turns.add_landmark(j)
        weak = _isotropic(3, self._settings.joint.prior_sigma)
        self._add(self._kept.landmarks, j, gtsam.PriorFactorPoint3(l_key(j), position, weak))

    def add_rays(self, rays: Bearings) -> None:
        """The factors of some rays, with Huber's loss, and of their ranges, with Cauchy's."""
        groups = ray_groups(rays, self._settings)
        ids = (rays.number.tolist(), rays.keyframe.tolist(), rays.landmark.tolist())
        for number, k, j, group in zip(*ids, groups, strict=True):
            self._kept.rays[number] = KeptRay(k, j, group)
            self._touched[j] = self._updates + 1
            for factor in group:
                self._push(factor)

    def update(self) -> None:
        """Work in what was added."""
        self._updates += 1
        self._work_in()

    def prepare(self, coming: Ints, relinearise: bool = False) -> None:
        """Work in what was added, and lay the tree out for a keyframe that may show landmarks coming (n,), where it is not.

        The cliques between an observed variable and the root are eliminated anew, so what may be observed goes near to the
        root. relinearise: look for variables that moved, too.
        """
        sunk = any(self._touched.get(j, -_FRESH) <= self._updates - _FRESH for j in coming.tolist())
        if relinearise or sunk or self._new.size():
            self._work_in(relinearise, self._layout(coming))
            shown = {j: number for j, number in self._touched.items() if number == self._updates}
            self._touched = {**dict.fromkeys(coming.tolist(), self._updates - 1), **shown}  # the others may have sunk
        if self._newest in self._poses:
            self.pose(self._newest)  # solves for what the updates left unsolved

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
        return self._kept.copy(), dict(self._poses), dict(self._points)

    def restore(self, saved: tuple[object, ...]) -> None:
        """The graph as it was when it was saved."""
        self._kept, self._poses, self._points = saved  # type: ignore[assignment]
        self._newest, self._touched = max(self._poses, default=-1), {}
        self._stale = False
        self._fill(self._kept.graph())
        self._clear()

    def bend(self, ids: Ints, poses: Floats, landmarks: Ints, points: Floats) -> None:
        """Keyframes ids (K,) at other poses (K, 4, 4), landmarks (n,) at other points (n, 3); `rebuild` must follow."""
        self.refresh()
        self._poses.update(zip(ids.tolist(), poses, strict=True))
        self._points.update(zip(landmarks.tolist(), points, strict=True))

    def solve(self, iterations: int, tolerance: float = 1e-5) -> None:
        """All variables by Levenberg-Marquardt from where they are, and iSAM2 anew from there.

        iterations: at the most. tolerance: share of the cost below which a step gains no more.
        SolveError, and nothing changed, where the cost runs away or nothing holds some variable.
        """
        self.refresh()
        graph = self._kept.graph()
        self._read(levenberg_marquardt(graph, self._start(), iterations, tolerance).values)
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

    def rebuild_in_turns(self, order: Ints) -> None:
        """As `rebuild`, but of a large graph in as many calls of `take_turn` as it takes; the old one goes on until then.

        order: all keyframes (K,), each after the one that its motion comes from. Asked for once more before it is done, it
        is done at once: changes that come so often must not keep it from ever being done.
        """
        if self._unfinished or len(order) <= _AT_ONCE:
            self.rebuild()
            return
        self.refresh()
        self._clear()
        self._turns = Turns(self._kept.copy(), order.tolist(), dict(self._poses), dict(self._points))
        self._unfinished = True

    @property
    def in_turns(self) -> bool:
        """Whether `rebuild_in_turns` is not done yet."""
        return self._unfinished

    def take_turn(self) -> None:
        """Go on with what `rebuild_in_turns` began, if it did."""
        if self._turns is None:
            return
        try:
            if not self._turns.last:
                self._turns.turn(_TURN)
                return
            self.refresh()
            self._turns.finish(self._poses, self._points)
        except RuntimeError:  # all at once, which knows what to do then
            self.rebuild()
            return
        self._clear()  # what was not worked in yet came in turns, too
        self._isam, self._stale = self._turns.isam, True
        self._turns, self._unfinished = None, False

    def drop_rays(self, numbers: Ints) -> None:
        """Rays that are to go; `rebuild` makes it so."""
        if len(numbers):
            self._turns = None
        for number in numbers.tolist():
            self._kept.rays.pop(number, None)

    def drop_landmarks(self, landmarks: Ints) -> None:
        """Landmarks that are to go; their rays must go too, and `rebuild` makes it so."""
        self.refresh()
        self._turns = None
        for j in landmarks.tolist():
            self._kept.landmarks.pop(j, None)
            self._points.pop(j, None)
            self._touched.pop(j, None)

    def drop_keyframes(self, keyframes: Ints) -> None:
        """Keyframes that are to go; their rays and the motions from them must go too, and `rebuild` makes it so."""
        self.refresh()
        self._turns = None
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
        self._turns = None
        self._points[j] = position

    def _work_in(self, relinearise: bool = False, layout: dict[int, int] | None = None) -> None:
        try:
            self._update(relinearise, layout or {})
        except (RuntimeError, ValueError):  # indeterminate, or no such layout: counted, and goes on from the factors kept
            self.rebuilds += 1
            self._rescue()
        self._clear()
        self._stale = True

    def _layout(self, coming: Ints) -> dict[int, int]:
        """`elimination_groups` as of now."""
        chain = [self._newest]
        while len(chain) < 3 and (before := self.before(chain[-1])) is not None:
            chain.append(before)
        shown = (j for j, number in self._touched.items() if number == self._updates)
        isam, new = self._isam, self._values
        return elimination_groups(chain, coming.tolist(), shown, lambda key: isam.valueExists(key) or new.exists(key))

    def _update(self, relinearise: bool, layout: dict[int, int]) -> None:
        last, anew = gtsam.KeyGroupMap(), gtsam.KeyList()
        for key, group in layout.items():
            last.insert2(key, group)
            if self._isam.valueExists(key):
                anew.push_back(key)
        self._isam.update(self._new, self._values, [], last if layout else None, None, anew, relinearise)

    def _add(self, kept: dict[int, gtsam.NonlinearFactor], key: int, factor: gtsam.NonlinearFactor) -> None:
        kept[key] = factor
        self._push(factor)

    def _push(self, factor: gtsam.NonlinearFactor) -> None:
        self._new.push_back(factor)
        if self._turns is not None:
            self._turns.add_factor(factor)

    def _clear(self) -> None:
        self._new, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def _fill(self, graph: gtsam.NonlinearFactorGraph) -> None:
        isam = new_isam()
        isam.update(graph, self._start())
        isam.calculateEstimate()  # throws now, if it does
        self._isam = isam
        self._stale = True
        self._turns, self._unfinished = None, False

    def _start(self) -> gtsam.Values:
        values = gtsam.Values()
        for k, pose in self._poses.items():
            values.insert(x_key(k), gtsam.Pose3(pose))
        for j, point in self._points.items():
            values.insert(l_key(j), point)
        return values

    def _read(self, values: gtsam.Values) -> None:
        keys = np.array(values.keys())  # some may have gone from what is kept, and the graph built in turns not be done
        poses = dict(zip((keys[keys >= X0] - X0).tolist(), read_poses(values), strict=True))
        points = dict(zip((keys[keys < X0] - L0).tolist(), read_points(values), strict=True))
        self._poses = {k: poses.get(k, pose) for k, pose in self._poses.items()}
        self._points = {j: points.get(j, point) for j, point in self._points.items()}

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


def _isotropic(dimension: int, sigma: float) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Isotropic.Sigma(dimension, sigma)
