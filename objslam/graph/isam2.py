"""Estimate a growing graph by iSAM2: updates, rebuilds, and access to the estimate.

If an update raises an exception, Levenberg-Marquardt solves the stored factors from the last good estimate. iSAM2 is then
rebuilt at this solution. The damping of Levenberg-Marquardt determines the variables without measurements. If iSAM2 still
raises an exception, landmarks get priors. If this is not enough, poses also get priors.
"""

from typing import Any

import gtsam
import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.errors import SolveError
from objslam.graph.factor_store import FactorStore
from objslam.graph.factors.odometry import UNKNOWN_TURN, UNKNOWN_WAY
from objslam.graph.factors.priors import point_prior, pose_prior
from objslam.graph.growing_graph import GrowingGraph
from objslam.graph.isam2_rebuild import IncrementalRebuild, new_isam
from objslam.graph.optimizers import build_graph, indeterminate, levenberg_marquardt
from objslam.graph.posterior.marginals import HELD, in_camera, in_order
from objslam.graph.variables import L0, X0, Variables

_AT_ONCE = 100
"""The largest number of keyframes of a graph that is rebuilt in one call. A larger number delays the next image for longer.
A smaller number spreads more rebuilds over several images."""
_SLICE = 30
"""The number of keyframes in one slice of a rebuild. With a larger number, a rebuild ends sooner, and the next image waits
longer. A slice of 100 keyframes takes 13 ms of a busy core."""
_FRESH = 10
"""A landmark counts as deep in iSAM2's tree after this number of updates without it. A larger number changes the layout of
the tree less often, and landmarks that are observed again are deeper in the tree."""


class IncrementalGraph(GrowingGraph):
    """A growing graph and its estimate.

    rebuilds: how many times the graph was solved and rebuilt because an update or a rebuild raised an exception.
    """

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self._isam = new_isam({})
        self._stale = self._unfinished = False
        self._replaced: object = None  # The tree before the last rebuild in slices. Its deletion takes 10 ms.
        self._coming = np.zeros(0, dtype=np.int64)  # The landmarks for which the tree was last prepared.
        self._prepared = True  # Whether the tree has a layout for `_coming`. It has none after a rebuild in slices.
        self.rebuilds = 0

    def update(self) -> None:
        """Add the new variables and factors to the estimate. SolveError if no rebuild succeeds after an exception."""
        self._updates += 1
        self._work_in()

    def prepare(self, coming: Ints, relinearise: bool = False) -> None:
        """Add the new variables and factors, and prepare the tree for a keyframe that may observe landmarks `coming` (n,).

        An update eliminates again all cliques between an observed variable and the root. So this call moves the variables
        that may be observed soon closer to the root. relinearise: whether to also relinearise the variables that changed.
        """
        sunk = any(self._touched.get(j, -_FRESH) <= self._updates - _FRESH for j in coming.tolist())
        self._coming = coming
        if relinearise or sunk or not self._prepared or self._new.size():
            self._prepared = True
            self._work_in(relinearise, self._layout())
            shown = {j: number for j, number in self._touched.items() if number == self._updates}
            # A landmark that is not in this table counts as deep.
            self._touched = {**dict.fromkeys(coming.tolist(), self._updates - 1), **shown}
        if self._newest in self._at.poses:
            self.pose(self._newest)  # This makes iSAM2 solve now.

    def pose(self, k: int) -> Floats:
        """Return the current map_T_camera (4, 4) of X(k)."""
        if self._stale and not self._values.exists(X0 + k):
            self._at.poses[k] = self._isam.calculateEstimatePose3(X0 + k).matrix()
        return self._at.poses[k]

    def points(self, landmarks: Ints) -> Floats:
        """Return the current positions (n, 3) of landmarks."""
        points, ids = self._at.points, landmarks.tolist()
        if self._stale:
            points.update((j, self._isam.calculateEstimatePoint3(L0 + j)) for j in ids if not self._values.exists(L0 + j))
        return np.array([points[j] for j in ids]).reshape(-1, 3)

    def refresh(self) -> None:
        """Read the current estimates of all variables from the graph."""
        if self._stale:
            self._at.read(self._isam.calculateEstimate())
            self._stale = False

    def poses(self, keyframes: Ints) -> Floats:
        """Return the poses (n, 4, 4) of keyframes at the last `refresh`."""
        return np.array([self._at.poses[k] for k in keyframes.tolist()]).reshape(-1, 4, 4)

    def variable(self, key: int) -> Any:
        """Return the value that a variable from `add_variable` had at the last `refresh`. None for an unknown key."""
        return self._at.others.get(key)

    def pose_covariance(self, k: int) -> Floats:
        """Return the covariance (6, 6) of X(k) in the camera frame, rotation first. NaN if iSAM2 cannot compute it."""
        return self._covariance(X0 + k, 6)

    def point_covariance(self, j: int) -> Floats:
        """Return the covariance (3, 3), m^2, of L(j). NaN if iSAM2 cannot compute it."""
        return self._covariance(L0 + j, 3)

    def seen_covariance(self, j: int, k: int) -> Floats:
        """Return the covariance (3, 3), m^2, of L(j) in the frame of X(k), as in `marginals.seen_covariances`.

        It is NaN if iSAM2 cannot give it. A call takes about 1 ms for a keyframe near the root, such as the newest, and
        about 100 ms for other keyframes.
        """
        joint = self.joint_covariance(X0 + k, L0 + j)
        if joint is None:
            return np.full((3, 3), np.nan)
        return in_camera(in_order(joint, (X0 + k, L0 + j)), self.pose(k), self.points(np.array([j]))[0])

    def joint_covariance(self, *keys: int) -> gtsam.JointMarginal | None:
        """Return the joint marginal covariance of variables by their keys. None if iSAM2 cannot give it."""
        try:
            return self._isam.jointMarginalCovariance(list(keys))
        except (RuntimeError, IndexError):  # The system is indeterminate, or a variable is not in the graph yet.
            return None

    def save(self) -> tuple[FactorStore, Variables]:
        """Return a copy of the factors and variables, which `restore` takes."""
        self.refresh()
        return self._store.copy(), self._at.copy()

    def restore(self, saved: tuple[FactorStore, Variables]) -> None:
        """Return to the state of a `save`."""
        self._store, self._at = saved
        self._newest, self._touched = max(self._at.poses, default=-1), {}
        self._stale = False
        self._fill(self._store.graph())

    def solve(self, iterations: int, tolerance: float = 1e-5) -> None:
        """Optimise all variables by Levenberg-Marquardt from the current estimate, and rebuild iSAM2 there.

        The solve ends after `iterations`, or when the cost falls by a smaller share than `tolerance`. SolveError if the cost
        is not finite, or if no factor determines some variable. After a SolveError the graph is unchanged.
        """
        self.refresh()
        self._at.read(levenberg_marquardt(self._store.graph(), self._at.values(), iterations, tolerance).values)
        self.rebuild()

    def iterate(self) -> float:
        """Optimise all variables by one iteration of Levenberg-Marquardt. Return the share by which the cost fell.

        iSAM2 does not change until a `rebuild`, which must follow before the next update. SolveError as in `solve`.
        """
        self.refresh()
        found = levenberg_marquardt(self._store.graph(), self._at.values(), 1)
        self._at.read(found.values)
        return 1 - found.cost_after / max(found.cost_before, 1e-300)

    def rebuild(self) -> None:
        """Rebuild iSAM2 from the stored factors, linearised at the current estimate."""
        try:
            self.refresh()
            self._fill(self._store.graph())
        except RuntimeError:
            self._rescue()

    def rebuild_in_slices(self, order: Ints) -> None:
        """Start a rebuild. Each call of `continue_rebuild` runs one slice. Until the last slice, the old graph stays in use.

        A graph of at most `_AT_ONCE` keyframes is rebuilt at once. A graph whose rebuild has not ended is also rebuilt at
        once, because frequent changes could postpone the end for ever. order: (K,) all keyframes. The keyframe at the start
        of a motion comes before the one at its end.
        """
        if self._unfinished or len(order) <= _AT_ONCE:
            self.rebuild()
            return
        self.refresh()
        self._clear()
        self._rebuild = IncrementalRebuild(self._store.copy(), order.tolist(), self._at.copy())
        self._unfinished = True
        self._outgrown = False  # The rebuilt graph knows the letters of all present variables.

    @property
    def is_rebuilding(self) -> bool:
        """Whether a rebuild in slices has begun and not ended."""
        return self._unfinished

    def continue_rebuild(self) -> None:
        """Run the next slice of the rebuild, if one has begun. The call after the last slice frees the old tree."""
        self._replaced = None
        if self._rebuild is None:
            return
        try:
            if not self._rebuild.last:
                self._rebuild.step(_SLICE)
                return
            self.refresh()
            self._rebuild.finish(self._at)
        except RuntimeError:  # A full rebuild can handle this.
            self.rebuild()
            return
        self._clear()  # The new iSAM2 also contains these factors and variables.
        self._replaced = self._isam, self._rebuild
        self._isam, self._stale = self._rebuild.isam, True
        self._rebuild, self._unfinished, self._prepared = None, False, False

    def _work_in(self, relinearise: bool = False, layout: dict[int, int] | None = None) -> None:
        try:
            if self._outgrown:
                self.refresh()
                self._fill(self._store.graph())
            else:
                self._update(relinearise, layout or {})
        except (RuntimeError, ValueError):  # The system is indeterminate, or the layout is impossible.
            self._rescue()

    def _layout(self, values: gtsam.Values | None = None) -> dict[int, int]:
        """Return a group number for each key that is eliminated late. A higher group is eliminated later.

        values: the variables of a new tree. If not given, the layout is for the present tree.

        The newest keyframe X(k) and the landmarks that it observes make the root. The landmarks `coming` make the clique
        below the root. GTSAM merges a clique into its parent if the clique involves all variables of the parent. The cliques
        below these two are dense, so GTSAM would merge them. Therefore the root and the clique of `coming` each get a pose
        that no clique below them involves. The root gets X(k): motions tie it only to X(k-1). The clique of `coming` gets
        X(k-1): motions tie it to X(k-2).
        """
        chain = [self._newest]
        while len(chain) < 3 and (before := self.before(chain[-1])) is not None:
            chain.append(before)
        groups = {X0 + k: 1 for k in chain}
        groups.update((L0 + j, 2) for j in self._coming.tolist())
        groups.update((L0 + j, 3) for j, number in self._touched.items() if number == self._updates)
        groups.update((X0 + k, 3) for k in chain[:2])
        if values is None:
            there = {key for key in groups if self._isam.valueExists(key) or self._values.exists(key)}
        else:
            there = {key for key in groups if values.exists(key)}
        groups = {key: group for key, group in groups.items() if key in there}
        number = {group: i for i, group in enumerate(sorted(set(groups.values())), start=1)}
        # CCOLAMD needs consecutive groups, with 0 for all other variables, and fewer groups than variables.
        return {key: number[group] for key, group in groups.items()} if len(number) < len(groups) else {}

    def _update(self, relinearise: bool, layout: dict[int, int]) -> None:
        reordered = gtsam.KeyList()
        for key in layout:
            if self._isam.valueExists(key):
                reordered.push_back(key)
        self._isam.update(self._new, self._values, [], _groups(layout), None, reordered, relinearise)
        self._clear()
        self._stale = True

    def _clear(self) -> None:
        self._new, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def _fill(self, graph: gtsam.NonlinearFactorGraph) -> None:
        isam, values = new_isam(self._at.others), self._at.values()
        isam.update(graph, values, [], _groups(self._layout(values)), None, gtsam.KeyList())
        isam.calculateEstimate()  # It raises here if the graph is indeterminate.
        self._isam, self._stale = isam, True
        self._rebuild, self._unfinished, self._outgrown = None, False, False
        self._clear()

    def _rescue(self) -> None:
        """Rebuild iSAM2 after an exception. If the graph is indeterminate, add priors on landmarks, then also on poses."""
        self.rebuilds += 1
        self._stale = False
        loose = [point_prior(j, point, HELD) for j, point in self._at.points.items()]
        afloat = [pose_prior(k, pose, UNKNOWN_TURN, UNKNOWN_WAY) for k, pose in self._at.poses.items()]
        for held in ([], loose, loose + afloat):
            graph = self._store.graph()
            graph.push_back(build_graph(held))
            try:
                self._at.read(levenberg_marquardt(graph, self._at.values(), 10, 1e-4).values)
                self._fill(graph)
                return
            except (RuntimeError, SolveError) as error:
                reason = error if isinstance(error, SolveError) else indeterminate(error)
        raise SolveError(f"the graph cannot be rebuilt: {reason.message}", hint=reason.hint)

    def _covariance(self, key: int, dimension: int) -> Floats:
        try:
            return np.asarray(self._isam.marginalCovariance(key))
        except RuntimeError:
            return np.full((dimension, dimension), np.nan)


def _groups(layout: dict[int, int]) -> gtsam.KeyGroupMap | None:
    """Return a layout in the form that iSAM2 takes, None for an empty one."""
    if not layout:
        return None
    groups = gtsam.KeyGroupMap()
    for key, group in layout.items():
        groups.insert2(key, group)
    return groups
