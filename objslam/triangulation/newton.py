"""Newton's method for Eq. 1, for all objects of a block at once.

Let n be the direction of a line, and q the offset of the point from this line. The length d of q is the distance. The
distance has the gradient u = q / d and the Hessian t t^T / d, where t = n x u. The unit of length is about the mean distance
of an object from its lines.
"""

from __future__ import annotations

from objslam.core.array_module import Tensor, as_single, as_type, take_along
from objslam.triangulation.line_block import UPPER, LineBlock, dot, norm, products, solve_symmetric

_WEIGHTED_STEPS = 3
"""The number of weighted least-squares steps before the Newton steps. With fewer steps, outliers keep more weight."""
_SMOOTHING = 0.05
"""The smoothing s of the weights in least-squares steps, in mean distances. A line at distance d has the weight
1 / sqrt(d^2 + s^2). A larger smoothing keeps more weight on outliers."""
_SINGLE_STEPS = 3
"""The most Newton steps in single precision. They take half the time of steps in double precision. More steps do not make
the point more exact than single precision allows."""
_STEPS = 6
"""The most Newton steps in double precision. If an object needs more steps, a line passes through or near its solution."""
_LINE_STEPS = 6
"""The number of Newton steps along the nearest line. More steps are more exact and slower."""
_SHORTER = 0.3
"""The factor by which a step is shortened if it did not lower the cost enough. A larger factor shortens it less."""
_SINGLE, _DOUBLE = 2.0**-23, 2.0**-52
"""The distance between 1 and the next larger number, in single and in double precision."""
_TINY = 1e-30
"""The least divisor, so that 0 / 0 gives 0."""


def approach(lines: LineBlock) -> tuple[Tensor, int]:
    """Return points (3, B) near the optimum, exact to about 1e-6 units of length, and the number of steps.

    The steps start at the coordinate origin.
    """
    xp = lines.xp
    rough = LineBlock(as_single(lines.foot), as_single(lines.direction), as_single(lines.weight), xp)
    point = xp.zeros_like(rough.foot[:, 0])
    for _ in range(_WEIGHTED_STEPS):
        q = rough.offset(point)
        weight = rough.weight / xp.sqrt(dot(q, q) + _SMOOTHING**2)
        point = point - solve_symmetric(rough.spread(weight), (q * weight).sum(axis=1), xp)[0]
    point = xp.where(xp.isfinite(point), point, xp.zeros_like(point))
    point, _, _, steps = newton(rough, point, _SINGLE_STEPS)
    return as_type(point, lines.foot), _WEIGHTED_STEPS + steps


def newton(lines: LineBlock, start: Tensor, steps: int = _STEPS) -> tuple[Tensor, Tensor, Tensor, int]:
    """Take Newton steps from the start (3, B). A step that does not lower the cost enough is shortened.

    steps: the most evaluations of the cost. The start and each shortened step need one evaluation too.

    Returns:
        The points (3, B), the gradient norms (B,), a mask (B,) of the objects that are solved up to rounding, and the number
        of evaluations. An unsolved object may have a line through or near its solution, or no curvature.
    """
    xp = lines.xp
    epsilon = _SINGLE if start.dtype == xp.float32 else _DOUBLE
    trial, point = start, start
    step, value = xp.zeros_like(start), xp.full_like(start[0], xp.inf)
    slope = xp.zeros_like(value)
    result, rest, solved = xp.zeros_like(start), xp.zeros_like(value), xp.zeros_like(value, dtype=xp.bool)
    live, taken = xp.arange(len(value), device=value.device), 0
    count = lines.weight.sum(axis=0)
    while len(live):
        taken += 1
        q = lines.offset(trial)
        d = norm(q).clip(min=_TINY)
        inverse = lines.weight / d
        u = q * inverse
        pull, cost = u.sum(axis=1), (d * lines.weight).sum(axis=0)
        better = cost <= value + 1e-4 * slope + 50 * epsilon * cost
        move = -solve_symmetric(_hessian(lines, u, inverse), pull, xp)[0]
        point, value = xp.where(better, trial, point), xp.where(better, cost, value)
        slope = xp.where(better, dot(pull, move), _SHORTER * slope)
        step = xp.where(better, move, _SHORTER * step)
        size = norm(pull)
        # Rounding limits the gradient: an offset is exact to epsilon, and its direction to epsilon divided by its length.
        limit = (count + inverse.sum(axis=0)).clip(max=1e6)
        done = better & (size <= 2 * epsilon * limit)
        number, last = int(done.sum()), taken == steps
        if last or 2 * number > len(done):
            result[:, live], rest[live], solved[live] = point, size, done
            if last:
                break
            going = ~done
            lines, live, count = lines.select(going), live[going], count[going]
            point, step, value, slope = point[:, going], step[:, going], value[going], slope[going]
        trial = point + step
    return result, rest, solved, taken


def off_nearest_line(lines: LineBlock, start: Tensor) -> tuple[Tensor, Tensor, Tensor, int]:
    """Solve objects whose nearest line to the start (3, B) passes through or near the solution. Return the same as `newton`.

    First, the point on this line with the least sum of distances from the other lines is found. The gradient of this sum at
    the point is taken across the line. If its norm is at most 1, the point is the optimum of Eq. 1 (Kuhn, Math. Programming
    4, 1973), and the returned norm is that of the smallest subgradient. If the norm is larger, the optimum lies beside the
    line, and Newton steps start beside it.
    """
    xp = lines.xp
    far = norm(lines.offset(start)) + xp.where(lines.weight > 0, 0.0, xp.full_like(lines.weight, xp.inf))
    nearest = far.argmin(axis=0)[None]
    slot = xp.arange(len(far), device=start.device)[:, None]
    others = LineBlock(lines.foot, lines.direction, lines.weight * (slot != nearest), xp)
    axis = take_along(lines.direction, xp.broadcast_to(nearest, (3, *nearest.shape)), 1)[:, 0]
    foot = take_along(lines.foot, xp.broadcast_to(nearest, (3, *nearest.shape)), 1)[:, 0]
    along = dot(axis, start)
    for _ in range(_LINE_STEPS):
        pull, curvature, _ = _slopes(others, foot + along * axis, axis)
        along = along - dot(pull, axis) / curvature.clip(min=_TINY)
    point = foot + along * axis
    pull, _, limit = _slopes(others, point, axis)
    slope = dot(pull, axis)
    across = pull - slope * axis
    strength = norm(across)
    solved = (abs(slope) <= 2 * _DOUBLE * limit) & (strength <= 1)
    beside = across / strength.clip(min=_TINY)
    _, curvature, _ = _slopes(others, point, beside)
    begin = point - (strength - 1).clip(min=0) / curvature.clip(min=_TINY) * beside
    result, rest, taken = xp.where(solved, point, start), abs(slope), _LINE_STEPS
    left = ~(solved | ~xp.isfinite(begin).all(axis=0))
    if bool(left.any()):
        result[:, left], rest[left], solved[left], steps = newton(lines.select(left), begin[:, left])
        taken += steps
    return result, rest, solved, taken


def _slopes(lines: LineBlock, point: Tensor, axis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradient (3, B) of Eq. 1 at points (3, B), the second derivative (B,) along unit vectors `axis` (3, B), and
    the rounding error (B,) of the gradient.

    The rounding error is in units of epsilon. It is the sum of 1 + 1 / d over the lines, at most 1e6.
    """
    q = lines.offset(point)
    inverse = lines.weight / norm(q).clip(min=_TINY)
    u = q * inverse
    across = 1 - dot(axis[:, None], lines.direction) ** 2 - dot(axis[:, None], u) ** 2
    limit = (lines.weight.sum(axis=0) + inverse.sum(axis=0)).clip(max=1e6)
    return u.sum(axis=1), (across * inverse).sum(axis=0), limit


def _hessian(lines: LineBlock, u: Tensor, inverse: Tensor) -> Tensor:
    """Return the six entries (6, B) of the sums of t t^T / d over the lines of each object, with t = n x u.

    u: (3, n, B). inverse: (n, B) 1 / d. Both are zero for a filler.
    """
    x, y, z = lines.direction
    a, b, c = u
    t = lines.xp.stack([y * c - z * b, z * a - x * c, x * b - y * a])
    return products(t, t * inverse, lines.xp)[list(UPPER)]
