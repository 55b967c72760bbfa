"""Other starts of a joint solve from odometry (multi-start; Martí 2003), and the one that explains the rays best.

A landmark enters the growing graph when its rays have enough parallax. At that time, its position follows from poses by
odometry alone. If these poses are wrong, the landmark may be metres off. Its rays then bend the path, and the solve ends in
a local minimum. Each later step only refines this minimum. A graph that grows with less or more parallax adds its landmarks
at other times, and seldom ends in the same wrong minimum.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.trace import Trace
from objslam.core.types import Association
from objslam.errors import SolveError
from objslam.graph.assembly import Measurements
from objslam.graph.init_known_correspondences import initialize_known
from objslam.graph.outlier_rejection import JointSolution

_PARALLAX = (0.5, 2.0)
"""The multiples of joint.min_parallax_deg with which other graphs grow. In three of 48 random parts of real drives, seen by
bearings only, the first graph led to landmarks that were 1 to 2 m off. All three parts were right with half of the parallax,
and two with twice the parallax. Two of the three graphs may end in one wrong minimum, so both values are used. More values
take longer."""
_FEW_RAYS = 1500
"""The number of rays above which no further start is tried after a start that ends in a known minimum. In some random parts
of real drives, the second start ended in the minimum of the first start. The third start then had a better minimum in 7 of
59 parts with fewer rays, and in 2 of 71 parts with more rays. A larger number makes logs of some minutes slower."""
_SAME = 0.1
"""Two solutions are in one minimum if no landmark differs by more than this share of the size of the map. In wrong minima of
real drives, at least one landmark differs by a third of the map's size or more. With a larger share, more solutions count as
equal, so fewer solutions are compared."""
_MOST_RAYS = 6000
"""The number of rays of a log above which its solve starts from one grown graph only. Such logs are drives of more than a
quarter of an hour, which see landmarks again and again. No wrong minimum was found in them. A larger number makes long logs
slower."""
_GROWN = 0.05
"""A grown graph is in a known minimum if no landmark differs by more than this share of the size of the map. Such a graph is
not solved. In 170 random parts of real drives, 85 graphs were in a known minimum, and no solve from them ended elsewhere. A
larger share saves more solves."""
_CLEARLY = 3.0
"""The least decrease of the misfit for which another start replaces the first start. The misfit is twice a logarithm of
odds. A larger value changes the start more rarely."""


@dataclass(frozen=True)
class MultiStart:
    """The search for the best start of a joint solve.

    solve: returns the solution that starts from poses (K, 4, 4) and positions (N, 3), and records it in a trace. misfit:
    returns how badly a solution explains the rays, after its shared errors were estimated.
    """

    measured: Measurements
    association: Association
    solve: Callable[[Floats, Floats, Trace | None], JointSolution]
    misfit: Callable[[JointSolution], float]

    def best(self, found: JointSolution, trace: Trace | None = None) -> JointSolution:
        """Return the solution with the least misfit: `found`, or one that begins at another growing graph.

        A range determines a position at once. So if at least half of the objects have a range, or if there are fiducials,
        the first solution is returned. It is also returned for a log with more than `_MOST_RAYS` rays. In a log with more
        than `_FEW_RAYS` rays, no further start is tried after a start that ends in a known minimum.
        """
        rays, object_ = self.measured.rays, self.association.object
        ranged = np.unique(object_[np.isfinite(rays.range) & (object_ >= 0)])
        if self.measured.tags is not None or 2 * len(ranged) >= self.association.count or len(rays) > _MOST_RAYS:
            return found
        solutions, traces = [found], [trace]
        for factor in _PARALLAX:
            aside = trace.aside() if trace is not None else None
            try:
                grown = initialize_known(_with_parallax(self.measured, factor), self.association, _silent, aside)
                near = _among(solutions, grown[1], _GROWN)
                other = found if near else self.solve(*grown, aside)
            except SolveError:
                continue  # A start without a solution is left out, because the first solution remains.
            if not near and not _among(solutions, other.positions, _SAME):
                solutions.append(other)
                traces.append(aside)
            elif len(rays) > _FEW_RAYS:
                break
        if len(solutions) == 1:
            return found
        misfits = [self.misfit(one) for one in solutions]
        best = int(np.argmin(misfits))
        if best == 0 or misfits[best] > misfits[0] - _CLEARLY:
            return found
        chosen = traces[best]
        if trace is not None and chosen is not None:
            trace.replace(chosen)
        return solutions[best]


def _among(solutions: list[JointSolution], positions: Floats, share: float) -> bool:
    """Return whether one of the solutions has the same landmarks as `positions` (N, 3), at places that differ by at most
    `share` times the size of its map."""
    return any(_in_one_minimum(one.positions, positions, share) for one in solutions)


def _in_one_minimum(one: Floats, other: Floats, share: float) -> bool:
    known = np.isfinite(one[:, 0])
    if not np.array_equal(known, np.isfinite(other[:, 0])):
        return False
    at = one[known]
    size = np.sqrt(((at - at.mean(axis=0)) ** 2).sum(axis=1).mean()) if len(at) else 0.0
    return bool((np.linalg.norm(other[known] - at, axis=1) <= share * size).all())


def _with_parallax(measured: Measurements, factor: float) -> Measurements:
    """Return the measurements with a multiple of joint.min_parallax_deg."""
    joint = measured.settings.joint
    joint = joint.model_copy(update={"min_parallax_deg": factor * joint.min_parallax_deg})
    return replace(measured, settings=measured.settings.model_copy(update={"joint": joint}))


def _silent(done: int, total: int) -> None:
    """Show no progress, because the first growth has already shown the whole progress."""
