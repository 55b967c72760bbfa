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
"""The least scatter of a doubted object, as a multiple of the median of all objects. The objects of a recorded room, with
the boxes of a detector, have up to 2.4. Mixed objects of simulated halls have 5 and more. A larger value finds fewer."""
_LEAST = 0.2
"""The least scatter of a doubted object, in natural logarithms of its size. Right objects of simulated halls have up to
0.13. A larger value finds fewer mixed objects."""

_TURNED = np.cos(np.radians(20.0))
"""The cosine of the largest angle between the direction of the vertical in one box and the mean of this direction over the
boxes of the object. From other sides, the same thing has another height in the image: within 20 deg, the height of a flat
thing changes by 6 %. A larger angle judges more objects of cameras that are not level."""


def mixed_sizes(result: RunResult) -> list[Doubt]:
    """Return a doubt for each object whose boxes show sizes that scatter much more than the sizes of other objects.

    A box and the distance to its object give the size of the thing in the box. The size of one thing stays the same. At
    least its height stays the same in boxes that show the vertical in the same direction, such as the boxes of a level
    camera. So only such boxes count. The scatter of the widths and the scatter of the heights are computed, and the smaller
    one counts. It must exceed the scatter of other objects, and the scatter that the noise of the boxes explains. Boxes of
    two things have two sizes, also where their rays happen to meet. If a thing is put too far away, its boxes grow faster
    than its distance falls.
    """
    if len(result.map) < _OTHERS:
        return []
    mine = _boxes(result)
    mine = mine[_alike(result, mine)]
    number = np.bincount(result.association.object[mine], minlength=len(result.map))
    judged = np.flatnonzero((number >= _FEWEST) & np.array([o.status == "ok" for o in result.map.objects], dtype=bool))
    if len(judged) < _OTHERS:
        return []
    scatter, beyond = _scatter(result, mine)
    usual = float(np.median(scatter[judged]))
    odd = judged[(scatter[judged] > _TIMES * usual) & (beyond[judged] > _LEAST)]
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
    """Return which of the rays (n,) show the vertical nearly as the mean of their object's rays does.

    The vertical is compared in the frame of the box: along the ray, and across it in the image.
    """
    turn = (result.map_T_base @ result.keyframes.base_T_camera)[result.rays.keyframe[mine], :3, :3]
    vertical = np.einsum("nji,j->ni", turn, up_vector(up_axis(result.keyframes)))
    ray = np.einsum("nji,nj->ni", turn, result.directions[mine])
    along = np.einsum("ni,ni->n", vertical, ray)
    across = (vertical - along[:, None] * ray)[:, :2]
    length = np.sqrt(np.maximum(1 - along**2, 0.0)) / np.maximum(np.linalg.norm(across, axis=1), 1e-9)
    shown = np.column_stack([across * length[:, None], along])
    owner = result.association.object[mine]
    mean = grouped_sums(shown, owner, len(result.map))
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-9)[:, None]
    return np.asarray(np.einsum("ni,ni->n", shown, mean[owner]) >= _TURNED)


def _scatter(result: RunResult, mine: Ints) -> tuple[Floats, Floats]:
    """Return the scatter (N,) of the size of each object, and the part (N,) beyond the noise of boxes.

    Both are standard deviations of the natural logarithm. mine: (n,) the rays of all objects.
    """
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
    least = variance.argmin(axis=1)[:, None]
    of_noise = grouped_sums(2 * (edge / sides) ** 2, owner, count) / number
    found, noise = (np.take_along_axis(one, least, axis=1)[:, 0] for one in (variance, of_noise))
    return np.sqrt(found), np.sqrt(np.maximum(found - noise, 0.0))


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
