"""Objects: points with labels, covariance ellipsoids, boxes as large as they are, the unresolved as their rays."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from objslam.scene import captions, ellipsoid, object_colours
from objslam.types import Floats, MapObject, ObjectMap, Truth
from objslam.viewer.eye import Eye, label_places

_MAX_LABELS = 60  # the viewer keeps no distance between labels
_TRUTH, _TEXT, _LEADER = (0, 0, 0), (255, 255, 255), (170, 170, 170)


def colours(objects: ObjectMap) -> list[tuple[int, int, int]]:
    """Each object's colour, 0 to 255."""
    return [(round(255 * r), round(255 * g), round(255 * b)) for r, g, b in object_colours(objects)]


def log_objects(recording: Any, objects: ObjectMap, eye: Eye, path: Floats, *, static: bool = True) -> None:
    """`map/objects`: the resolved as points; `.../uncertainty`, their 2-sigma ellipsoids; `.../extent`, boxes as large as
    they look; `.../unresolved`, the ray that each is somewhere on; `.../labels`, all names, rather not on the path (K, 3).

    static: for the whole recording; else for the time that the recording is set to, and then empty where there is nothing,
    so that what was there before goes.
    """
    import rerun as rr

    every, texts, colour = objects.objects, captions(objects), colours(objects)

    def log(name: str, archetype: Any, some: bool) -> None:
        if some or not static:
            recording.log(f"map/objects{name}", archetype, static=static)

    resolved = [i for i, o in enumerate(every) if o.status == "ok"]
    points = rr.Points3D(
        [every[i].position for i in resolved],
        colors=[colour[i] for i in resolved],
        radii=rr.Radius.ui_points(5),
        labels=[texts[i] for i in resolved],
        show_labels=False,
    )
    log("", points, bool(resolved))
    shapes = [(i, shape) for i in resolved if (shape := ellipsoid(every[i])) is not None]
    bodies = rr.Ellipsoids3D(
        centers=[every[i].position for i, _ in shapes],
        half_sizes=[half for _, (half, _) in shapes],
        quaternions=Rotation.from_matrix(np.stack([a for _, (_, a) in shapes])).as_quat() if shapes else [],
        colors=[colour[i] for i, _ in shapes],
        line_radii=rr.Radius.ui_points(0.6),
    )
    log("/uncertainty", bodies, bool(shapes))
    sized = [(i, every[i].extent) for i in resolved if every[i].extent is not None]
    boxes = rr.Boxes3D(
        centers=[every[i].position for i, _ in sized],
        half_sizes=[[e[0] / 2, e[0] / 2, e[1] / 2] for _, e in sized if e is not None],
        colors=[colour[i] for i, _ in sized],
        radii=rr.Radius.ui_points(0.8),
    )
    log("/extent", boxes, bool(sized))
    unresolved = [i for i, o in enumerate(every) if o.ray is not None and np.isfinite(o.position).all()]
    strips = rr.LineStrips3D(
        [_way(every[i]) for i in unresolved], colors=[colour[i] for i in unresolved], radii=rr.Radius.ui_points(1)
    )
    log("/unresolved", strips, bool(unresolved))
    named = [i for i, o in enumerate(every) if np.isfinite(o.position).all()]
    words = [texts[i] if every[i].status == "ok" else f"{texts[i]}, unresolved" for i in named]
    places = np.array([every[i].position for i in named]).reshape(-1, 3)
    shown = len(named) <= _MAX_LABELS
    hung, ends = label_places(eye, places, words, path) if shown else (places, places)
    # the viewer writes a label in its point's colour into a dark box: white is read on it, an object's colour is not
    names = rr.Points3D(hung, colors=[_TEXT], radii=0.0, labels=words, show_labels=shown)
    log("/labels", names, bool(named))
    lines = rr.LineStrips3D(np.stack([places, ends], axis=1), colors=[_LEADER], radii=rr.Radius.ui_points(0.4))
    log("/labels/lines", lines, bool(named) and shown)


def log_truth(recording: Any, truth: Truth) -> None:
    """The true places of the objects, black dots: `map/truth`, static."""
    import rerun as rr

    points = rr.Points3D(
        [o.position for o in truth.objects],
        colors=[_TRUTH],
        radii=rr.Radius.ui_points(3),
        labels=[o.label for o in truth.objects],
        show_labels=False,
    )
    recording.log("map/truth", points, static=True)


def _way(o: MapObject) -> Any:
    assert o.ray is not None
    return np.stack([o.ray[0], o.position])
