"""Find objects whose boxes show things of different sizes: several things, or a thing whose rays meet too far away."""

from __future__ import annotations

import numpy as np

from objslam.association.observations import size_per_metre
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.result import Doubt, RunResult
from objslam.core.statistics import NORMAL_MEDIAN, grouped_median, grouped_sums
from objslam.frontend.up import up_axis, up_vector

_FEWEST = 10
"""The fewest boxes of an object from which the scatter of its size is measured. A larger number finds fewer mixed
objects."""
_OTHERS = 5
"""The fewest objects from which the usual scatter is measured. A larger number judges fewer maps."""
_TIMES = 3.0
"""The least scatter of a doubted object, as a multiple of the median scatter of all objects. The objects of a recorded room,
with the boxes of a detector, have up to 2.4. Mixed objects of simulated halls have 5 and more. A larger value finds fewer
mixed objects."""
_LEAST = 0.2
"""The least scatter of a doubted object, in natural logarithms of its size. Right objects of simulated halls have up to
0.13. A larger value finds fewer mixed objects."""

_TURNED = np.cos(np.radians(20.0))
"""The cosine of the largest angle between the vertical in one box and the mean vertical in the boxes of the object. From
above, a thing has another height in the image than from the side: within 20 deg, the height of a thing without depth changes
by 6 %. `_without_depth` allows for what its depth adds. A larger angle judges more objects of cameras that are not level."""
_DEEP = 0.9
"""The largest depth of an object is this quantile of the widths of its boxes. A larger value finds fewer mixed objects."""


def mixed_sizes(result: RunResult) -> list[Doubt]:
    """Return a doubt for each object whose boxes show sizes that scatter much more than the sizes of other objects.

    A box and the distance to its object give the size of the thing in the box. The size of one thing stays the same. At
    least its height stays the same in boxes that show the vertical in the same direction, such as the boxes of a level
    camera. So only such boxes count. The scatter of the widths and the scatter of the heights are computed, and the smaller
    one counts. This smaller scatter must exceed the scatter of other objects. Both scatters must exceed the scatter that the
    noise of the boxes and the depth of the thing explain. Boxes of two things have two sizes, also where their rays happen
    to meet. If a thing is put too far away, its boxes grow faster than its distance falls.
    """
    if len(result.map) < _OTHERS:
        return []
    mine = _boxes(result)
    mine = mine[_alike(result, mine)]
    number = np.bincount(result.association.object[mine], minlength=len(result.map))
    judged = np.flatnonzero((number >= _FEWEST) & np.array([o.status == "ok" for o in result.map.objects], dtype=bool))
    if len(judged) < _OTHERS:
        return []
    variance, of_noise = _variance(result, mine)
    scatter, beyond = np.sqrt(variance.min(axis=1)), np.sqrt(np.maximum(variance - of_noise, 0.0))
    usual = float(np.median(scatter[judged]))
    odd = judged[(scatter[judged] > _TIMES * usual) & (beyond[judged] > _LEAST).all(axis=1)]
    flat = [_without_depth(result, mine[result.association.object[mine] == j]) for j in odd.tolist()]
    odd = odd[(np.reshape(flat, (-1, 2)) - of_noise[odd] > _LEAST**2).all(axis=1)]
    odd = odd[np.argsort(-scatter[odd], kind="stable")]
    return [_doubt(result, j, mine, float(scatter[j]), usual) for j in odd.tolist()]


def _boxes(result: RunResult) -> Ints:
    """Return the used rays (n,) whose boxes show a size."""
    sized = np.array([camera.sees_size for camera in result.cameras], dtype=bool)
    used = (result.association.object >= 0) & (result.weight > 0)
    used &= np.isfinite(result.map.positions[result.association.object]).all(axis=1)
    used &= sized[result.keyframes.camera[result.rays.keyframe]]
    used &= (size_per_metre(result.rays, result.keyframes, result.cameras) > 0).all(axis=1)
    return np.flatnonzero(used)


def _alike(result: RunResult, mine: Ints) -> Bools:
    """Return which of the rays (n,) show the vertical nearly in the mean direction of all rays of their object."""
    shown, owner = _shown_vertical(result, mine), result.association.object[mine]
    mean = grouped_sums(shown, owner, len(result.map))
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-9)[:, None]
    return np.asarray(np.einsum("ni,ni->n", shown, mean[owner]) >= _TURNED)


def _shown_vertical(result: RunResult, mine: Ints) -> Floats:
    """Return the vertical (n, 3) in each box: its two components in the image, and its component along the ray."""
    turn = (result.map_T_base @ result.keyframes.base_T_camera)[result.rays.keyframe[mine], :3, :3]
    vertical = np.einsum("nji,j->ni", turn, up_vector(up_axis(result.keyframes)))
    ray = np.einsum("nji,nj->ni", turn, result.directions[mine])
    along = np.einsum("ni,ni->n", vertical, ray)
    across = (vertical - along[:, None] * ray)[:, :2]
    length = np.sqrt(np.maximum(1 - along**2, 0.0)) / np.maximum(np.linalg.norm(across, axis=1), 1e-9)
    return np.column_stack([across * length[:, None], along])


def _without_depth(result: RunResult, mine: Ints) -> Floats:
    """Return the variances (2,) of the logarithms of the sides of an object that its depth does not explain.

    A camera that looks down on a thing sees its height and a part of its depth in one side of the box. This part is the
    depth times the sine of the slope of the ray. For a flat thing, such as a keyboard, the depth is the larger part, and it
    differs from direction to direction. But the sum of width and depth is the same from all directions, up to a factor of
    1.4. So this sum is fitted together with the height. An upright thing shows more height than depth, and all of its
    variance counts.

    mine: (n,) the rays of the object.
    """
    away = np.linalg.norm(result.map.positions[result.association.object[mine]] - result.origins[mine], axis=1)
    size = size_per_metre(result.rays.take(mine), result.keyframes, result.cameras) * away[:, None]
    slope, other = np.abs(_shown_vertical(result, mine)[:, 2:]), size[:, ::-1]
    shown, middle = size + slope * other, slope - slope.mean()
    fitted = (middle * shown).sum(axis=0) / max(float((middle**2).sum()), 1e-9)
    usual = np.median(other, axis=0)
    both = np.clip(fitted, usual, usual + np.quantile(other, _DEEP, axis=0))
    upright = np.maximum(np.median(shown - slope * both, axis=0), 0.0)
    left = np.log(shown / np.maximum(upright + slope * both, 1e-9)).var(axis=0)
    return np.where(upright < np.median(slope) * both, left, np.log(size).var(axis=0))


def _variance(result: RunResult, mine: Ints) -> tuple[Floats, Floats]:
    """Return the variances (N, 2) of the logarithms of the width and height of each object, and the variances (N, 2) that
    the noise of the boxes explains. mine: (n,) the rays of all objects."""
    owner, count = result.association.object[mine], len(result.map)
    away = np.linalg.norm(result.map.positions[owner] - result.origins[mine], axis=1)
    size = np.log(size_per_metre(result.rays.take(mine), result.keyframes, result.cameras) * away[:, None])
    sides = result.rays.box[mine, 2:] - result.rays.box[mine, :2]
    off = size - grouped_median(size, owner, count)[owner]
    # The noise of an edge, px, from the scatter of most boxes. Each of the two edges of a side has it, hence sqrt(2).
    edge = min(float(np.median(np.abs(off) * sides)) / (NORMAL_MEDIAN * np.sqrt(2)), result.settings.rays.pixel_sigma)
    number = np.maximum(np.bincount(owner, minlength=count), 1)[:, None]
    mean = grouped_sums(size, owner, count) / number
    variance = grouped_sums((size - mean[owner]) ** 2, owner, count) / number
    return variance, grouped_sums(2 * (edge / sides) ** 2, owner, count) / number


def _doubt(result: RunResult, j: int, mine: Ints, scatter: float, usual: float) -> Doubt:
    o = result.map.objects[j]
    return Doubt(
        "split",
        "sizes",
        o.label,
        f"{o.label} #{o.id} may be several things, or at a wrong place: the sizes in its boxes scatter by a factor of "
        f"{np.exp(scatter):.2f}, and the sizes of other objects by {np.exp(usual):.2f}.",
        (o.id,),
        o.position,
        mine[result.association.object[mine] == j],
        {"size_scatter": scatter, "usual_scatter": usual},
    )
