"""Errors of given poses that last for some seconds. All rays of this time miss their objects on the same side.

Poses in a plane turn and shift rays to the left or to the right. Poses in 3D turn and shift them up or down as well. Many
rays from one visit do not average such an error out, so they count as few. The rays of several visits show its size.
"""

from dataclasses import dataclass, replace

import numpy as np

from objslam.association.observations import MIN_DEPTH
from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import is_planar
from objslam.core.ground.flattening import flattened_lines, flattened_points, raised_points
from objslam.core.ground.rise import rise_of
from objslam.core.rotation import cross
from objslam.frontend.up import upright
from objslam.graph.fixed_pose_triangulation import flat_noise, noise_of_poses, noise_up
from objslam.graph.robust_cost import ray_information
from objslam.mapping.solution import Solution

_CELL = 1.0
"""The length (s) of the shortest cell. The rays of an object in one cell count as one ray. A longer time is faster, and sees
shorter errors as noise."""
_MOST_CELLS = 48
"""The most cells of an object. The cells of an object that was seen for long are longer. A larger number is finer and
slower."""
_TIMES = (1.0, 4.0, 16.0, 64.0)
"""The correlation times (s) of errors, after which the correlation is 1/e. The shortest fits a jump of a scan matcher, the
longest an error of the map around a place. More times are finer and slower."""
_FACTORS = np.append(0.0, np.geomspace(0.1, 20.0, 40))
"""The tried standard deviations of lasting errors, as multiples of the noise in `localization`. More factors are finer and
slower."""
_LOOSE = 1.0
"""The prior standard deviation (m) of the error of a solved position. With a larger value, the rays decide more."""
_POOLED = 20.0
"""With this many rays, the scatter inside cells weighs as much as the noise in the settings. A larger number trusts the
settings more."""


@dataclass(frozen=True)
class Cells:
    """The misses of the rays of one object along one axis, by time, in C cells.

    times: (C,) s. mean: (C,) rad, the mean angle by which the rays pass the object to the left, or above it. white: (C,)
    rad, the standard deviation of the mean from noise that does not last. shift: (C, n) rad per m, the derivative of the
    mean by n coordinates of the object. size: (C,) rad, the error of the mean by one standard deviation of the poses. pull:
    (C, 3) m, the shift of the object by such an error in the cell.
    """

    times: Floats
    mean: Floats
    white: Floats
    shift: Floats
    size: Floats
    pull: Floats

    def alike(self, time: float) -> Floats:
        """Return the correlations (C, C) of errors that last for `time`, s."""
        return np.asarray(np.exp(-np.abs(self.times[:, None] - self.times) / time))


def with_lasting_errors(solution: Solution, settings: Settings) -> Solution:
    """Return the solution of a run at given poses with their lasting errors added to its covariances.

    A pose has an error of its heading and an error of its place. Both turn a ray to a side, as seen from the object. If the
    poses are not in a plane, they have such errors along each axis, and also turn a ray up or down. On uneven ground, planar
    poses turn rays up and down by `planar` times a factor of its own, and ground whose tilt lasts also rises (`rise_of`).
    The size of the errors is `localization` times a factor with a half-normal prior of 1. Their correlation falls
    exponentially over time. The factor and the correlation time are estimated by restricted maximum likelihood (Patterson
    and Thompson 1971), and averaged over their posterior.
    """
    if not solution.keyframes.localized_every:
        return solution
    seen = _cells_of(solution, settings)
    if not any(seen):
        return solution
    from objslam.graph.posterior.marginals import largest_sigma  # Here, so that `load_libraries` comes first.

    covariance = solution.estimate.covariance.copy()
    for alike in seen:
        variance = lasting_variances([cells for _, cells in alike])
        for j, cells in alike:
            kernel = sum(v * cells.alike(time) for v, time in zip(variance.tolist(), _TIMES, strict=True))
            covariance[j] += cells.pull.T @ kernel @ cells.pull
    if (tilt := noise_up(solution.keyframes, settings)[0]) > 0:  # The variance of the last list is that of the ground.
        at = solution.keyframes
        covariance[:, 2, 2] += rise_of(at.stamps, at.map_T_base, tilt * np.sqrt(variance), np.array(_TIMES)) ** 2
    wider = replace(solution.estimate, covariance=covariance, seen_sigma=largest_sigma(covariance))
    return replace(solution, estimate=wider)


def lasting_variances(seen: list[Cells]) -> Floats:
    """Return the expected squared factor of the errors that last for each of `_TIMES`. The sum over these times is the
    squared factor of all errors.

    seen: the cells of each object along each axis.
    """
    likelihood = np.tile(-0.5 * _FACTORS**2, (len(_TIMES), 1))
    for cells in seen:
        shift, mean = cells.shift / cells.white[:, None], cells.mean / cells.white
        own = np.outer(cells.size / cells.white, cells.size / cells.white)
        for row, time in zip(likelihood, _TIMES, strict=True):
            size, vectors = np.linalg.eigh(own * cells.alike(time))
            y, x = vectors.T @ mean, vectors.T @ shift
            variance = 1 + _FACTORS[:, None] ** 2 * np.maximum(size, 0.0)
            matrix = np.einsum("ki,kj,sk->sij", x, x, 1 / variance) + np.eye(x.shape[1]) / _LOOSE**2
            vector = np.einsum("ki,k,sk->si", x, y, 1 / variance)
            explained = (vector * np.linalg.solve(matrix, vector[..., None])[..., 0]).sum(axis=1)
            row -= 0.5 * ((y**2 / variance + np.log(variance)).sum(axis=1) + np.linalg.slogdet(matrix)[1] - explained)
    weight = np.exp(likelihood - likelihood.max()) * np.gradient(_FACTORS)
    return np.asarray((weight * _FACTORS**2).sum(axis=1) / weight.sum())


def _cells_of(solution: Solution, settings: Settings) -> list[list[tuple[int, Cells]]]:
    """Return the index of an object and its cells along one axis, for each object with a covariance and each axis. Rejected
    rays, and ranges, do not count. The errors of one list have one size and one correlation time."""
    keyframes, estimate, association = solution.keyframes, solution.estimate, solution.association
    placed = np.isfinite(estimate.covariance[:, 0, 0]) & np.isfinite(estimate.positions[:, 0])
    which = np.flatnonzero((estimate.weight > 0) & (association.object >= 0))
    which = which[placed[association.object[which]]]
    if not len(which):
        return []
    rays, owner, count = solution.rays.take(which), association.object[which], len(placed)
    up = upright(keyframes)
    origin, direction = (values @ up.T for values in rays.in_map(keyframes.map_T_camera))
    to = estimate.positions[owner] @ up.T - origin
    level = np.maximum(np.hypot(to[:, 0], to[:, 1]), MIN_DEPTH)
    distance = np.maximum(np.linalg.norm(to, axis=1), MIN_DEPTH)
    left = np.column_stack([-to[:, 1], to[:, 0], np.zeros(len(to))]) / level[:, None]
    yaw, place = noise_of_poses(keyframes, settings)

    tilt, z = noise_up(keyframes, settings)
    sigma, _, scale = flat_noise(rays, keyframes, settings)
    across = np.hypot(sigma * distance, place)
    strength = 1 / across if settings.fixed.loss == "l1" else across**-2
    along = np.where(np.isfinite(rays.range), rays.range_sigma**-2, 0.0)
    # The solve is in a flattened world on uneven ground, so a ray has more weight to the sides than up and down.
    information = ray_information(flattened_lines(origin, direction, scale)[1], strength, along, owner, count)
    held = np.linalg.eigvalsh(information)[:, 0] > 0
    inverse = np.zeros_like(information)
    inverse[held] = np.linalg.inv(information[held])
    inverse = raised_points(flattened_points(inverse, scale).swapaxes(1, 2), scale).swapaxes(1, 2)

    times = keyframes.stamps[rays.keyframe]
    turned = np.maximum(np.hypot(direction[:, 0], direction[:, 1]), 1e-6)
    miss = (direction * left).sum(axis=1) / turned
    found = [_by_cell(times, owner, miss, rays.sigma * distance / level, left, level, (yaw, place), strength, inverse)]
    in_space, uneven = not is_planar(keyframes.map_T_base), tilt > 0 or z > 0
    if in_space or uneven:
        above = cross(to / distance[:, None], left)
        miss = (direction * above).sum(axis=1)
        noise = (yaw, place) if in_space else (tilt, z)
        raised = _by_cell(times, owner, miss, rays.sigma, above, distance, noise, strength, inverse)
        found = [found[0] + raised] if in_space else [*found, raised]
    return [[(number, replace(cells, pull=cells.pull @ up)) for number, cells in alike] for alike in found]


def _by_cell(
    times: Floats,
    owner: Ints,
    miss: Floats,
    white: Floats,
    axis: Floats,
    lever: Floats,
    noise: tuple[float, float],
    strength: Floats,
    inverse: Floats,
) -> list[tuple[int, Cells]]:
    """Return the index and the cells of each object, from misses along one axis.

    times: (R,) s. owner: (R,) objects. miss: (R,) rad, and white: (R,) rad, its noise. axis: (R, 3) the unit vector, and
    lever: (R,) m, the distance, at which the miss moves an object. noise: of headings, rad, and of places, m. strength: (R,)
    the weight of each ray in the solve. inverse: (N, 3, 3) of the information about each object.
    """
    size = np.hypot(noise[0], noise[1] / lever)
    first, cell = _cells(times, owner, len(inverse))
    weight = white**-2
    total = np.bincount(cell, weight)

    def mean(values: Floats) -> Floats:
        return np.asarray(np.bincount(cell, weight * values) / total)

    within = miss - mean(miss)[cell]
    free = len(cell) - len(total)
    scatter = ((within / white) ** 2).sum()
    factor = np.sqrt((scatter + _POOLED) / (free + _POOLED))
    pull = np.zeros((len(total), 3))
    np.add.at(pull, cell, (strength * size * lever)[:, None] * axis)
    columns = mean(times), mean(miss), factor / np.sqrt(total), mean(size)
    shift = np.column_stack([mean(axis[:, k] / lever) for k in range(3)])
    pull = np.einsum("cij,cj->ci", inverse[first], pull)
    seen, begin = [], 0
    for end in (np.flatnonzero(np.diff(first, append=len(inverse))) + 1).tolist():
        mine = slice(begin, end)
        when, missed, noisy, sized = (column[mine] for column in columns)
        seen.append((int(first[begin]), Cells(when, missed, noisy, shift[mine], sized, pull[mine])))
        begin = end
    return seen


def _cells(times: Floats, owner: Ints, count: int) -> tuple[Ints, Ints]:
    """Return the object of each cell, in order, and the cell of each ray (R,)."""
    width = np.full(count, _CELL)
    while True:
        number = np.floor((times - times.min()) / width[owner]).astype(np.int64)
        pairs, cell = np.unique(np.column_stack([owner, number]), axis=0, return_inverse=True)
        many = np.bincount(pairs[:, 0], minlength=count) > _MOST_CELLS
        if not many.any():
            return pairs[:, 0], cell.ravel()
        width[many] *= 2
