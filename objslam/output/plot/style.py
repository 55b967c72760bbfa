"""Choose colours, captions, ray lengths and the shown area of the map, for all pictures, recordings and exports."""

import colorsys
import re
from collections import Counter
from collections.abc import Sequence
from typing import Literal
from zlib import crc32

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.bodies.body import Body
from objslam.core.bodies.upright_box import footprint
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.result import RunResult
from objslam.errors import printable

RayKind = Literal["used", "rejected", "unexplained"]
"""The kind of a ray: used for its object, rejected as an outlier of its object, or unexplained by any object."""
DrawnShape = Literal["ellipsoid", "cuboid", "cylinder"]
"""The shapes in which pictures show bodies."""

REJECTED_BELOW = 0.5  # The least robust weight, in [0, 1], of a used ray. A larger value rejects more rays.
_USUAL_REACH = 2.0  # The length of drawn rays, m, if no ray has an object.
_HUES = 12
"""The number of hues on the colour circle. If a map has more labels, the other labels get hues between two of them. With a
larger number, hues are harder to distinguish. With a smaller number, the colour of a label changes more often from map to
map. The number is even, so that the luminances alternate."""
_NEXT = 5  # The step in hues from a taken hue to the next one that is tried. It has no common divisor with `_HUES`.
_NAMED_HUES = {
    **{"red": 0, "orange": 1, "yellow": 2, "lime": 3, "green": 4, "turquoise": 5, "cyan": 6},
    **{"blue": 8, "violet": 9, "purple": 9, "magenta": 10, "pink": 11},
}
"""The hue, from 0 to `_HUES` - 1, of each colour word in labels. A red buoy in blue would mislead the reader."""
_SATURATION = 0.85  # The saturation of the colours of labels, in [0, 1].
_LUMINANCES = (0.09, 0.17)
"""The relative luminances of colours, in [0, 1]. Neighbouring hues have different luminances, so that many colours stay
distinct. Text in either luminance has a contrast of at least 4.5 on white (WCAG 2.1)."""
_CORE, _AROUND = 0.1, 1.5
"""The limits of the shown area of a map without a path. The box of the objects leaves out the share `_CORE` of the objects
on each side. A picture shows all objects whose distance from the box is at most `_AROUND` times its diagonal, or more if
`_FENCE` gives a larger distance. A larger `_CORE` hides more far objects. A larger `_AROUND` hides fewer far objects."""
_KNOWN_HEADING, _LONGER = np.radians(15), 2.0
"""The limits for a cuboid that is drawn with corners. The standard deviation of its yaw must be below `_KNOWN_HEADING`
(rad). Its length must exceed its width by more than `_LONGER` standard deviations of the difference. With 15 degrees, an
error of three sigmas turns a square by 45 degrees, so that its corners are where the middles of its sides were. Without the
second limit, a bottle of TUM fr3_office was drawn as a square. With a larger `_KNOWN_HEADING` or a smaller `_LONGER`, more
round things are drawn as turned squares."""
_OUTLINE_POINTS = 96  # The number of points of a drawn ellipse, which labels avoid. With fewer points, labels fit between.
_MOST, _FENCE = 0.9, (2.0, 0.15, 1.0)
"""The limits for far objects. A picture shows an object up to the largest of three distances from the path. The first is
`_FENCE[0]` times the distance within which the share `_MOST` of the objects lies. The second is the share `_FENCE[1]` of the
diagonal of the path's bounding box. The third is `_FENCE[2]` (m). At 0.15 of the diagonal, a lone object beside a square
path adds a fifth to the area. Larger values show more far objects and shrink the rest of the map."""


def ray_kinds(result: RunResult) -> dict[RayKind, Bools]:
    """Return a mask (R,) of the rays of each kind."""
    explained = result.association.object >= 0
    used = explained & (result.weight >= REJECTED_BELOW)
    return {"used": used, "rejected": explained & ~used, "unexplained": ~explained}


def ray_ends(result: RunResult) -> Floats:
    """Return the point (R, 3), m in map, at which the drawing of each ray ends.

    A ray is as long as the distance to its object. A ray without an object gets the median length of the rays with an
    object.
    """
    index = result.association.object
    reach = np.full(len(index), np.nan)
    held = index >= 0
    positions = np.array([o.position for o in result.map.objects]).reshape(-1, 3)
    reach[held] = np.linalg.norm(positions[index[held]] - result.origins[held], axis=1)
    usual = float(np.nanmedian(reach)) if np.isfinite(reach).any() else _USUAL_REACH
    return result.origins + np.where(np.isfinite(reach), reach, usual)[:, None] * result.directions


def captions(objects: ObjectMap) -> list[str]:
    """Return a caption for each object. The caption is the label, followed by #id if several objects have this label."""
    shared = Counter(o.label for o in objects.objects)
    return [printable(o.label if shared[o.label] == 1 else f"{o.label} #{o.id}") for o in objects.objects]


def label_colours(objects: ObjectMap) -> dict[str, tuple[float, float, float]]:
    """Return a colour (r, g, b in [0, 1]) for each label. Text in this colour on white has a contrast of at least 4.5."""
    return colours_of([o.label for o in objects.objects])


def colours_of(labels: Sequence[str]) -> dict[str, tuple[float, float, float]]:
    """Return a colour for each label, as `label_colours` does."""
    return {name: _colour(slot / _HUES, int(slot)) for name, slot in _slots(labels).items()}


def _slots(labels: Sequence[str]) -> dict[str, float]:
    """Return the place of each label on the circle of hues, from 0 to `_HUES`.

    The place depends on the name, so that a label has the same colour in all maps. A label with the name of a colour has
    this colour, or the nearest free hue. If two other labels have the same place, the later one in the alphabet gets another
    place.
    """
    slots: dict[str, float] = {}
    taken: set[int] = set()
    named = {name: _named_hue(name) for name in set(labels)}
    for number, name in enumerate(sorted(named, key=lambda one: (named[one] is None, one))):
        if number % _HUES == 0:  # All hues are taken. The next labels lie between them: in the middle, then at the quarters.
            taken.clear()
        hue, first = named[name], crc32(name.encode(errors="surrogatepass"))
        if hue is None:
            tried = [first + _NEXT * k for k in range(_HUES)]
        else:  # The hue itself, and then its neighbours on both sides.
            tried = [hue + (-1) ** k * ((k + 1) // 2) for k in range(_HUES)]
        slot = next(one % _HUES for one in tried if one % _HUES not in taken)
        taken.add(slot)
        slots[name] = slot + _between(number // _HUES)
    return slots


def _named_hue(label: str) -> int | None:
    """Return the hue of the first word in a label that names a colour, or None if no word names a colour."""
    words = re.findall("[a-z]+", label.lower())
    return next((_NAMED_HUES[word] for word in words if word in _NAMED_HUES), None)


def _between(turn: int) -> float:
    """Return the number at index `turn` of the series 0, 1/2, 1/4, 3/4, 1/8, ... (van der Corput), which fills the space
    between two hues evenly."""
    return sum((turn >> bit & 1) / 2 ** (bit + 1) for bit in range(turn.bit_length()))


def object_colours(objects: ObjectMap) -> list[tuple[float, float, float]]:
    """Return a colour for each object, as red, green and blue in [0, 1].

    The first object of a label has the label's colour. The other objects of the label have nearby hues.
    """
    slots = _slots([o.label for o in objects.objects])
    shared, earlier = Counter(o.label for o in objects.objects), Counter[str]()
    colours = []
    for o in objects.objects:
        slot, k = slots[o.label], earlier[o.label]
        earlier[o.label] += 1
        colours.append(_colour((slot + 0.8 * k / shared[o.label]) / _HUES, int(slot) + k))
    return colours


def _colour(hue: float, number: int) -> tuple[float, float, float]:
    linear = np.array(colorsys.hsv_to_rgb(hue, _SATURATION, 1.0)) ** 2.2
    # The luminance is the sum of red, green and blue with these weights.
    linear *= _LUMINANCES[number % 2] / float(linear @ [0.2126, 0.7152, 0.0722])
    r, g, b = np.clip(linear, 0.0, 1.0) ** (1 / 2.2)
    return float(r), float(g), float(b)


def ellipsoid(o: MapObject) -> tuple[Floats, Floats] | None:
    """Return the lengths (3,), m, of the half axes of an object's 2-sigma ellipsoid, and a rotation matrix (3, 3).

    The columns of the matrix are the directions of the axes. Return None if the object has no finite covariance.
    """
    if o.covariance is None or not np.isfinite(o.covariance).all():
        return None
    values, axes = np.linalg.eigh(o.covariance)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return 2.0 * np.sqrt(np.maximum(values, 0.0)), axes


def drawn_shape(body: Body) -> DrawnShape:
    """Return the shape in which pictures show a body.

    A sphere is an ellipsoid. A cuboid with an unknown heading is a cylinder of its length, width and height, because the
    directions of its corners are unknown. The heading is the direction of the length. The heading is therefore known only
    if the length is certainly longer than the width.
    """
    if body.shape != "cuboid":
        return "cylinder" if body.shape == "cylinder" else "ellipsoid"
    length, width, _ = body.size
    told_apart = length - width > _LONGER * np.hypot(*body.size_sigma[:2])
    return "cuboid" if body.yaw_sigma < _KNOWN_HEADING and told_apart else "cylinder"


def body_outline(o: MapObject, sigmas: float = 0.0) -> Floats | None:
    """Return the closed outline (n, 2), m, of an object's body seen from above, along z.

    The outline is a rectangle if the body is drawn as a cuboid (`drawn_shape`), and an ellipse otherwise. Return None for an
    unresolved object, for an object without a body, and if the length or the width is not above 0.

    sigmas: the number of standard deviations that are added to the length and the width of the body.
    """
    body = o.body
    if body is None or o.status != "ok":
        return None
    size = body.size + sigmas * body.size_sigma
    if (size[:2] <= 0).any():
        return None
    if drawn_shape(body) == "cuboid":
        corners = footprint((o.position, size, body.yaw))
        return np.concatenate([corners, corners[:1]])
    turn = np.linspace(0, 2 * np.pi, _OUTLINE_POINTS)
    cos, sin = np.cos(body.yaw), np.sin(body.yaw)
    rim = np.stack([np.cos(turn), np.sin(turn)], axis=1) * size[:2] / 2
    return np.asarray(o.position[:2] + rim @ np.array([[cos, sin], [-sin, cos]]))


def sample(mask: Bools, count: int) -> Ints:
    """Return at most `count` of the indices that a mask (N,) selects, in order.

    The choice is random, because every n-th ray may belong to the same object.
    """
    index = np.flatnonzero(mask)
    if len(index) <= count:
        return index
    return np.sort(np.random.default_rng(0).choice(index, count, replace=False))


def evenly(count: int, most: int) -> Ints:
    """Return at most `most` of the indices from 0 to `count` - 1. They are evenly spaced and include both ends."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def frame_objects(objects: Floats, path: Floats) -> tuple[Bools, Floats, Floats]:
    """Return the objects and the area that a picture shows.

    A far object is left out, because it would shrink the rest of the map. `_FENCE` limits the distance of an object from the
    bounding box of the path. This box leaves out 1 % of the path on each side. Without a path, the box is the bounding box
    of the objects, and leaves out the share `_CORE` of them on each side.

    Args:
        objects, path: positions (N, D) and (K, D), m in map.
    Returns:
        A mask (N,) of the shown objects, and the lowest and the highest corner (D,) of the shown area.
    """
    if len(path):
        low, high = np.quantile(path, 0.01, axis=0), np.quantile(path, 0.99, axis=0)
    elif len(known := objects[np.isfinite(objects).all(axis=1)]):
        low, high = np.quantile(known, _CORE, axis=0), np.quantile(known, 1 - _CORE, axis=0)
    else:
        low = high = np.zeros(path.shape[1])
    diagonal = float(np.linalg.norm(high - low))
    off = np.linalg.norm(np.maximum(np.maximum(low - objects, objects - high), 0.0), axis=1)
    known_off = np.sort(off[np.isfinite(off)])
    usual = float(known_off[int(_MOST * (len(known_off) - 1))]) if len(known_off) else 0.0
    fence = max(_FENCE[0] * usual, (_FENCE[1] if len(path) else _AROUND) * diagonal, _FENCE[2])
    inside = np.isfinite(off) & (off <= fence)
    near = path[((path >= low - fence) & (path <= high + fence)).all(axis=1)]
    shown = np.concatenate([near, objects[inside], np.stack([low, high])])
    return inside, shown.min(axis=0), shown.max(axis=0)
