"""Keep the variables and factors of a graph that grows with each measurement. The factors are the same as offline."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import gtsam

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import inverse
from objslam.graph.factor_store import Factors, FactorStore
from objslam.graph.factors.frames import F0
from objslam.graph.factors.odometry import between
from objslam.graph.factors.priors import anchor, point_prior
from objslam.graph.factors.rays import Bearings, ray_factors
from objslam.graph.isam2_rebuild import IncrementalRebuild
from objslam.graph.optimizers import build_graph
from objslam.graph.variables import L0, LETTER, X0, Variables


class GrowingGraph(ABC):
    """Poses X(k) of keyframes, positions L(j) of landmarks, and the factors between them. The caller chooses each k and j.

    A change by `drop_*`, `move`, `place` or `set_estimate` takes effect at the next `rebuild`.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._store = FactorStore()
        self._at = Variables()
        self._new, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()  # Not in the estimate yet.
        self._rebuild: IncrementalRebuild | None = None
        self._newest, self._updates = -1, 0
        self._touched: dict[int, int] = {}  # The last update that involved each landmark.
        self._outgrown = False  # Whether the present iSAM2 does not know the letter of some variable's symbol.

    @abstractmethod
    def refresh(self) -> None:
        """Read the current estimates of all variables from the graph."""

    def add(self, kind: str, numbers: Sequence[int], groups: Sequence[Factors]) -> None:
        """Add a group of factors for each number, and store the groups by kind and number, as `FactorStore` explains.

        The keyframes, landmarks and other variables of the factors must be in the graph.
        """
        self._store.add(kind, numbers, groups)
        graph = build_graph(*groups)
        self._new.push_back(graph)
        if self._rebuild is not None:
            self._rebuild.later.push_back(graph)

    def add_keyframe(self, k: int, map_T_camera: Floats) -> None:
        """Add X(k) at an initial pose (4, 4). X(k) needs a motion or an absolute pose before the next update."""
        self._at.poses[k], self._newest = map_T_camera, k
        self._insert(X0 + k, gtsam.Pose3(map_T_camera))

    def add_motion(self, before: int, after: int, motion: Floats, covariance: Floats) -> None:
        """Add the camera motion (4, 4) by odometry from X(before) to X(after), with its covariance (6, 6)."""
        self.add("motion", [after], [[between(before, after, motion, covariance)]])

    def drop_motion(self, k: int) -> None:
        """Remove the motion to X(k). Without such a motion, do nothing."""
        self._store.drop("motion", [k])

    def before(self, k: int) -> int | None:
        """Return the keyframe at the start of the motion to X(k), or None without a motion."""
        motion = self._store.kinds["motion"].get(k)
        return None if motion is None else int(motion.factors[0].keys()[0]) - X0

    def add_anchor(self, k: int, map_T_camera: Floats) -> None:
        """Hold X(k) at a pose (4, 4)."""
        self.add_absolute(k, anchor(k, map_T_camera))

    def add_absolute(self, k: int, factor: gtsam.NonlinearFactor) -> None:
        """Add a factor on X(k) alone, from a localisation."""
        self.add("absolute", [k], [[factor]])

    def add_landmark(self, j: int, position: Floats) -> None:
        """Add L(j) at an initial position (3,), m, with a weak prior. L(j) needs rays before the next update."""
        self._at.points[j] = position
        self._insert(L0 + j, position)
        self.add("landmark", [j], [[point_prior(j, position, self._settings.joint.prior_sigma)]])

    def add_rays(self, rays: Bearings) -> None:
        """Add the bearing factors of rays with Huber's loss, and their range factors with Cauchy's loss."""
        groups: list[list[gtsam.NonlinearFactor]] = [[] for _ in rays.number]
        for which, made in ray_factors(rays, rays.landmark, "huber", self._settings):
            for i, factor in zip(which.tolist(), made, strict=True):
                groups[i].append(factor)
        self.add("ray", rays.number.tolist(), groups)
        self._touched.update(dict.fromkeys(rays.landmark.tolist(), self._updates + 1))

    def add_variable(self, key: int, value: gtsam.Pose3 | Floats) -> None:
        """Add another variable, a pose or a point (3,), by its key. The variable needs factors before the next update."""
        self._outgrown |= key >> LETTER not in {other >> LETTER for other in self._at.others}
        self._at.others[key] = value
        self._insert(key, value)

    def drop_rays(self, numbers: Ints) -> None:
        """Remove the rays with these numbers."""
        if len(numbers):
            self._rebuild = None
            self._store.drop("ray", numbers.tolist())

    def drop_landmarks(self, landmarks: Ints) -> None:
        """Remove landmarks and all their measurements."""
        self._drop(L0 + landmarks)
        for j in landmarks.tolist():
            self._at.points.pop(j, None)
            self._touched.pop(j, None)

    def drop_keyframes(self, keyframes: Ints) -> None:
        """Remove keyframes and all their measurements."""
        self._drop(X0 + keyframes)
        for k in keyframes.tolist():
            self._at.poses.pop(k, None)

    def drop_kind(self, kind: str) -> None:
        """Remove all factors of one kind, and the variables of `add_variable` that are left without a factor."""
        self._rebuild = None
        self._store.kinds.pop(kind, None)
        self._drop_free_variables()

    def drop_absolute(self) -> None:
        """Remove all absolute poses."""
        self._store.kinds["absolute"].clear()

    def move(self, new_T_old: Floats) -> None:
        """Move the whole estimate by a pose (4, 4). The caller must first remove the absolute poses.

        A prior map does not move. So the pose F of the graph's frame in the prior map also changes.
        """
        self.refresh()
        at, weak = self._at, self._settings.joint.prior_sigma
        if F0 in at.others:
            at.others[F0] = at.others[F0].compose(gtsam.Pose3(inverse(new_T_old)))
        at.poses = {k: new_T_old @ pose for k, pose in at.poses.items()}
        at.points = {j: new_T_old[:3, :3] @ point + new_T_old[:3, 3] for j, point in at.points.items()}
        self._store.add("landmark", list(at.points), [[point_prior(j, point, weak)] for j, point in at.points.items()])

    def place(self, j: int, position: Floats) -> None:
        """Move L(j) to a position (3,)."""
        self.refresh()
        self._rebuild = None
        self._at.points[j] = position

    def set_estimate(self, ids: Ints, poses: Floats, landmarks: Ints, points: Floats) -> None:
        """Move the keyframes `ids` (K,) to poses (K, 4, 4), and the landmarks (n,) to points (n, 3)."""
        self.refresh()
        self._at.poses.update(zip(ids.tolist(), poses, strict=True))
        self._at.points.update(zip(landmarks.tolist(), points, strict=True))

    def _insert(self, key: int, value: gtsam.Pose3 | Floats) -> None:
        self._values.insert(key, value)
        if self._rebuild is not None:
            self._rebuild.new.append(key)

    def _drop(self, keys: Ints) -> None:
        self.refresh()
        self._rebuild = None
        self._store.drop_variables(frozenset(keys.tolist()))
        self._drop_free_variables()

    def _drop_free_variables(self) -> None:
        """Remove the variables of `add_variable` that are in no factor. They would make the linear system indeterminate."""
        if self._at.others:
            held = self._store.variables()
            self._at.others = {key: value for key, value in self._at.others.items() if key in held}
