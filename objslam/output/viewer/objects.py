"""Log objects to a recording: points, labels, covariance ellipsoids, boxes, and a line for each unresolved object."""

from typing import Any

import numpy as np
import rerun as rr

from objslam.core.arrays import Floats
from objslam.core.bodies.body import Body
from objslam.core.bodies.tag_pose import TagPose
from objslam.core.geometry import lift_se2
from objslam.core.object_map import ObjectMap
from objslam.core.rotation import quaternion_from_rotation
from objslam.core.types import Truth
from objslam.errors import printable
from objslam.output.plot.style import DrawnShape, captions, drawn_shape, ellipsoid, object_colours
from objslam.output.viewer.view_point import ViewPoint, label_places

_MAX_LABELS = 60  # The largest number of objects of a map whose labels are visible at first. More labels would overlap.
_OPACITY = 90  # The opacity of bodies, 0 to 255. More opaque bodies hide the points and ellipsoids inside them.
_AXES = ((220, 50, 47), (70, 160, 60), (40, 110, 220))  # The RGB colours of the axes x, y and z.
_TRUTH, _TEXT, _LEADER = (0, 0, 0), (255, 255, 255), (170, 170, 170)  # The RGB colours are black, white, grey.


def colours(objects: ObjectMap) -> list[tuple[int, int, int]]:
    """Return the RGB colour, 0 to 255, of each object."""
    return [(round(255 * r), round(255 * g), round(255 * b)) for r, g, b in object_colours(objects)]


def log_objects(recording: Any, objects: ObjectMap, view_point: ViewPoint, path: Floats, *, static: bool = True) -> None:
    """Log the resolved objects as points, `map/objects`, and the entities below it.

    `uncertainty` has the 2-sigma ellipsoids of resolved objects, and `extent` has boxes of their size. `ellipsoids`,
    `cuboids` and `cylinders` have the bodies of objects, filled. `tags` has the outlines of fiducials, and `tags/axes` has
    their axes: x red, y green, z blue. `unresolved` has the ray of each unresolved object. `labels` has the captions of all
    objects.

    Args:
        path: (K, 3) points, m in map, that labels should not cover.
        static: whether the objects are static. If not, they are logged at the current time of the recording, and an entity
            without objects is logged to clear the earlier objects.
    """
    every, texts, colour = objects.objects, captions(objects), colours(objects)

    def log(name: str, archetype: Any, some: bool, *more: Any) -> None:
        if some or not static:
            recording.log(f"map/objects{name}", archetype, *more, static=static)

    resolved = [i for i, o in enumerate(every) if o.status == "ok"]
    dots, shades = [every[i].position for i in resolved], [colour[i] for i in resolved]
    known = [texts[i] for i in resolved]
    points = rr.Points3D(dots, colors=shades, labels=known, radii=rr.Radius.ui_points(5), show_labels=False)
    log("", points, bool(resolved))
    shapes = [(i, shape) for i in resolved if (shape := ellipsoid(every[i])) is not None]
    bodies = rr.Ellipsoids3D(
        centers=[every[i].position for i, _ in shapes],
        half_sizes=[half for _, (half, _) in shapes],
        quaternions=quaternion_from_rotation(np.stack([a for _, (_, a) in shapes])) if shapes else [],
        colors=[colour[i] for i, _ in shapes],
        line_radii=rr.Radius.ui_points(0.6),
    )
    log("/uncertainty", bodies, bool(shapes))
    sized = [(i, every[i].extent) for i in resolved if every[i].extent is not None and every[i].body is None]
    boxes = rr.Boxes3D(
        centers=[every[i].position for i, _ in sized],
        half_sizes=[[e[0] / 2, e[0] / 2, e[1] / 2] for _, e in sized if e is not None],
        colors=[colour[i] for i, _ in sized],
        radii=rr.Radius.ui_points(0.8),
    )
    log("/extent", boxes, bool(sized))
    _log_bodies(log, [(o.position, o.body, colour[i]) for i, o in enumerate(every) if o.body is not None])
    _log_tags(log, [(o.position, o.tag, colour[i]) for i in resolved if (o := every[i]).tag is not None])
    named = [i for i, o in enumerate(every) if np.isfinite(o.position).all()]
    unresolved = [(i, (ray[0], every[i].position)) for i in named if (ray := every[i].ray) is not None]
    ways = [way for _, way in unresolved]
    strips = rr.LineStrips3D(ways, colors=[colour[i] for i, _ in unresolved], radii=rr.Radius.ui_points(1))
    log("/unresolved", strips, bool(unresolved))
    words = [texts[i] if every[i].status == "ok" else f"{texts[i]}, unresolved" for i in named]
    places = np.array([every[i].position for i in named]).reshape(-1, 3)
    shown = len(named) <= _MAX_LABELS
    hung, ends = label_places(view_point, places, words, path) if shown else (places, places)
    # A label has the colour of its point, on a dark box. Only white is legible there.
    names = rr.Points3D(hung, colors=[_TEXT], radii=0.0, labels=words, show_labels=shown)
    log("/labels", names, bool(named))
    lines = rr.LineStrips3D(np.stack([places, ends], axis=1), colors=[_LEADER], radii=rr.Radius.ui_points(0.4))
    log("/labels/lines", lines, bool(named) and shown)


def _log_bodies(log: Any, bodies: list[tuple[Floats, Body, tuple[int, int, int]]]) -> None:
    """Log bodies as filled shapes (`drawn_shape`). The 2-sigma ellipsoids, in contrast, are lines."""
    shapes: tuple[DrawnShape, ...] = ("ellipsoid", "cuboid", "cylinder")
    for shape in shapes:
        some = [one for one in bodies if drawn_shape(one[1]) == shape]
        places, sizes = [place for place, _, _ in some], [body.size for _, body, _ in some]
        turns = lift_se2(np.array([[0.0, 0.0, body.yaw] for _, body, _ in some]).reshape(-1, 3))[:, :3, :3]
        quaternions = quaternion_from_rotation(turns)
        look: dict[str, Any] = {"colors": [(*colour, _OPACITY) for _, _, colour in some], "fill_mode": "solid"}
        if shape == "cylinder":
            # A cylinder of rerun has one radius, but each may be scaled to its own length, width and height.
            poses = rr.InstancePoses3D(translations=places, quaternions=quaternions, scales=sizes)
            unit = rr.Cylinders3D(lengths=np.ones(len(some)), radii=np.full(len(some), 0.5), **look)
            log("/cylinders", unit, bool(some), poses)
            continue
        kind = rr.Boxes3D if shape == "cuboid" else rr.Ellipsoids3D
        half = [size / 2 for size in sizes]
        log(f"/{shape}s", kind(centers=places, half_sizes=half, quaternions=quaternions, **look), bool(some))


def _log_tags(log: Any, tags: list[tuple[Floats, TagPose, tuple[int, int, int]]]) -> None:
    """Log the outlines of fiducials, and three arrows with the length of their side: x red, y green, z blue."""
    outlines = [tag.outline(place) for place, tag, _ in tags]
    log("/tags", rr.LineStrips3D(outlines, colors=[c for *_, c in tags], radii=rr.Radius.ui_points(1.5)), bool(tags))
    axes = rr.Arrows3D(
        origins=[place for place, _, _ in tags for _ in _AXES],
        vectors=[tag.size * axis for _, tag, _ in tags for axis in tag.rotation.T],
        colors=[colour for _ in tags for colour in _AXES],
        radii=rr.Radius.ui_points(1.5),
    )
    log("/tags/axes", axes, bool(tags))


def log_truth(recording: Any, truth: Truth) -> None:
    """Log the true objects as static black dots, `map/truth`."""
    places, labels = [o.position for o in truth.objects], [printable(o.label) for o in truth.objects]
    points = rr.Points3D(places, colors=[_TRUTH], labels=labels, radii=rr.Radius.ui_points(3), show_labels=False)
    recording.log("map/truth", points, static=True)
