"""The estimate of a growing graph by iSAM2: updates, rebuilds, and what is read off it.

An update that throws is no lost map: the graph is rebuilt from the stored factors, by Levenberg-Marquardt from the last good
estimate, which damps what nothing holds yet.
"""

from __future__ import annotations

import gtsam
import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.errors import SolveError
from objslam.graph.elimination_ordering import elimination_groups
from objslam.graph.factor_store import FactorStore
from objslam.graph.factors.odometry import UNKNOWN_TURN, UNKNOWN_WAY
from objslam.graph.factors.priors import point_prior, pose_prior
from objslam.graph.growing_graph import GrowingGraph
from objslam.graph.isam2_rebuild import IncrementalRebuild, new_isam
from objslam.graph.marginals import HELD, in_camera
from objslam.graph.optimizers import indeterminate, levenberg_marquardt
from objslam.graph.variables import L0, X0, Variables

_AT_ONCE = 400
"""The most keyframes of a graph that is rebuilt at once; larger lets a frame wait longer for it, smaller takes more frames
until a rebuild is done."""
_SLICE = 100
"""The keyframes of one slice of a rebuild; larger is done sooner, and lets a frame wait longer."""
_FRESH = 10
"""The updates after which a landmark that none of them was about has sunk in iSAM2's tree; larger lays the tree out less
often, and finds landmarks that come back deeper in it."""


class IncrementalGraph(GrowingGraph):
    """A growing graph and its estimate; `update` works in what was added.

    rebuilds: how often an update threw and the graph was rebuilt.
    """

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self._isam = new_isam({})
        self._stale = self._unfinished = False
        self.rebuilds = 0

    def update(self) -> None:
        """Work in what was added."""
        self._updates += 1
        self._work_in()

    def prepare(self, coming: Ints, relinearise: bool = False) -> None:
        """Work in what was added, and lay the tree out for a keyframe that may show landmarks coming (n,), where it is not.

        The cliques between an observed variable and the root are eliminated again, so what may be observed goes near to the
        root. relinearise: look for variables that moved, too.
        """
        sunk = any(self._touched.get(j, -_FRESH) <= self._updates - _FRESH for j in coming.tolist())
        if relinearise or sunk or self._new.size():
            self._work_in(relinearise, self._layout(coming))
            shown = {j: number for j, number in self._touched.items() if number == self._updates}
            self._touched = {**dict.fromkeys(coming.tolist(), self._updates - 1), **shown}  # the others may have sunk
        if self._newest in self._at.poses:
            self.pose(self._newest)  # solves for what the updates left unsolved

    def pose(self, k: int) -> Floats:
        """map_T_camera (4, 4) of X(k) as of now."""
        if self._stale and not self._values.exists(X0 + k):
            self._at.poses[k] = self._isam.calculateEstimatePose3(X0 + k).matrix()
        return self._at.poses[k]

    def points(self, landmarks: Ints) -> Floats:
        """(n, 3) the places of landmarks as of now."""
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
        """(n, 4, 4) the poses of keyframes as of the last `refresh`."""
        return np.array([self._at.poses[k] for k in keyframes.tolist()]).reshape(-1, 4, 4)

    def variable(self, key: int) -> gtsam.Pose3 | Floats:
        """What `add_variable` added, as of the last `refresh`."""
        return self._at.others[key]

    def pose_covariance(self, k: int) -> Floats:
        """Covariance (6, 6) of X(k), rotation first, in the camera's frame; NaN where the graph does not tell."""
        return self._covariance(X0 + k, 6)

    def point_covariance(self, j: int) -> Floats:
        """Covariance (3, 3) of L(j), m^2; NaN where the graph does not tell."""
        return self._covariance(L0 + j, 3)

    def seen_covariance(self, j: int, k: int) -> Floats:
        """Covariance (3, 3) of L(j) in the frame of X(k), m^2, as `marginals.seen_covariances` has it; NaN likewise.

        That takes about a millisecond for a keyframe near to the root, as the newest are, and a hundred for another.
        """
        try:
            joint = self._isam.jointMarginalCovariance([X0 + k, L0 + j])
        except (RuntimeError, IndexError):  # indeterminate, or not worked in yet
            return np.full((3, 3), np.nan)
        return in_camera(joint, k, j, self.pose(k), self.points(np.array([j]))[0])

    def save(self) -> tuple[FactorStore, Variables]:
        """What `restore` goes back to."""
        self.refresh()
        return self._store.copy(), self._at.copy()

    def restore(self, saved: tuple[FactorStore, Variables]) -> None:
        """The graph as it was when it was saved."""
        self._store, self._at = saved
        self._newest, self._touched = max(self._at.poses, default=-1), {}
        self._stale = False
        self._fill(self._store.graph())
        self._clear()

    def solve(self, iterations: int, tolerance: float = 1e-5) -> None:
        """All variables by Levenberg-Marquardt from where they are, and iSAM2 rebuilt from there.

        Args:
            iterations: the most steps.
            tolerance: the share of the cost below which a step gains no more.
        Raises:
            SolveError: the cost runs away, or nothing holds some variable; nothing has changed then.
        """
        self.refresh()
        self._at.read(levenberg_marquardt(self._store.graph(), self._at.values(), iterations, tolerance).values)
        self.rebuild()

    def rebuild(self) -> None:
        """iSAM2 rebuilt from the stored factors, linearised where the estimate is now."""
        self.refresh()
        try:
            self._fill(self._store.graph())
        except RuntimeError:
            self.rebuilds += 1
            self._rescue()
        self._clear()

    def rebuild_in_slices(self, order: Ints) -> None:
        """As `rebuild`, in slices, one for each call of `continue_rebuild`; the old graph goes on until all are done.

        order: all keyframes (K,), each after the one that its motion comes from. Asked for once more before it is done, it
        is done at once: changes that come so often must not keep it from ever being done.
        """
        if self._unfinished or len(order) <= _AT_ONCE:
            self.rebuild()
            return
        self.refresh()
        self._clear()
        self._rebuild = IncrementalRebuild(self._store.copy(), order.tolist(), self._at.copy())
        self._unfinished = True

    @property
    def is_rebuilding(self) -> bool:
        """Whether `rebuild_in_slices` is not done yet."""
        return self._unfinished

    def continue_rebuild(self) -> None:
        """Go on with what `rebuild_in_slices` began, if it did."""
        if self._rebuild is None:
            return
        try:
            if not self._rebuild.last:
                self._rebuild.step(_SLICE)
                return
            self.refresh()
            self._rebuild.finish(self._at)
        except RuntimeError:  # all at once, which knows what to do then
            self.rebuild()
            return
        self._clear()  # what was not worked in yet is in the new one, too
        self._isam, self._stale = self._rebuild.isam, True
        self._rebuild, self._unfinished = None, False

    def _work_in(self, relinearise: bool = False, layout: dict[int, int] | None = None) -> None:
        try:
            if self._outgrown:
                self.refresh()
                self._fill(self._store.graph())
            else:
                self._update(relinearise, layout or {})
        except (RuntimeError, ValueError):  # indeterminate, or no such layout: counted, and goes on from the stored factors
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
        last, reordered = gtsam.KeyGroupMap(), gtsam.KeyList()
        for key, group in layout.items():
            last.insert2(key, group)
            if self._isam.valueExists(key):
                reordered.push_back(key)
        self._isam.update(self._new, self._values, [], last if layout else None, None, reordered, relinearise)

    def _clear(self) -> None:
        self._new, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def _fill(self, graph: gtsam.NonlinearFactorGraph) -> None:
        isam = new_isam(self._at.others)
        isam.update(graph, self._at.values())
        isam.calculateEstimate()  # throws now, if it does
        self._isam = isam
        self._stale = True
        self._rebuild, self._unfinished, self._outgrown = None, False, False

    def _rescue(self) -> None:
        """iSAM2 rebuilt after it threw, with priors on landmarks and poses that nothing holds, as strong as it takes."""
        self._stale = False
        loose = [point_prior(j, point, HELD) for j, point in self._at.points.items()]
        afloat = [pose_prior(k, pose, UNKNOWN_TURN, UNKNOWN_WAY) for k, pose in self._at.poses.items()]
        for held in ([], loose, loose + afloat):
            graph = self._store.graph()
            for factor in held:
                graph.push_back(factor)
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
