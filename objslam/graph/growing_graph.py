"""What a growing graph is made of: its variables, and the same factors as offline, every one of them stored."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import gtsam

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.graph.factor_store import Factors, FactorStore
from objslam.graph.factors.odometry import between
from objslam.graph.factors.priors import anchor, point_prior
from objslam.graph.factors.rays import Bearings, ray_factors
from objslam.graph.isam2_rebuild import IncrementalRebuild
from objslam.graph.variables import L0, LETTER, X0, Variables


class GrowingGraph(ABC):
    """Poses X(k) of keyframes and places L(j) of landmarks, numbered by the caller, and the factors between them."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._store = FactorStore()
        self._at = Variables()
        self._new, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()  # what no update has worked in yet
        self._rebuild: IncrementalRebuild | None = None
        self._newest, self._updates = -1, 0
        self._touched: dict[int, int] = {}  # by landmark, the last update that was about it
        self._outgrown = False  # iSAM2 takes no letter that it was not made for

    @abstractmethod
    def refresh(self) -> None:
        """Read everything off the graph."""

    def add(self, kind: str, numbers: Sequence[int], groups: Sequence[Factors]) -> None:
        """Add the factors of some measurements, stored by their kind and numbers (see `FactorStore`).

        What these factors are about must be there: keyframes, landmarks, or variables by `add_variable`.
        """
        self._store.add(kind, numbers, groups)
        for group in groups:
            for factor in group:
                self._new.push_back(factor)
                if self._rebuild is not None:
                    self._rebuild.add_factor(factor)

    def add_keyframe(self, k: int, map_T_camera: Floats) -> None:
        """X(k) at its first guess (4, 4). Something must hold it before the next update: a motion or an absolute pose."""
        self._at.poses[k], self._newest = map_T_camera, k
        self._insert(X0 + k, gtsam.Pose3(map_T_camera))

    def add_motion(self, before: int, after: int, motion: Floats, covariance: Floats) -> None:
        """The camera motion (4, 4) with covariance (6, 6) from X(before) to X(after), by odometry."""
        self.add("motion", [after], [[between(before, after, motion, covariance)]])

    def drop_motion(self, k: int) -> None:
        """The motion to X(k) is to go, if there is one; `rebuild` makes it so."""
        self._store.drop("motion", [k])

    def before(self, k: int) -> int | None:
        """The keyframe that the motion to X(k) comes from, if there is one."""
        motion = self._store.kinds["motion"].get(k)
        return None if motion is None else int(motion.factors[0].keys()[0]) - X0

    def add_anchor(self, k: int, map_T_camera: Floats) -> None:
        """X(k) held where it is (4, 4)."""
        self.add_absolute(k, anchor(k, map_T_camera))

    def add_absolute(self, k: int, factor: gtsam.NonlinearFactor) -> None:
        """A factor on X(k) alone: a localisation."""
        self.add("absolute", [k], [[factor]])

    def add_landmark(self, j: int, position: Floats) -> None:
        """L(j) at its first place (3,), under a weak prior there. Rays must follow before the next update."""
        self._at.points[j] = position
        self._insert(L0 + j, position)
        self.add("landmark", [j], [[point_prior(j, position, self._settings.joint.prior_sigma)]])

    def add_rays(self, rays: Bearings) -> None:
        """The factors of some rays, with Huber's loss, and of their ranges, with Cauchy's."""
        groups: list[list[gtsam.NonlinearFactor]] = [[] for _ in rays.number]
        for which, made in ray_factors(rays, rays.landmark, "huber", self._settings):
            for i, factor in zip(which.tolist(), made, strict=True):
                groups[i].append(factor)
        self.add("ray", rays.number.tolist(), groups)
        self._touched.update(dict.fromkeys(rays.landmark.tolist(), self._updates + 1))

    def add_variable(self, key: int, value: gtsam.Pose3 | Floats) -> None:
        """A variable that is neither keyframe nor landmark, by the key of its symbol: a pose, or a point (3,).

        Its factors come by `add`, and must hold it before the next update.
        """
        letters = {other >> LETTER for other in self._at.others}
        self._outgrown |= key >> LETTER not in letters
        self._at.others[key] = value
        self._insert(key, value)

    def drop_rays(self, numbers: Ints) -> None:
        """Rays that are to go; `rebuild` makes it so."""
        if len(numbers):
            self._rebuild = None
            self._store.drop("ray", numbers.tolist())

    def drop_landmarks(self, landmarks: Ints) -> None:
        """Landmarks that are to go, with all that was measured of them; `rebuild` makes it so."""
        ids = landmarks.tolist()
        self._drop([L0 + j for j in ids])
        for j in ids:
            self._at.points.pop(j, None)
            self._touched.pop(j, None)

    def drop_keyframes(self, keyframes: Ints) -> None:
        """Keyframes that are to go, with all that was measured at them; `rebuild` makes it so."""
        ids = keyframes.tolist()
        self._drop([X0 + k for k in ids])
        for k in ids:
            self._at.poses.pop(k, None)

    def drop_absolute(self) -> None:
        """Nothing absolute any more; `rebuild` makes it so."""
        self._store.kinds["absolute"].clear()

    def move(self, new_T_old: Floats) -> None:
        """The whole estimate moved by a pose (4, 4); what holds it must have gone, and `rebuild` must follow."""
        self.refresh()
        at, weak = self._at, self._settings.joint.prior_sigma
        at.poses = {k: new_T_old @ pose for k, pose in at.poses.items()}
        at.points = {j: new_T_old[:3, :3] @ point + new_T_old[:3, 3] for j, point in at.points.items()}
        self._store.add("landmark", list(at.points), [[point_prior(j, point, weak)] for j, point in at.points.items()])

    def place(self, j: int, position: Floats) -> None:
        """L(j) somewhere else (3,); `rebuild` makes it so."""
        self.refresh()
        self._rebuild = None
        self._at.points[j] = position

    def set_estimate(self, ids: Ints, poses: Floats, landmarks: Ints, points: Floats) -> None:
        """Keyframes ids (K,) at other poses (K, 4, 4), landmarks (n,) at other points (n, 3); `rebuild` must follow."""
        self.refresh()
        self._at.poses.update(zip(ids.tolist(), poses, strict=True))
        self._at.points.update(zip(landmarks.tolist(), points, strict=True))

    def _insert(self, key: int, value: gtsam.Pose3 | Floats) -> None:
        self._values.insert(key, value)
        if self._rebuild is not None:
            self._rebuild.add_variable(key)

    def _drop(self, keys: list[int]) -> None:
        self.refresh()
        self._rebuild = None
        self._store.drop_variables(frozenset(keys))
