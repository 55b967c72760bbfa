"""Solve Eq. 1 of Staszak & Belter: find the point with the least sum of distances to lines, for many objects at once.

Newton's method solves most objects in a few steps. If a line passes through or near the solution, the distance has no smooth
derivative there. `off_nearest_line` and then `smoothed_newton` solve such objects.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import numpy as np

from objslam.core.array_module import Tensor, as_numpy, as_tensor, backend_of, indices_of
from objslam.triangulation.bundle import Bundle
from objslam.triangulation.line_block import (
    LineBlock,
    dot,
    full,
    gather,
    norm,
    perpendicular,
    solve_symmetric,
    through,
)
from objslam.triangulation.newton import approach, newton, off_nearest_line
from objslam.triangulation.smoothed_newton import finish

_PLACES = {"numpy": 1 << 14, "cpu": 1 << 16, "cuda": 1 << 24}
"""The most rays, with fillers, in one block, for each backend. Smaller blocks need more calls, and a call of torch costs
more than a call of numpy. Larger blocks do not fit into the cache of a CPU. Blocks four times as large take 1.1 times as
long in numpy, and 1.2 times in torch. On CUDA, a ray needs 0.5 kB. On an H100, 5,000,000 rays took 497 ms with 2^18, and 161
ms with 2^22 up to 2^26."""
_ROUNDS = 3
"""The most rounds of `off_nearest_line` for the objects with a line near the solution. `smoothed_newton` solves the rest.
More rounds leave fewer objects for `smoothed_newton`."""
_FEW = 1 << 16
"""The most rays, with fillers, that `smoothed_newton` solves in numpy instead of torch. `smoothed_newton` needs hundreds of
calls for each step, and usually solves only a few objects of many thousands. With a larger number, CUDA is called less."""
_LEAST_REGULAR = 1e-6
"""The regularity of a matrix, from 0 to 1, below which its eigenvalues decide whether the lines fix a point. With a larger
value, eigenvalues are computed more often."""


@dataclass(frozen=True)
class PointSolution:
    """The solutions of Eq. 1 for N objects.

    point: (N, 3) m. determined: (N,) whether the rays fix the point. gradient: (N,) the norm of the gradient, NaN if the
    rays do not fix the point. iterations: the number of solver iterations.
    """

    point: Tensor
    determined: Tensor
    gradient: Tensor
    iterations: int


def least_squares(bundle: Bundle) -> tuple[Tensor, Tensor]:
    """Return the points (N, 3), m, with the least sum of squared distances to their rays, and a mask (N,) of unique points.

    The rays count as lines. A single ray and parallel rays fix no point. The result is then the point on the mean ray that
    lies 1 m ahead of the mean origin. It is NaN for an object without rays.
    """
    point, determined = _unsolved(bundle)
    for objects, rays, real in bundle.blocks(bundle.with_rays(), _places(bundle)):
        start, fixed = _closed_form(*gather(bundle, rays, real), bundle.xp)
        point[objects], determined[objects] = start.T, fixed
    return point, determined


def minimise_distances(bundle: Bundle) -> PointSolution:
    """Solve Eq. 1 for every object, from the start of `least_squares`.

    If lines pass through the solution, the gradient is the smallest subgradient that was found. A norm of 0 still proves the
    optimum. An object whose rays fix no point keeps the point of `least_squares` and gets a NaN gradient.
    """
    xp = bundle.xp
    point, determined = _unsolved(bundle)
    gradient = xp.full_like(point[:, 0], xp.nan)
    guess, left = xp.zeros_like(point), xp.zeros_like(determined)
    iterations = [0] * (_ROUNDS + 2)
    for objects, rays, real in bundle.blocks(bundle.with_rays(), _places(bundle)):
        origin, direction, weight = gather(bundle, rays, real)
        start, fixed = _closed_form(origin, direction, weight, xp)
        point[objects], determined[objects] = start.T, fixed
        lines, unit, meeting = _unit_lines(origin - start[:, None], direction, weight, xp)
        gradient[objects] = xp.where(fixed & meeting, xp.zeros_like(unit), xp.nan)
        solvable = fixed & ~meeting
        if not bool(solvable.all()):
            objects, lines, unit, start = objects[solvable], lines.select(solvable), unit[solvable], start[:, solvable]
        near, steps = approach(lines)
        step, rest, solved, more = newton(lines, near)
        iterations[0] = max(iterations[0], steps + more)
        point[objects] = (start + step * xp.where(solved, unit, 0.0)).T
        gradient[objects], guess[objects], left[objects] = rest, step.T, ~solved
    turn, number = 1, int(left.sum())
    while number:
        before, last = number, turn > _ROUNDS
        for objects, rays, real in bundle.blocks(indices_of(left), _places(bundle)):
            origin, direction, weight = gather(bundle, rays, real)
            start, near = point[objects].T, guess[objects].T
            lines, unit, _ = _unit_lines(origin - start[:, None], direction, weight, xp)
            if last:
                step, rest, steps = _finish(lines)
                solved = xp.ones_like(rest, dtype=xp.bool)
            else:
                step, rest, solved, steps = off_nearest_line(lines, near)
            iterations[turn] = max(iterations[turn], steps)
            point[objects] = (start + step * xp.where(solved, unit, 0.0)).T
            gradient[objects], guess[objects], left[objects] = rest, step.T, ~solved
        number = int(left.sum())
        # If the lines of objects are in one plane, they cross in the solution, and no round would solve any object.
        turn = turn + 1 if number < before else _ROUNDS + 1
    return PointSolution(point, determined, gradient, sum(iterations))


def _finish(lines: LineBlock) -> tuple[Tensor, Tensor, int]:
    """Return the result of `smoothed_newton.finish`. The lines of few objects are solved in numpy."""
    backend = backend_of(lines.weight)
    if backend == "numpy" or lines.weight.numel() > _FEW:
        return finish(lines)
    step, rest, steps = finish(LineBlock(as_numpy(lines.foot), as_numpy(lines.direction), as_numpy(lines.weight), np))
    return as_tensor(step, backend), as_tensor(rest, backend), steps


def _unsolved(bundle: Bundle) -> tuple[Tensor, Tensor]:
    xp = bundle.xp
    point = xp.full((len(bundle.number), 3), xp.nan, dtype=bundle.origin.dtype, device=bundle.origin.device)
    return point, xp.zeros_like(bundle.number, dtype=xp.bool)


def _places(bundle: Bundle) -> int:
    return _PLACES[backend_of(bundle.origin)]


def _closed_form(origin: Tensor, direction: Tensor, weight: Tensor, xp: ModuleType) -> tuple[Tensor, Tensor]:
    """Return the points (3, B), m, of `least_squares` for the B objects of a block, and a mask (B,) of the unique points.

    origin: (3, n, B) m. direction: (3, n, B) unit. weight: (n, B), 1 for a ray and 0 for a filler.
    """
    number = weight.sum(axis=0)
    base = (origin * weight).sum(axis=1) / number  # Large map coordinates would lose digits.
    # One projection is exact enough for squared distances.
    lines = LineBlock(perpendicular(origin - base[:, None], direction), direction, weight, xp)
    matrix, pull = lines.spread(weight), (lines.foot * weight).sum(axis=1)
    point, regular = solve_symmetric(matrix, pull, xp)
    determined = regular > _LEAST_REGULAR
    doubtful = indices_of(~determined)
    if len(doubtful):
        eigenvalues, vectors = xp.linalg.eigh(full(matrix[:, doubtful]))
        # An eigenvalue is the sum of squared sines between the lines and its axis.
        usable = eigenvalues > 1e-10 * number[doubtful, None]
        along = (vectors.mT @ pull[:, doubtful].T[:, :, None])[:, :, 0]
        least = (vectors @ xp.where(usable, along / xp.where(usable, eigenvalues, 1.0), 0.0)[:, :, None])[:, :, 0]
        heading = (direction * weight).sum(axis=1)[:, doubtful]
        ahead = vectors[:, :, 0].T
        ahead = xp.where(dot(ahead, heading) < 0, -ahead, ahead)
        unique = usable.all(axis=1)
        point[:, doubtful] = least.T + xp.where(unique, 0.0, ahead)
        determined[doubtful] = unique
    return base + point, determined


def _unit_lines(origin: Tensor, direction: Tensor, weight: Tensor, xp: ModuleType) -> tuple[LineBlock, Tensor, Tensor]:
    """Return lines in units of their mean distance from the coordinate origin, this unit (B,), m, and a mask (B,) of the
    objects whose lines all meet in the coordinate origin, up to rounding.

    Lines that meet there stay in m. The coordinate origin is a point of the object. origin: (3, n, B) m.
    """
    lines = through(origin, direction, weight, xp)
    number = weight.sum(axis=0)
    unit = (norm(lines.foot) * weight).sum(axis=0) / number
    meeting = unit <= 1e-14 * (norm(origin) * weight).sum(axis=0) / number
    return lines.scaled(1 / xp.where(meeting, 1.0, unit)), unit, meeting
