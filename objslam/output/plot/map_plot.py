"""The picture map.png: the map from above."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.object_map import MapObject
from objslam.core.result import RunResult, doubtful_ids
from objslam.core.types import Truth
from objslam.frontend.up import from_above, up_axis
from objslam.mapping.checks.assessment import HEADLINES
from objslam.output.plot.figure import Area, Colour, Figure, Label, Line, Marks, Segments, Shape
from objslam.output.plot.labels import make_labels, shortened
from objslam.output.plot.page import render
from objslam.output.plot.style import body_outline, captions, frame_objects, label_colours, ray_ends, ray_kinds, sample

_MAX_RAYS = 2000  # The largest number of used rays in the picture. More rays would merge into one blue area.
_MAX_REJECTED = 400  # The largest number of rejected rays in the picture. It is small, because they cross the whole map.
_MAX_LABELS = 150  # The largest number of labels in the picture. The objects with the most rays come first.
_PATH_POINTS = 1500  # The largest number of points of the path that labels avoid.
_WEIGHT = 5  # The cost of a covered point of a cross or an ellipse, as a multiple of the cost of a point of the path.
_CROSS = 17.0  # The width and height of the cross of a true object, px.
_DOT, _START = 11.0, 15.0  # The diameters of the dot of an object, and of the circle at the start of the path, px.
_ELLIPSE_POINTS = 96  # The number of points of a drawn ellipse, which labels avoid. With fewer points, labels fit between.
_LONG_SIDE, _SHORT_SIDE = 1350.0, 600.0  # The longer side of the map, and its least width, px. Its least height is 300 px.
_GROWTH = 0.4
"""Ellipses may widen the shown area on each side by at most this share of its longer side. The edge of the picture cuts off
larger ellipses. A larger share shows more of large ellipses, and shrinks the rest of the map. At 0.4, the ellipse of a cup
is whole after a drive of 1 m past the cup, and no ellipse shrinks the rest to less than half."""
_EDGE = 0.985  # The place of a far object's triangle, as a share of the way from the picture's centre to its edge.
_TRIANGLE = 18.0  # The length of the triangle of a far object, px.
_PATH, _BAND = 2.0, 1.0  # The widths, px, of a path, and of the outlines of a body that is 2 sigma smaller or larger.
_LIGHT = 0.45  # The share of white, from 0 to 1, in the colour of the outlines of a body that is 2 sigma smaller or larger.
_TAG, _NORMAL = 4.0, 0.3  # The width, px, of the outline of a fiducial, and the length, m, of the line along its normal.
_USED, _REJECTED = (0.561, 0.749, 0.933), (0.937, 0.561, 0.525)  # Used rays are light blue, and rejected rays are light red.
_BEFORE, _AFTER = (0.541, 0.541, 0.541), (0.188, 0.204, 0.231)  # The colours of the path before and after the estimation.
_TRUE = (0.180, 0.545, 0.341)  # The colour of the true path, as in the viewer.
_NEUTRAL = (0.333, 0.333, 0.333)  # The legend shows objects in this colour, because each label has its own colour.
_WHITE, _BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
_DOUBT = (0.769, 0.345, 0.0)  # The rim of a doubtful object is orange, as doubts are in the viewer.


def draw_map(result: RunResult, file: Path, truth: Truth | None = None) -> None:
    """Draw the paths, rays, objects and ground truth from above, as a PNG file.

    truth: the ground truth in the map's frame. Raises OSError if the file cannot be written.
    """
    file.write_bytes(render(map_figure(result, truth)))


def map_figure(result: RunResult, truth: Truth | None = None) -> Figure:
    """Return the figure of a map from above. truth: the ground truth in the map's frame."""
    plane = from_above(up_axis(result.keyframes))
    points = result.map.positions[:, plane]
    crosses = np.array([o.position[plane] for o in truth.objects] if truth else []).reshape(-1, 2)
    shown, low, high = _frame(result, plane, points, crosses)
    margin = 0.07 * float((high - low).max()) + 0.05
    low, high = low - margin, high + margin
    scale = _LONG_SIDE / float((high - low).max())
    wider = np.maximum(np.array([_SHORT_SIDE, _SHORT_SIDE / 2]) / scale - (high - low), 0.0) / 2
    low, high = low - wider, high + wider
    below, dots = _objects(result, plane, points)
    shapes = [*_rays(result, plane), *_paths(result, truth, plane), *below]
    if len(crosses):
        shapes.append(Marks(crosses, "cross", _BLACK, _BLACK, _CROSS, "ground truth"))
    ok = np.array([o.status == "ok" for o in result.map], dtype=bool)
    far = ok & ~shown & np.isfinite(points).all(axis=1)
    at, beyond = _at_edge(points[far], low, high)
    dots += _far([o for o, is_far in zip(result.map, far.tolist(), strict=True) if is_far], result, at, (low + high) / 2)
    figure = Figure(
        title=_title(result),
        axes=("xyz"[plane[0]], "xyz"[plane[1]]),
        low=low,
        high=high,
        scale=scale,
        shapes=(*shapes, *dots),
        legend=_legend(result),
    )
    doubtful = _doubtful(result)
    names = np.array(
        [shortened(name) + " ?" * (o.id in doubtful) for o, name in zip(result.map, captions(result.map), strict=True)],
        dtype=object,
    )
    names[far] = [f"{name}, {away:.1f} m out" for name, away in zip(names[far], beyond, strict=True)]
    points[far] = at
    seen = [o for o, is_shown in zip(result.map, shown.tolist(), strict=True) if is_shown]
    rims = [*(_ellipse(o, plane) for o in seen), *(body_outline(o) for o in seen if plane == [0, 1])]
    outlines = np.concatenate([np.zeros((0, 2)), *(rim for rim in rims if rim is not None)])
    path = result.map_T_base[sample(np.ones(len(result.map_T_base), dtype=bool), _PATH_POINTS)][:, plane, 3]
    labels = _labels(figure, result, points, shown | far, names, (path, crosses, outlines))
    left_out = int((shown | far).sum()) - len(labels)
    note = f"{left_out} label{'s have' if left_out > 1 else ' has'} no room" if left_out else ""
    return replace(figure, labels=labels, note=note, warning=_warning(result))


def _frame(result: RunResult, plane: list[int], points: Floats, crosses: Floats) -> tuple[Bools, Floats, Floats]:
    """Return a mask (N,) of the shown objects, and the lower left and the upper right corner of the shown area, m."""
    path = result.map_T_base[:, plane, 3]
    shown, low, high = frame_objects(np.concatenate([points, crosses]), path)
    side = (high - low).max()
    half = np.full_like(points, np.nan)  # The half sides of the boxes around the shown 2-sigma ellipses.
    for j, o in enumerate(result.map.objects):
        if o.status == "ok" and o.covariance is not None and shown[j]:
            half[j] = 2 * np.sqrt(np.maximum(np.diag(o.covariance)[plane], 0.0))
    drawn = np.isfinite(half).all(axis=1)
    corners = np.concatenate([points[drawn] - half[drawn], points[drawn] + half[drawn]])
    # A path with much drift, or a huge ellipse, must not shrink the rest of the map.
    before = np.clip(result.path.poses[:, plane, 3], low - 0.15 * side, high + 0.15 * side)
    both = np.concatenate([before, np.clip(corners, low - _GROWTH * side, high + _GROWTH * side), [low, high]])
    return shown[: len(points)], both.min(axis=0), both.max(axis=0)


def _rays(result: RunResult, plane: list[int]) -> list[Shape]:
    kinds, ends = ray_kinds(result), ray_ends(result)
    used, out = kinds["used"], kinds["rejected"]
    many = f"rejected rays ({int(out.sum()):,})"
    shapes: list[Shape] = []
    for mask, colour, most, name in ((used, _USED, _MAX_RAYS, "rays"), (out, _REJECTED, _MAX_REJECTED, many)):
        index = sample(mask, most)
        if len(index):
            # The more lines there are, the fainter they are, so that objects stay visible.
            opacity = float(np.clip(125 / len(index), 0.2, 0.75))
            shapes.append(
                Segments(np.stack([result.origins[index][:, plane], ends[index][:, plane]], axis=1), colour, opacity, name)
            )
    return shapes


def _paths(result: RunResult, truth: Truth | None, plane: list[int]) -> list[Shape]:
    before, after = result.path.poses[:, plane, 3], result.path_after.poses[:, plane, 3]
    moved = not np.array_equal(result.map_T_base, result.keyframes.map_T_base)
    shapes: list[Shape] = [Line(before, _BEFORE, _PATH, "path before", dashed=True)] if moved else []
    shapes.append(Line(after, _AFTER, _PATH, "path after" if moved else "path"))
    if truth is not None and truth.trajectory is not None:  # Thin, and above, because both should coincide.
        shapes.append(Line(truth.trajectory.poses[:, plane, 3], _TRUE, _BAND, "true path"))
    if len(after):
        shapes.append(Marks(after[:1], "dot", _WHITE, _AFTER, _START, "start"))
    return shapes


def _objects(result: RunResult, plane: list[int], points: Floats) -> tuple[list[Shape], list[Shape]]:
    """Return two lists: the ellipses, outlines and dashed rays of the objects, and their dots. points: (N, 2), m."""
    colours, doubtful = label_colours(result.map), _doubtful(result)
    below: list[Shape] = []
    dots: list[Shape] = []
    for o, point in zip(result.map.objects, points, strict=True):
        colour = colours[o.label]
        if o.status == "unresolved":
            start = o.ray[0][plane] if o.ray is not None else point
            below.append(Line(np.stack([start, point]), colour, _PATH, dashed=True))
            dots.append(Marks(point[None], "dot", _WHITE, colour, _DOT - 1, ""))
            continue
        dots.append(Marks(point[None], "dot", colour, _DOUBT if o.id in doubtful else _WHITE, _DOT))
        rim = _ellipse(o, plane)
        if rim is not None:
            below.append(Area(rim, colour, 0.18))
        outline = body_outline(o) if plane == [0, 1] else None  # A body stands along z.
        if outline is not None:
            band = [rim for sigmas in (-2.0, 2.0) if (rim := body_outline(o, sigmas)) is not None]
            below += [Line(rim, _lighter(colour), _BAND) for rim in band]
            below.append(Line(outline, colour, _PATH))
        if o.tag is not None:
            below.append(Line(o.tag.outline(o.position)[:, plane], colour, _TAG))
            below.append(Line(np.stack([o.position, o.position + _NORMAL * o.tag.rotation[:, 2]])[:, plane], colour, _PATH))
    return below, dots


def _doubtful(result: RunResult) -> set[int]:
    """Return the ids of the objects that may be doubles, several things, or at a wrong place."""
    return doubtful_ids(result.doubts, ("pair", "split", "moved")) & {o.id for o in result.map.resolved()}


def _lighter(colour: Colour) -> Colour:
    """Return a colour between this one and white."""
    r, g, b = (_LIGHT + (1 - _LIGHT) * part for part in colour)
    return r, g, b


def _legend(result: RunResult) -> tuple[Line | Marks, ...]:
    """Return the entries of the legend for objects."""
    nowhere, resolved = np.zeros((0, 2)), len(result.map.resolved())
    entries: list[Line | Marks] = []
    if resolved:
        entries.append(Marks(nowhere, "dot", _NEUTRAL, _WHITE, _DOT, "objects, 2 sigma"))
    if any(o.body is not None for o in result.map):
        entries.append(Line(nowhere, _NEUTRAL, _PATH, "their bodies"))
        entries.append(Line(nowhere, _lighter(_NEUTRAL), _BAND, "2 sigma of their sizes"))
    if any(o.tag is not None for o in result.map):
        entries.append(Line(nowhere, _NEUTRAL, _TAG, "fiducials and their normals"))
    if _doubtful(result):
        entries.append(Marks(nowhere, "dot", _NEUTRAL, _DOUBT, _DOT, "doubtful (objslam explain)"))
    if resolved < len(result.map):
        entries.append(Marks(nowhere, "dot", _WHITE, _NEUTRAL, _DOT - 1, "unresolved"))
    return tuple(entries)


def _ellipse(o: MapObject, plane: list[int]) -> Floats | None:
    """Return the rim (_ELLIPSE_POINTS, 2), m, of an object's 2-sigma ellipse in the plane. Return None for an unresolved
    object, or without a finite covariance."""
    if o.status != "ok" or o.covariance is None or not np.isfinite(o.covariance).all():
        return None
    turn = np.linspace(0, 2 * np.pi, _ELLIPSE_POINTS, endpoint=False)
    values, vectors = np.linalg.eigh(o.covariance[np.ix_(plane, plane)])
    return o.position[plane] + 2 * ((vectors * np.sqrt(np.maximum(values, 0))) @ np.stack([np.cos(turn), np.sin(turn)])).T


def _at_edge(points: Floats, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return, for each far point (F, 2), the point (F, 2) at the picture's edge in the same direction, and the distance (F,)
    between the two points, all in m."""
    centre, half = (low + high) / 2, (high - low) / 2
    at = centre + (points - centre) * (_EDGE / (np.abs(points - centre) / half).max(axis=1, initial=1e-9))[:, None]
    return at, np.linalg.norm(points - at, axis=1)


def _far(objects: list[MapObject], result: RunResult, at: Floats, centre: Floats) -> list[Shape]:
    """Return, for each object far outside, a triangle that points to the object. at: (F, 2) places at the picture's edge, m.
    centre: (2,) centre of the picture, m."""
    colours = label_colours(result.map)
    return [
        Marks(place[None], "triangle", colours[o.label], _WHITE, _TRIANGLE, "", float(np.arctan2(*(place - centre)[::-1])))
        for o, place in zip(objects, at, strict=True)
    ]


def _title(result: RunResult) -> str:
    resolved, total, rays = len(result.map.resolved()), len(result.map), len(result.rays)
    text = f"{resolved} object{'s' * (resolved != 1)}"
    if total > resolved:
        text += f" and {total - resolved} unresolved"
    text += f" from {rays:,} rays of {len(result.keyframes):,} keyframes, {result.settings.mode} mode"
    lost = int((~np.isfinite(result.map.positions).all(axis=1)).sum())
    return text + (f"\n{lost} of them without a position" if lost else "")


def _warning(result: RunResult) -> str:
    """Return the reason why the map should not be trusted. Return "" for a good map, or without an assessment."""
    judged = result.summary.get("assessment", {"level": "good"})
    said = HEADLINES[judged["level"]]
    return "" if judged["level"] == "good" else " ".join([said, *judged["reasons"]])


def _labels(
    figure: Figure, result: RunResult, points: Floats, shown: Bools, names: Any, avoid: tuple[Floats, Floats, Floats]
) -> tuple[Label, ...]:
    """Return at most `_MAX_LABELS` placed labels. A label without a free place is left out.

    points: (N, 2) m. shown: (N,) which objects may have a label. names: (N,) the texts. avoid: three arrays of points
    (P, 2), m, that labels should not cover: of the path, of the crosses, and of the ellipses and outlines of bodies.
    """
    path, crosses, outlines = (figure.pixels(part) for part in avoid)
    colours = label_colours(result.map)
    order = np.argsort([-o.rays for o in result.map.objects], kind="stable")
    chosen = [int(j) for j in order if shown[j]][:_MAX_LABELS]
    arms = crosses[:, None] + _CROSS / 2 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    heavy = np.repeat(np.concatenate([arms.reshape(-1, 2), outlines]), _WEIGHT, axis=0)
    painted = [colours[result.map.objects[j].label] for j in chosen]
    return make_labels(figure, names[chosen].tolist(), painted, points[chosen], np.concatenate([path, heavy]))
