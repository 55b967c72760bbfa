"""Add the errors of given poses that last for some seconds to the covariances of a map.

During such an error, all rays miss their objects on the same side. Errors of poses in a plane turn and shift rays to the
left or to the right. Errors of poses in 3D also turn and shift rays up or down. Many rays from one visit do not average such
an error out, so they count as few rays. The rays of several visits show the size of the error."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from objslam.association.observations import MIN_DEPTH
from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import is_planar
from objslam.core.ground.flattening import flattened_lines, flattened_points, raised_points
from objslam.core.ground.rise import rise_of
from objslam.core.rotation import cross
from objslam.core.types import Keyframes, Log
from objslam.frontend.up import upright
from objslam.graph.fixed_pose_triangulation import flat_noise, noise_of_poses, noise_up
from objslam.graph.robust_cost import ray_information
from objslam.mapping.checks.finding import Finding
from objslam.mapping.fixed.lasting_noise import TIMES, Cells, LastingNoise, lasting_variances
from objslam.mapping.moves.odometry_witness import odometry_contradicts
from objslam.mapping.solution import Solution, as_centres

_CELL = 1.0
"""The length (s) of the shortest cell. The rays of an object in one cell count as one ray. With a longer cell, the estimate
is faster, but more of the short errors count as noise."""
_MOST_CELLS = 48
"""The most cells of an object. If an object would have more cells, the length of its cells is doubled until they are few
enough. With a larger number, cells are shorter, and the estimate is slower."""
_LARGE = 1.0
"""The least size of errors of given poses that last for seconds, as a multiple of the noise `localization`, at which a run
warns. At 1, the lasting errors alone are as large as all errors together should be. With a larger value, runs warn less
often."""
_LARGE_WITH_ODOMETRY = 0.75
"""The least size, as for `_LARGE`, if the odometry also says that the poses err for seconds. It is smaller, because false
objects take up a part of the errors, so the boxes show too small errors. With a larger value, runs warn less often."""
_FEWEST = 3
"""The fewest objects that must show lasting errors, so that a run warns. All boxes of one object may lie beside the object
in the same way for seconds, so one object says little about the poses. With a larger number, runs warn less often."""
_SMALL = 0.2
"""The multiple of the noise `localization` above which lasting errors are estimated again, with the boxes moved to the
centres of bodies. With a larger value, runs take less time, but errors of the boxes of large things count as errors of
poses."""
LASTING = "lasting localisation errors"
"""The name of the finding that given poses err for seconds."""
_POOLED = 20.0
"""The number of rays with which the scatter inside cells weighs as much as the noise in the settings. With a larger number,
the settings weigh more."""


def with_lasting_errors(
    solution: Solution, settings: Settings, with_bodies: Callable[[Solution], Solution] | None = None
) -> tuple[Solution, LastingNoise | None]:
    """Return the solution of a run at given poses, with the lasting errors of the poses added to its covariances. Also
    return these errors. They are None if the log does not show them, or if the poses are not planar.

    A pose has an error of its heading and an error of its place. Both turn a ray to a side, as seen from the object. Poses
    that are not in a plane have such errors along each axis, which also turn a ray up or down. On uneven ground, planar
    poses also turn rays up or down. The size of this error is the noise `planar` times a factor of its own. Ground whose
    tilt lasts also rises or falls (`rise_of`). The size of the other errors is the noise `localization` times a factor. The
    prior of the factor is half-normal with the scale 1. The correlation of the errors falls exponentially over time. The
    factor and the correlation time are averaged over their posterior, with a restricted likelihood (Patterson and Thompson
    1971).

    While a robot drives past a large thing, the centre of the thing's box lies beside the image of the thing's centre.
    with_bodies: a function that finds the bodies, so that the boxes can count as if they were around the centres. It is
    called only for errors above `_SMALL`. The returned solution then has the bodies.
    """
    if not solution.keyframes.localized_every:
        return solution, None
    seen = cells_of(solution, settings)
    if not seen:
        return solution, None
    added = np.zeros(solution.estimate.covariance.shape)
    found = [lasting_variances(cells) for cells in seen]
    if with_bodies is not None and max(one.sum() for one in found) > _SMALL**2:
        solution = with_bodies(solution)
        seen = cells_of(as_centres(solution), settings)
        found = [lasting_variances(cells) for cells in seen]
    for cells, variances in zip(seen, found, strict=True):
        objects, more = cells.covariances(variances)
        added[objects] += more
    if noise_up(solution.keyframes, settings)[0] > 0:  # The variances of the last cells are those of the ground.
        added[:, 2, 2] += rise_of_ground(solution.keyframes, found[-1], settings) ** 2
    solution = with_covariances(solution, added)
    if not is_planar(solution.keyframes.map_T_base):  # A camera in the hand keeps its view, so errors of boxes last as well.
        return solution, None
    noise = LastingNoise.of(seen[0], found[0], *noise_of_poses(solution.keyframes, settings))
    return solution, noise


def rise_of_ground(keyframes: Keyframes, variances: Floats, settings: Settings) -> float:
    """Return the standard deviation (m) of the height of uneven ground whose tilts last (`rise_of`).

    variances: (2, T) of the misses up and down, as in `lasting_variances`.
    """
    tilts = noise_up(keyframes, settings)[0] * np.sqrt(variances[0])
    return rise_of(keyframes.stamps, keyframes.map_T_base, tilts, np.array(TIMES))


def with_covariances(solution: Solution, added: Floats) -> Solution:
    """Return the solution with larger covariances of its objects and their bodies. added: (N, 3, 3) m^2."""
    from objslam.graph.posterior.marginals import largest_sigma  # Here, so that `load_libraries` comes first.

    wider = solution.estimate.with_errors(added)
    wider = replace(wider, seen_sigma=largest_sigma(wider.covariance))
    if solution.bodies is None:
        return replace(solution, estimate=wider)
    each = zip(solution.bodies, added, strict=True)
    return replace(
        solution, estimate=wider, bodies=tuple(None if body is None else body.with_errors(more) for body, more in each)
    )


def check_lasting_noise(noise: LastingNoise, settings: Settings, log: Log) -> Finding | None:
    """Return a finding if errors of given poses last for seconds, and are larger than the settings say.

    All rays of these seconds miss their objects to the same side, so an object can become two. The covariances of the map
    contain these errors. log: the log whose odometry is a second witness.
    """
    said = settings.localization
    size = max(noise.yaw / max(said.yaw, 1e-12), noise.xy / max(said.xy, 1e-12))
    if noise.objects < _FEWEST or size < _LARGE_WITH_ODOMETRY:
        return None
    if size < _LARGE and not odometry_contradicts(log, settings):
        return None
    return Finding(
        LASTING,
        f"all boxes of some seconds miss their objects together: the poses err by {np.degrees(noise.yaw):.2g} deg and "
        f"{100 * noise.xy:.2g} cm for about {noise.seconds:.0f} s, but localization.yaw and localization.xy say "
        f"{np.degrees(said.yaw):.2g} deg and {100 * said.xy:.2g} cm. Something may be in the map twice. A joint solve "
        "corrects such poses (--mode joint)",
        spoils=False,
    )


def cells_of(solution: Solution, settings: Settings) -> list[Cells]:
    """Return the cells of all objects with a covariance, at the poses of the keyframes. For planar poses on uneven ground,
    the list has a second item, with the misses up and down. Rejected rays and ranges do not count."""
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
    in_space, uneven = not is_planar(keyframes.map_T_base), tilt > 0 or z > 0
    axes = np.ones(3) if in_space else np.array([0.0, 0.0, 1.0])  # Planar poses turn about the vertical axis only.
    turn = cross(direction, left) / turned[:, None] * (yaw * axes)
    move = place * left / level[:, None]
    found = [_by_cell(times, owner, miss, rays.sigma * distance / level, left, level, (turn, move), strength, inverse)]
    if in_space or uneven:
        above = cross(to / distance[:, None], left)
        miss = (direction * above).sum(axis=1)
        angle, shift = (yaw * axes, place * axes) if in_space else (tilt * (1 - axes), z * axes)
        turn, move = cross(direction, above) * angle, above / distance[:, None] * shift
        raised = _by_cell(times, owner, miss, rays.sigma, above, distance, (turn, move), strength, inverse)
        found = [_joined(found[0], raised)] if in_space else [*found, raised]
    return [replace(cells, pull=cells.pull @ up) for cells in found]


def _by_cell(
    times: Floats,
    owner: Ints,
    miss: Floats,
    white: Floats,
    axis: Floats,
    lever: Floats,
    errors: tuple[Floats, Floats],
    strength: Floats,
    inverse: Floats,
) -> Cells:
    """Return the cells of all objects, from misses along one axis.

    times: (R,) s, of the rays. owner: (R,) the object of each ray. miss: (R,) rad, the angle by which each ray misses its
    object. white: (R,) rad, the noise of the miss. axis: (R, 3) the unit vector along which the miss is. lever: (R,) m, the
    distance over which the miss moves the object. errors: two arrays (R, 3), rad, the miss by one standard deviation of
    rotations and of places, about or along each axis. strength: (R,) the weight of each ray in the solve. inverse: (N, 3, 3)
    the inverse of the information about each object.
    """
    first, cell = _cells(times, owner, len(inverse))
    weight = white**-2
    total = np.bincount(cell, weight)

    def mean(values: Floats) -> Floats:
        """Return the means (C,) of values (R,), or (C, n) of values (R, n)."""
        columns = np.atleast_2d(values.T)
        means = np.column_stack([np.bincount(cell, weight * column) / total for column in columns])
        return means if values.ndim > 1 else means[:, 0]

    within = miss - mean(miss)[cell]
    free = len(cell) - len(total)
    scatter = ((within / white) ** 2).sum()
    factor = np.sqrt((scatter + _POOLED) / (free + _POOLED))
    pull = np.zeros((len(total), 3))
    np.add.at(pull, cell, (strength * lever)[:, None] * axis)
    pull = np.einsum("cij,cj->ci", inverse[first], pull)
    turn, move = errors
    noise = factor / np.sqrt(total)
    return Cells(first, mean(times), mean(miss), noise, mean(axis / lever[:, None]), mean(turn), mean(move), pull)


def _joined(one: Cells, other: Cells) -> Cells:
    """Return the cells of `one` and of `other`, in the order of objects."""
    both = Cells(*(np.concatenate(pair) for pair in zip(vars(one).values(), vars(other).values(), strict=True)))
    return both.take(np.argsort(both.owner, kind="stable"))


def _cells(times: Floats, owner: Ints, count: int) -> tuple[Ints, Ints]:
    """Return the object (C,) of each cell, in the order of objects, and the cell (R,) of each ray."""
    width = np.full(count, _CELL)
    while True:
        number = np.floor((times - times.min()) / width[owner]).astype(np.int64)
        pairs, cell = np.unique(np.column_stack([owner, number]), axis=0, return_inverse=True)
        many = np.bincount(pairs[:, 0], minlength=count) > _MOST_CELLS
        if not many.any():
            return pairs[:, 0], cell.ravel()
        width[many] *= 2
