"""Compute covariance and parallax of triangulated objects, and fuse rays with ranges, for many objects at once."""

from types import ModuleType

from objslam.core.array_module import Tensor, as_tensor, as_type, backend_of, group_sum, indices_of, length, module_of
from objslam.core.geometry import evenly_spread
from objslam.core.statistics import CAUCHY_K, NORMAL_MEDIAN, RAYLEIGH_MEAN
from objslam.triangulation.bundle import Bundle
from objslam.triangulation.lines import Lines

_EVERY_PAIR = 256  # Up to this number of rays of an object, `parallax` compares every pair. A larger number costs time.
_PLACES = 1 << 13  # The most rays, with fillers, that `parallax` compares together. More need more memory.
_RANGE_ITERATIONS = 30  # The number of iterations of the range fit. More are slower. It starts at the median range.


def covariance(bundle: Bundle, use: Tensor, point: Tensor) -> Tensor:
    """Return the covariance (N, 3, 3) m^2 of each solution of Eq. 1 on the rays in `use` (R,). NaN if they fix no point.

    Eq. 1 is an M-estimator with covariance A^-1 B A^-1, where A is the expected Hessian and B the gradient covariance (Huber
    & Ronchetti, Robust Statistics, ch. 6). The offset of ray i is Gaussian with standard deviation s_i along both axes
    across the ray. Then the direction u of the offset has E[u u^T] = P / 2, where P projects across the ray. The length d of
    the offset is independent of u, and E[1 / d] = sqrt(pi / 2) / s_i. So a ray adds sqrt(pi / 2) / (2 s_i) P to A, and P / 2
    to B. Residuals above s_i widen the result. Smaller residuals do not narrow it. Eq. 1 also has a bias that more rays do
    not reduce, because rays miss a nearer object by less. Angular noise tilts u forward along ray i by E[u] = sqrt(pi / 2)
    sigma_i^2 r_i / s_i, where r_i is the length of the ray. The result includes the square of this bias.
    """
    rays, xp = bundle.select(use), bundle.xp
    index = rays.index
    lines = Lines.through(rays.origin - point[index], rays.direction, index, len(point), xp)
    distance = length(point[index] - rays.origin)
    s = _offset_sigma(rays, distance)
    a = lines.spread(0.5 * RAYLEIGH_MEAN / s)
    b = lines.spread(xp.full_like(s, 0.5))
    tilt = lines.sum((RAYLEIGH_MEAN * rays.sigma**2 * distance / s)[:, None] * rays.direction)
    factor = _variance_factor(length(lines.foot) / s, rays, 3)[:, None, None]
    inverse, regular = _inverse(a, xp)
    bias = factor * (inverse @ tilt[:, :, None])  # More noise makes the tilt larger and the Hessian smaller.
    result = factor * inverse @ b @ inverse + bias @ bias.mT
    return xp.where(regular[:, None, None], result, xp.nan)


def fuse_ranges(
    bundle: Bundle, use: Tensor, ranges: Tensor, range_sigma: Tensor, range_bias: Tensor
) -> tuple[Tensor, Tensor]:
    """Fuse the rays in `use` (R,) with their ranges (R,) m, and return points (N, 3) m and covariances (N, 3, 3) m^2.

    This is for objects whose rays alone are too uncertain. A ray without a range has the range NaN. An object without a
    range gets NaN. range_sigma: (R,) m, the noise of single ranges. range_bias: (R,) m, the standard deviation of an error
    that all ranges of an object share. The covariance includes both. Across the rays, the loss is the square, because `use`
    has no outliers. Along the rays, the loss is Cauchy's, because a range may belong to the background.
    `association.refinement.refine` is robust in both directions, but gives no covariance.
    """
    xp = bundle.xp
    rays, count = bundle.select(use), len(bundle.number)
    ranges, range_sigma, range_bias = ranges[use], range_sigma[use], range_bias[use]
    known = xp.isfinite(ranges)
    typical = object_median(ranges[known], rays.index[known], count)
    usual = xp.where(known, ranges, typical[rays.index])
    s = _offset_sigma(rays, usual)
    has = xp.isfinite(typical)
    measured = xp.where(known[:, None], rays.origin + usual[:, None] * rays.direction, 0.0)
    informed = has[rays.index]
    lines = Lines.through(xp.where(informed[:, None], rays.origin, 0.0), rays.direction, rays.index, count, xp)
    weight = xp.where(informed, 1 / s**2, 0.0)
    across_matrix = lines.spread(weight)
    across_vector = lines.sum(weight[:, None] * lines.foot)
    # The start is the median range along the mean direction, because the rays alone leave this direction free.
    heading = group_sum(rays.direction, rays.index, count)
    heading = heading / length(heading)[:, None].clip(min=1e-12)
    depth = object_median((measured * heading[rays.index]).sum(1)[known], rays.index[known], count)
    depth = xp.where(has, depth, 0.0)
    eye = xp.eye(3, dtype=s.dtype, device=s.device)
    strength = (across_matrix[:, 0, 0] + across_matrix[:, 1, 1] + across_matrix[:, 2, 2]).clip(min=1.0)
    pin = (strength[:, None] * heading)[:, :, None] * heading[:, None, :]
    empty = as_type(~has, s)[:, None, None] * eye

    def along(weight: Tensor) -> Tensor:
        return lines.outer(weight[:, None] * rays.direction, rays.direction)

    def solve(matrices: Tensor, vectors: Tensor) -> Tensor:
        return xp.linalg.solve(matrices, vectors[:, :, None])[:, :, 0]

    point = solve(across_matrix + pin + empty, across_vector + (strength * depth)[:, None] * heading)
    ends = (measured * rays.direction).sum(1)
    for _ in range(_RANGE_ITERATIONS):
        residual = ((point[rays.index] * rays.direction).sum(1) - ends) / range_sigma
        robust = xp.where(known, 1 / (1 + (residual / CAUCHY_K) ** 2) / range_sigma**2, 0.0)
        target = across_vector + lines.sum((robust * ends)[:, None] * rays.direction)
        point = solve(across_matrix + along(robust) + empty, target)
    # Ranges that scatter by more than their sigma count less.
    scatter = object_median(abs(residual)[known], rays.index[known], count) / NORMAL_MEDIAN
    strength_along = robust / (scatter**2).clip(min=1)[rays.index]
    along_matrix = along(strength_along)
    factor = _variance_factor(length(lines.offset(point)) / s, rays, 2)
    inverse, regular = _inverse(across_matrix / factor[:, None, None] + along_matrix, xp)
    regular &= has
    # The point moves by `shift` if all ranges of its object are too long by one sigma of their bias.
    bias = xp.where(known, range_bias, 0.0)
    shift = (inverse @ lines.sum((strength_along * bias)[:, None] * rays.direction)[:, :, None])[:, :, 0]
    inverse = inverse + shift[:, :, None] * shift[:, None, :]
    return xp.where(regular[:, None], point, xp.nan), xp.where(regular[:, None, None], inverse, xp.nan)


def largest_sigma(covariances: Tensor) -> Tensor:
    """Return the standard deviation (N,) m of each covariance (N, 3, 3) m^2 in its most uncertain direction. inf for NaN."""
    xp = module_of(covariances)
    known = xp.isfinite(covariances).all(axis=2).all(axis=1)
    variance = xp.linalg.eigvalsh(xp.where(known[:, None, None], covariances, 0.0))[:, 2].clip(min=0)
    return xp.where(known, xp.sqrt(variance), xp.inf)


def reach(bundle: Bundle, use: Tensor, point: Tensor) -> Tensor:
    """Return the median distance (N,) m of each point (N, 3) from the origins of its rays in `use` (R,), or NaN."""
    index = bundle.index[use]
    return object_median(length(point[index] - bundle.origin[use]), index, len(point))


def lies_ahead(bundle: Bundle, use: Tensor, point: Tensor) -> Tensor:
    """Return a mask (N,) of the points (N, 3) that lie ahead of more than half of their rays in `use` (R,)."""
    index = bundle.index[use]
    towards = ((point[index] - bundle.origin[use]) * bundle.direction[use]).sum(1)
    return group_sum(bundle.xp.sign(towards), index, len(point)) > 0


def parallax(bundle: Bundle, use: Tensor) -> Tensor:
    """Return the widest angle (N,) rad between any two rays in `use` (R,) of each object. Rays are undirected lines here.

    If an object has more than `_EVERY_PAIR` rays, only the rays nearest to 64 evenly spread axes are compared. The angle is
    then exact to 1 %.
    """
    xp = bundle.xp
    rays = bundle.select(use)
    widest = xp.zeros(len(rays.number), dtype=rays.direction.dtype, device=rays.direction.device)
    few = indices_of((rays.number > 1) & (rays.number <= _EVERY_PAIR))
    many = indices_of(rays.number > _EVERY_PAIR)
    for objects, members, real in (*rays.blocks(few, _PLACES), *rays.blocks(many, _PLACES)):
        direction = rays.direction[members]
        if members.shape[1] > _EVERY_PAIR:
            axes = as_tensor(evenly_spread(64).copy(), backend_of(direction))
            towards = xp.where(real[:, :, None], direction @ axes.T, -xp.inf).argmax(axis=1)
            direction = direction[xp.arange(len(objects), device=towards.device)[:, None], towards]
            real = xp.ones_like(towards, dtype=xp.bool)
        cos = abs(direction @ direction.mT)
        cos = xp.where(real[:, :, None] & real[:, None, :], cos, 1.0).reshape(len(objects), -1)
        pair = cos.argmin(axis=1)
        n = direction.shape[1]
        row = xp.arange(len(pair), device=pair.device)
        one, two = direction[row, pair // n], direction[row, pair % n]
        # The arccos of a value near 1 would lose half of the digits.
        widest[objects] = xp.atan2(length(xp.linalg.cross(one, two)), abs((one * two).sum(axis=1)))
    return widest


def object_median(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Return the median (N,) of the values (R,) of each object. It is NaN for an object without values.

    index: (R,) the object of each value. count: the number N of objects. For an even number of values, this is the mean of
    the two middle ones, and `core.statistics.grouped_median` returns the upper one.
    """
    xp = module_of(values)
    if len(values) == 0:
        return xp.full((count,), xp.nan, dtype=values.dtype, device=values.device)
    order = xp.argsort(values)
    order = order[xp.argsort(index[order], stable=True)]
    number = xp.bincount(index, minlength=count)
    first = xp.cumsum(number, 0) - number
    lower = (first + (number - 1).clip(min=0) // 2).clip(max=len(values) - 1)
    upper = (first + number // 2).clip(max=len(values) - 1)
    return xp.where(number > 0, 0.5 * (values[order[lower]] + values[order[upper]]), xp.nan)


def _offset_sigma(rays: Bundle, distance: Tensor) -> Tensor:
    """Return the standard deviation (R,) m, along each perpendicular axis, of the offset between each ray and its object."""
    return rays.xp.sqrt((rays.sigma * distance) ** 2 + rays.position_sigma**2).clip(min=1e-12)


def _variance_factor(miss: Tensor, rays: Bundle, taken: int) -> Tensor:
    """Return the factor (N,), at least 1, by which the variance of the residuals exceeds its expectation.

    miss: (R,) normalised residuals. Their mean is used, because it is more robust than their mean square. taken: the number
    of degrees of freedom that the fit uses up, of 2 n for n rays. The excess over 1 is multiplied by 1 + 3.2 / (rest - 2),
    because few remaining degrees of freedom (`rest`) give an uncertain estimate. This multiplier is the 95 % quantile of
    F(3, rest), divided by its limit for a large rest, exact to 3 % from 4 rays on.
    """
    number = as_type(rays.number, miss)
    mean = group_sum(miss, rays.index, len(number)) / number.clip(min=1) / RAYLEIGH_MEAN
    rest = (2 * number - taken).clip(min=1)
    excess = mean**2 * 2 * number / rest - 1
    return 1 + excess.clip(min=0) * (1 + 3.2 / (rest - 2).clip(min=1))


def _inverse(matrices: Tensor, xp: ModuleType) -> tuple[Tensor, Tensor]:
    """Return the inverses of symmetric matrices (N, 3, 3), and which matrices are regular."""
    eye = xp.eye(3, dtype=matrices.dtype, device=matrices.device)
    finite = xp.isfinite(matrices).all(axis=2).all(axis=1)
    eigenvalues = xp.linalg.eigvalsh(xp.where(finite[:, None, None], matrices, eye))
    regular = finite & (eigenvalues[:, 0] > 1e-10 * eigenvalues[:, 2]) & (eigenvalues[:, 2] > 0)
    return xp.linalg.inv(xp.where(regular[:, None, None], matrices, eye)), regular
