"""Find the point closest to all lines (Eq. 1 of Staszak and Belter), if some lines pass through or near this point.

Smoothed distances are minimised first, and then the distances themselves.
"""

from __future__ import annotations

from types import ModuleType

from objslam.core.array_module import Tensor, indices_of
from objslam.triangulation.line_block import LineBlock, apply, dot, full, norm, outer, perpendicular

_MAX_ITERATIONS = 80  # The most Newton steps. A solved object leaves the block earlier.
_LATE_SMOOTHING = 1e-9  # The smoothing (in mean distances) below which an object gets only a few more Newton steps.
_LEAST_SMOOTHING = 1e-11  # The least smoothing (in mean distances). It is above the rounding errors.
_ROUNDING = 1e-14
"""The size (in mean distances) below which the residual of the duals, times the smoothing, counts as zero. An offset is
exact to about 1e-15, and a dual is an offset divided by the smoothing. With a smaller value, rounding errors keep the
smoothing of some objects large until the last step."""
_ON_LINE = (1e-7, 1e-5)  # The values of `on_line` (in mean distances) that are tried if 0 does not give the optimum.
_RIDGE = 1e-10
"""The ridge that is added to a singular matrix, as a share of its norm. It is far above the rounding errors of the matrix. A
larger value moves the point more slowly along rays that are nearly parallel."""
_TINY = 1e-300  # The least divisor, so that 0 / 0 gives 0.


def finish(lines: LineBlock) -> tuple[Tensor, Tensor, int]:
    """Solve Eq. 1 from the coordinate origin. Return points (3, B), gradient norms (B,) and the number of iterations.

    The unit of length is about the mean distance of an object from its lines. If lines pass through the solution, the
    gradient is the smallest subgradient that was found. A norm of 0 still proves the optimum.
    """
    xp = lines.xp
    smoothed, dual, iterations = _smoothed_optimum(lines)
    point, gradient = _exact_optimum(lines, smoothed, dual, 0.0)
    for on_line in _ON_LINE:
        some = indices_of(gradient > 1e-10)
        if len(some):
            other, rest = _exact_optimum(lines.select(some), smoothed[:, some], dual[:, :, some], on_line)
            better = rest < gradient[some]
            point[:, some] = xp.where(better, other, point[:, some])
            gradient[some] = xp.where(better, rest, gradient[some])
    return point, gradient, iterations


def _smoothed_optimum(lines: LineBlock) -> tuple[Tensor, Tensor, int]:
    """Minimise the sum of sqrt(distance^2 + epsilon^2) for all objects by primal-dual Newton, while epsilon goes to zero.

    The method is Andersen, Christiansen, Conn & Overton, SIAM J. Sci. Comput. 22 (2000), with Chan, Golub & Mulet's
    linearisation. The result is the points (3, B), the dual (3, n, B) of each line, and the number of iterations. The dual
    is the unit vector along the offset of a point from its line. If the point lies on the line, the dual is a vector across
    the line that is at most 1 long.
    """
    xp = lines.xp
    point, dual = xp.zeros_like(lines.foot[:, 0]), xp.zeros_like(lines.foot)
    live = xp.arange(point.shape[1], device=point.device)  # The unsolved objects.
    o, epsilon, late = xp.zeros_like(point), xp.ones_like(point[0]), xp.zeros_like(point[0])
    q = lines.offset(o)
    y = q / _radius(q, epsilon)
    for iteration in range(_MAX_ITERATIONS):
        distance = norm(q)
        inverse = lines.weight / distance.clip(min=_TINY)
        number = lines.weight.sum(axis=0)
        # Rounding limits the gradient: an offset is exact to 1e-16, and its direction to 1e-16 divided by its length.
        finished = norm((q * inverse).sum(axis=1)) <= 4e-16 * (number + inverse.sum(axis=0)).clip(max=1e6)
        finished |= late >= 4
        if bool(finished.any()):
            point[:, live], dual[:, :, live] = o, y
            going = ~finished
            lines, live, number, distance = lines.select(going), live[going], number[going], distance[:, going]
            o, q, y, epsilon, late = o[:, going], q[:, :, going], y[:, :, going], epsilon[going], late[going]
        if len(live) == 0:
            return point, dual, iteration
        if iteration:
            gap = ((distance - dot(y, q)) * lines.weight).sum(axis=0) / number
            residual = norm((y * lines.weight).sum(axis=1)) / number
            residual = xp.where(residual * epsilon <= _ROUNDING, 0.0, residual)
            epsilon = xp.minimum(epsilon, xp.maximum(0.1 * xp.maximum(gap, residual), 0.01 * epsilon))
            epsilon = epsilon.clip(min=_LEAST_SMOOTHING)
            late = late + (epsilon <= _LATE_SMOOTHING)
        o, q, y = _newton_step(lines, o, q, y, epsilon)
    point[:, live], dual[:, :, live] = o, y
    return point, dual, _MAX_ITERATIONS


def _newton_step(lines: LineBlock, o: Tensor, q: Tensor, y: Tensor, epsilon: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Take one damped primal-dual step. Return the new points o (3, B), offsets q (3, n, B) and duals y (3, n, B)."""
    xp = lines.xp
    r = _radius(q, epsilon)
    inverse = lines.weight / r
    six = lines.spread(inverse) - outer(y * (inverse / r), q, xp)
    six[:3] += 1e-14 * six[:3].sum(axis=0).clip(min=_TINY)
    gradient = (q * inverse).sum(axis=1)
    step = -_solved(full(six), gradient.T[:, :, None], xp)[:, :, 0].T
    slope, value, share = dot(gradient, step), (r * lines.weight).sum(axis=0), xp.ones_like(epsilon)
    for _ in range(40):  # Halve each object's step until its cost falls (Armijo), up to rounding.
        new = o + share * step
        new_q = lines.offset(new)
        cost = (_radius(new_q, epsilon) * lines.weight).sum(axis=0)
        too_long = cost > value + 1e-4 * share * slope + 1e-14 * value
        if not bool(too_long.any()):
            break
        share = xp.where(too_long, 0.5 * share, share)
    dual_step = (new_q - y * (dot(q, new_q - q) / r)) / r - y
    # The dual moves as far as the unit ball allows.
    a, b, c = dot(dual_step, dual_step), dot(y, dual_step), (dot(y, y) - 1).clip(max=0)
    part = (0.999 * (xp.sqrt((b * b - a * c).clip(min=0)) - b) / a.clip(min=_TINY)).clip(max=1)
    return new, new_q, y + part * dual_step


def _solved(curvature: Tensor, gradient: Tensor, xp: ModuleType) -> Tensor:
    """Return the solutions (B, 3, 1) for symmetric matrices (B, 3, 3), even if a matrix is singular.

    If rays are parallel to 0.1 degrees, the cost has no curvature along them, up to rounding. Rounding may then cancel the
    small ridge of `_newton_step` exactly.
    """
    try:
        return xp.linalg.solve(curvature, gradient)
    except xp.linalg.LinAlgError:
        ridge = _RIDGE * xp.sqrt((curvature * curvature).sum(axis=(1, 2))).clip(min=_TINY)
        held = curvature + ridge[:, None, None] * xp.eye(3, dtype=curvature.dtype, device=curvature.device)
        return xp.linalg.solve(held, gradient)


def _exact_optimum(lines: LineBlock, point: Tensor, dual: Tensor, on_line: float) -> tuple[Tensor, Tensor]:
    """Return the exact optimum (3, B) next to the smoothed optimum, and the norm (B,) of its smallest subgradient.

    Lines within the distance `on_line` of the smoothed solution are assumed to pass through the exact solution. The point
    moves onto these lines. Newton steps then move it in the directions that the lines leave free. The subgradient shows
    whether the assumption is right. Its norm is inf if the lines do not meet.
    """
    xp = lines.xp
    on = xp.where(norm(lines.offset(point)) <= on_line, lines.weight, 0.0)
    off = lines.weight - on
    eigenvalues, vectors = xp.linalg.eigh(full(lines.spread(on)))
    fixed = eigenvalues > 1e-9 * eigenvalues[:, -1:].clip(min=_TINY)
    inverse = _assemble(vectors, xp.where(fixed, 1 / xp.where(fixed, eigenvalues, 1.0), 0.0))
    free = _assemble(vectors, xp.where(fixed, 0.0, xp.ones_like(eigenvalues)))
    for newton in (True, True, True, False):
        point = point - apply(inverse, (lines.offset(point) * on).sum(axis=1))
        q = lines.offset(point)
        inverse_d = off / norm(q).clip(min=1e-14)
        u = q * inverse_d
        pull = u.sum(axis=1)
        if newton:
            curvature = full(lines.spread(inverse_d) - outer(u * inverse_d, u, xp))
            point = point - _short_newton(free @ curvature @ free, apply(free, pull), xp)
    # Each line through the point may add a vector up to 1 long. The vectors that give the smallest subgradient are sought.
    answer = perpendicular(dual, lines.direction) * on
    for _ in range(30 if bool((on > 0).any()) else 0):
        rest = pull + answer.sum(axis=1)
        answer = answer - perpendicular(apply(inverse, rest)[:, None], lines.direction) * on
        answer = answer / norm(answer).clip(min=1)
    missed = ((norm(q) > 1e-9) & (on > 0)).any(axis=0)
    return point, xp.where(missed, xp.inf, norm(pull + answer.sum(axis=1)))


def _short_newton(hessian: Tensor, gradient: Tensor, xp: ModuleType) -> Tensor:
    """Return Newton steps (3, B) in the directions in which the cost is curved. A step has at most the length 1e-3 (in mean
    distances), because the solution is near."""
    trace = hessian[:, 0, 0] + hessian[:, 1, 1] + hessian[:, 2, 2]
    scale = trace.clip(min=_TINY)
    eigenvalues, vectors = xp.linalg.eigh(hessian / scale[:, None, None])
    inverse = xp.where(eigenvalues > 1e-10, 1 / eigenvalues.clip(min=_TINY), 0.0)
    step = apply(_assemble(vectors, inverse), gradient / scale)
    return step * (1e-3 / norm(step).clip(min=1e-3))


def _radius(offset: Tensor, epsilon: Tensor) -> Tensor:
    return (dot(offset, offset) + epsilon * epsilon) ** 0.5


def _assemble(vectors: Tensor, eigenvalues: Tensor) -> Tensor:
    return (vectors * eigenvalues[:, None, :]) @ vectors.mT
