"""A Markov random field over crossings of rays, as a peer: Krylov, Kenny and Dahyot, Automatic Discovery and Geotagging of
Objects from Street View Imagery, Remote Sensing 2018. Written from the paper, with its weights.

Each crossing of two rays is a site, on or off. The energy of a ray is what its crossings miss its depth by, and how far
they lie apart. A ray without a crossing costs a constant. Iterated conditional modes flip random sites. Then crossings that
are on are clustered.
"""

from __future__ import annotations

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from objslam.core.arrays import Floats, Ints

_DEPTH, _APART = 0.2, 0.2
"""alpha and beta of Eq. 4, per m. A ray without a crossing costs 1 - alpha - beta."""
_REACH = 25.0
"""The greatest distance of an object from a camera, m."""
_SWEEPS = 15
"""How often each ray is tried, on average."""
_CLUSTER = 1.0
"""The greatest distance between two crossings of one cluster, m."""


def locate(origin: Floats, heading: Floats, depth: Floats, place: Ints, seed: int, cluster: float = _CLUSTER) -> Floats:
    """Return the positions (N, 2) m of the objects. origin: (R, 2) m. heading: (R,) rad. depth: (R,) m. place: (R,) the
    camera place of each ray. cluster: m."""
    count = len(origin)
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    between = origin[None] - origin[:, None]
    cross = ahead[:, None, 0] * ahead[None, :, 1] - ahead[:, None, 1] * ahead[None, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (between[..., 0] * ahead[None, :, 1] - between[..., 1] * ahead[None, :, 0]) / cross
    meet = (along > 0) & (along < _REACH) & (place[:, None] != place[None])
    meet &= meet.T
    options = [np.flatnonzero(row) for row in meet]
    on = np.zeros((count, count), dtype=bool)

    def energy(ray: int) -> float:
        at = along[ray, on[ray]]
        if not len(at):
            return 1 - _DEPTH - _APART
        return float(_DEPTH * np.abs(at - depth[ray]).sum() + _APART * np.ptp(at))

    rng = np.random.default_rng(seed)
    for ray in rng.integers(count, size=_SWEEPS * count).tolist():
        if not len(options[ray]):
            continue
        other = int(rng.choice(options[ray]))
        before = energy(ray) + energy(other)
        on[ray, other] = on[other, ray] = not on[ray, other]
        if energy(ray) + energy(other) > before:
            on[ray, other] = on[other, ray] = not on[ray, other]
    used = np.flatnonzero(on.any(axis=1))
    if not len(used):
        return np.zeros((0, 2))
    reach = np.array([along[ray, on[ray]].mean() for ray in used])
    points = origin[used] + reach[:, None] * ahead[used]
    group = fcluster(linkage(points), cluster, criterion="distance") - 1 if len(points) > 1 else np.zeros(1, dtype=np.int64)
    return np.array([points[group == g].mean(axis=0) for g in range(int(group.max()) + 1)])
