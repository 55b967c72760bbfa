"""Solve Eq. 1 of Staszak & Belter: find the point with the least sum of distances to lines, for many objects at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

_MAX_ITERATIONS = 80  # The most Newton steps. A solved object leaves the batch earlier.
_LATE_SMOOTHING = 1e-9  # The smoothing (in mean distances) below which an object gets only a few more Newton steps.
_LEAST_SMOOTHING = 1e-11  # The least smoothing (in mean distances). It is above the rounding errors.
_ON_LINE = (1e-7, 1e-5)  # The tried values of `on_line` in `_exact_optimum` (in mean distances).
_TINY = 1e-300  # The least divisor, so that 0 / 0 gives 0.


@dataclass(frozen=True)
class Lines:
    """Lines of many objects. foot: (R, 3) the point of each line nearest to the coordinate origin. direction: (R, 3) unit.
    index: (R,) the object of each line. count: the number N of objects."""

    foot: Tensor
    direction: Tensor
    index: Tensor
    count: int

    @classmethod
    def through(cls, origin: Tensor, direction: Tensor, index: Tensor, count: int) -> Self:
        """Make lines through the points `origin` (R, 3), in coordinates of their object, along unit directions (R, 3)."""
        # The first projection leaves a rounding error along the line of the size of the origin. The second removes it.
        return cls(perpendicular(perpendicular(origin, direction), direction), direction, index, count)

    def sum(self, values: Tensor) -> Tensor:
        """Return the sum (N, ...) of the values (R, ...) over the lines of each object."""
        return object_sum(values, self.index, self.count)

    def offset(self, points: Tensor) -> Tensor:
        """Return the perpendicular offset (R, 3) from each line to the point (N, 3) of its object. Eq. 1 sums the norms."""
        return perpendicular(points[self.index], self.direction) - self.foot

    def spread(self, weight: Tensor) -> Tensor:
        """Return the sum (N, 3, 3) of weight (R,) times I - n n^T over the lines of each object with directions n."""
        eye = torch.eye(3, dtype=weight.dtype, device=weight.device)
        return self.sum(weight)[:, None, None] * eye - self.outer(self.direction * weight[:, None], self.direction)

    def outer(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the sum (N, 3, 3) of (a b^T + b a^T) / 2 over the lines of each object, with vectors a, b (R, 3)."""
        (a0, a1, a2), (b0, b1, b2) = a.T, b.T
        off = (0.5 * (a0 * b1 + a1 * b0), 0.5 * (a0 * b2 + a2 * b0), 0.5 * (a1 * b2 + a2 * b1))
        six = self.sum(torch.stack([a0 * b0, a1 * b1, a2 * b2, *off], dim=1))
        return six[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].view(-1, 3, 3)

    def select(self, objects: Tensor) -> tuple[Lines, Tensor]:
        """Return the lines of the selected objects (N,), with new object numbers, and the mask (R,) of these lines."""
        rays = objects[self.index]
        number = torch.cumsum(objects, 0) - 1
        return Lines(self.foot[rays], self.direction[rays], number[self.index[rays]], int(objects.sum())), rays


def object_sum(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Return the sum (N, ...) of the values (R, ...) over the rays of each object."""
    return values.new_zeros((count, *values.shape[1:])).index_add_(0, index, values)


def perpendicular(vectors: Tensor, direction: Tensor) -> Tensor:
    """Return the part (R, 3) of each vector (R, 3) that is perpendicular to its unit direction (R, 3)."""
    return vectors - direction * dot(vectors, direction)[:, None]


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Return the dot products (R,) of vectors (R, 3)."""
    return (a * b) @ a.new_ones(3)  # This takes a tenth of the time of (a * b).sum(1).


def least_squares(origin: Tensor, direction: Tensor, index: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the points (N, 3) with the least sum of squared distances to their lines, and whether the lines fix them (N,).

    Parallel lines and a single line fix no point. The result is then the point of the mean line that lies 1 m ahead of the
    mean origin. It is NaN without lines.
    """
    number = object_sum(torch.ones_like(origin[:, 0]), index, count)
    base = object_sum(origin, index, count) / number[:, None]  # Map coordinates may be large.
    lines = Lines.through(origin - base[index], direction, index, count)
    eigenvalues, vectors = torch.linalg.eigh(lines.spread(torch.ones_like(origin[:, 0])))
    # An eigenvalue is the sum of squared sines between the lines and its axis.
    usable = eigenvalues > 1e-10 * number[:, None]
    pull = (vectors.mT @ lines.sum(lines.foot)[:, :, None])[:, :, 0]
    point = (vectors @ torch.where(usable, pull / torch.where(usable, eigenvalues, 1.0), 0.0)[:, :, None])[:, :, 0]
    determined = usable.all(dim=1)
    heading = object_sum(direction, index, count)
    ahead = vectors[:, :, 0]
    ahead = torch.where(dot(ahead, heading)[:, None] < 0, -ahead, ahead)
    return base + point + torch.where(determined[:, None], 0.0, ahead), determined


def minimise_distances(origin: Tensor, direction: Tensor, index: Tensor, start: Tensor) -> tuple[Tensor, int, Tensor]:
    """Solve Eq. 1 from the start (N, 3). Return the points (N, 3), the number of iterations, and the gradient norms (N,).

    If lines pass through the solution, the gradient is the smallest subgradient found. The value 0 still proves the optimum.
    The lines of each object must fix a point. Objects without lines keep their start.
    """
    lines = Lines.through(origin - start[index], direction, index, len(start))
    number = lines.sum(torch.ones_like(origin[:, 0])).clamp(min=1)
    unit = lines.sum(lines.foot.norm(dim=1)) / number
    reach = lines.sum((origin - start[index]).norm(dim=1)) / number
    meeting = unit <= 1e-14 * reach  # All lines meet at the start, up to rounding.
    scale = 1 / torch.where(meeting, 1.0, unit)
    lines, _ = replace(lines, foot=lines.foot * scale[index, None]).select(~meeting)
    point, dual, iterations = _smoothed_optimum(lines)
    smoothed, (point, gradient) = point, _exact_optimum(lines, point, dual, 0.0)
    for on_line in _ON_LINE:
        doubtful = gradient > 1e-10
        some, rays = lines.select(doubtful)
        other, rest = _exact_optimum(some, smoothed[doubtful], dual[rays], on_line)
        better = rest < gradient[doubtful]
        point[doubtful] = torch.where(better[:, None], other, point[doubtful])
        gradient[doubtful] = torch.where(better, rest, gradient[doubtful])
    result, norm = start.clone(), torch.zeros_like(unit)
    result[~meeting] += point * unit[~meeting, None]
    norm[~meeting] = gradient
    return result, iterations, norm


def _smoothed_optimum(lines: Lines) -> tuple[Tensor, Tensor, int]:
    """Minimise the sum of sqrt(distance^2 + epsilon^2) for all objects by primal-dual Newton, while epsilon goes to zero.

    The method is Andersen, Christiansen, Conn & Overton, SIAM J. Sci. Comput. 22 (2000), with Chan, Golub & Mulet's
    linearisation. It returns the points (N, 3), the dual (R, 3) of each line, and the number of iterations. The dual is the
    unit offset. If the solution lies on the line, the dual is another vector in the unit ball across the line. The unit of
    length is the mean distance of an object from its lines at the start.
    """
    zeros = lines.foot.new_zeros(lines.count)
    point, dual = zeros[:, None].repeat(1, 3), torch.zeros_like(lines.foot)
    live = torch.arange(lines.count, device=zeros.device)  # The unsolved objects.
    live_rays = torch.arange(len(lines.foot), device=zeros.device)
    number = lines.sum(torch.ones_like(lines.foot[:, 0])).clamp(min=1)
    o, epsilon, late = point.clone(), torch.ones_like(zeros), torch.zeros_like(zeros)
    q = lines.offset(o)
    y = q / _radius(q, epsilon[lines.index])[:, None]
    for iteration in range(_MAX_ITERATIONS):
        distance = q.norm(dim=1).clamp(min=_TINY)
        gradient = lines.sum(q / distance[:, None]).norm(dim=1)
        # Rounding limits the gradient: an offset is exact to 1e-16, and its direction to 1e-16 divided by its length.
        finished = gradient <= 4e-16 * lines.sum(1 + 1 / distance).clamp(max=1e6)
        finished |= late >= 4
        if finished.any():
            point[live], dual[live_rays] = o, y
            lines, rays = lines.select(~finished)
            live, live_rays = live[~finished], live_rays[rays]
            o, q, y, number = o[~finished], q[rays], y[rays], number[~finished]
            epsilon, late = epsilon[~finished], late[~finished]
        if lines.count == 0:
            return point, dual, iteration
        if iteration:
            gap = lines.sum(q.norm(dim=1) - dot(y, q)) / number
            residual = lines.sum(y).norm(dim=1) / number
            epsilon = torch.minimum(epsilon, torch.maximum(0.1 * torch.maximum(gap, residual), 0.01 * epsilon))
            epsilon = epsilon.clamp(min=_LEAST_SMOOTHING)
            late += epsilon <= _LATE_SMOOTHING
        o, q, y = _newton_step(lines, o, q, y, epsilon)
    point[live], dual[live_rays] = o, y
    return point, dual, _MAX_ITERATIONS


def _newton_step(lines: Lines, o: Tensor, q: Tensor, y: Tensor, epsilon: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Take one damped primal-dual step. Return the new points o (N, 3), offsets q (R, 3) and duals y (R, 3)."""
    r = _radius(q, epsilon[lines.index])
    hessian = lines.spread(1 / r) - lines.outer(y / r.square()[:, None], q)
    trace = hessian.diagonal(dim1=1, dim2=2).sum(1).clamp(min=_TINY)
    hessian = hessian + 1e-14 * trace[:, None, None] * torch.eye(3, dtype=o.dtype, device=o.device)
    gradient = lines.sum(q / r[:, None])
    step = -torch.linalg.solve(hessian, gradient)
    slope, value, length = dot(gradient, step), lines.sum(r), torch.ones_like(epsilon)
    for _ in range(40):  # Halve each object's step until its cost falls (Armijo), up to rounding.
        new = o + length[:, None] * step
        new_q = lines.offset(new)
        too_long = lines.sum(_radius(new_q, epsilon[lines.index])) > value + 1e-4 * length * slope + 1e-14 * value
        if not too_long.any():
            break
        length = torch.where(too_long, 0.5 * length, length)
    change = new_q - q
    dual_step = (new_q - y * (dot(q, change) / r)[:, None]) / r[:, None] - y
    # The dual moves as far as the unit ball allows.
    a, b, c = dot(dual_step, dual_step), dot(y, dual_step), (dot(y, y) - 1).clamp(max=0)
    share = (0.999 * ((b.square() - a * c).clamp(min=0).sqrt() - b) / a.clamp(min=_TINY)).clamp(max=1)
    return new, new_q, y + share[:, None] * dual_step


def _exact_optimum(lines: Lines, point: Tensor, dual: Tensor, on_line: float) -> tuple[Tensor, Tensor]:
    """Return the exact optimum (N, 3) next to the smoothed one, and the norm (N,) of its smallest subgradient.

    Lines within the distance `on_line` of the smoothed solution are assumed to pass through the exact one. The point moves
    onto these lines, and Newton steps use the remaining freedom. The subgradient shows whether the assumption holds. Its
    norm is inf if these lines do not meet.
    """
    on = lines.offset(point).norm(dim=1) <= on_line
    weight = on.to(point.dtype)[:, None]
    eigenvalues, vectors = torch.linalg.eigh(lines.spread(weight[:, 0]))
    fixed = eigenvalues > 1e-9 * eigenvalues[:, -1:].clamp(min=_TINY)
    inverse = _assemble(vectors, torch.where(fixed, 1 / torch.where(fixed, eigenvalues, 1.0), 0.0))
    free = _assemble(vectors, (~fixed).to(point.dtype))
    for newton in (True, True, True, False):
        point = point - _apply(inverse, lines.sum(lines.offset(point) * weight))
        q = lines.offset(point)
        d = torch.where(on, 1.0, q.norm(dim=1)).clamp(min=1e-14)[:, None]
        u = q / d * (1 - weight)
        pull = lines.sum(u)
        if newton:
            inverse_d = (1 - weight) / d
            curvature = lines.spread(inverse_d[:, 0]) - lines.outer(u * inverse_d, u)
            point = point - _short_newton(free @ curvature @ free, _apply(free, pull))
    # Each line through the point may add a vector of length up to 1. These vectors make the subgradient smallest.
    answer = perpendicular(dual, lines.direction) * weight
    for _ in range(30 if bool(on.any()) else 0):
        rest = pull + lines.sum(answer)
        answer = answer - perpendicular(_apply(inverse, rest)[lines.index], lines.direction) * weight
        answer = answer / answer.norm(dim=1, keepdim=True).clamp(min=1)
    missed = lines.sum((q.norm(dim=1) > 1e-9) * on.to(point.dtype)) > 0
    return point, torch.where(missed, torch.inf, (pull + lines.sum(answer)).norm(dim=1))


def _short_newton(hessian: Tensor, gradient: Tensor) -> Tensor:
    """Return Newton steps (N, 3) along directions in which the cost curves. They are short, because the solution is near."""
    scale = hessian.diagonal(dim1=1, dim2=2).sum(1).clamp(min=_TINY)
    eigenvalues, vectors = torch.linalg.eigh(hessian / scale[:, None, None])
    inverse = torch.where(eigenvalues > 1e-10, 1 / eigenvalues.clamp(min=_TINY), 0.0)
    step = _apply(_assemble(vectors, inverse), gradient / scale[:, None])
    return step * (1e-3 / step.norm(dim=1, keepdim=True).clamp(min=1e-3))


def _radius(offset: Tensor, epsilon: Tensor) -> Tensor:
    return (dot(offset, offset) + epsilon.square()).sqrt()


def _assemble(vectors: Tensor, eigenvalues: Tensor) -> Tensor:
    return (vectors * eigenvalues[:, None, :]) @ vectors.mT


def _apply(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices @ vectors[:, :, None])[:, :, 0]
