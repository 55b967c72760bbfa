"""The picture map.png: the map from above."""

import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.object_map import MapObject
from objslam.core.result import RunResult
from objslam.core.types import Truth
from objslam.frontend.up import from_above, up_axis
from objslam.output.plot.label_layout import needs_leader, place_labels
from objslam.output.plot.style import captions, frame_objects, label_colours, ray_ends, ray_kinds, sample

_MAX_RAYS = 2000  # The picture shows at most this many used rays. More rays would merge into one blue area.
_MAX_REJECTED = 400  # The picture shows at most this many rejected rays, because they cross the whole map.
_MAX_LABELS = 150  # The picture has at most this many labels. The objects with the most rays come first.
_MAX_LETTERS = 28  # A label has at most this many letters. An ellipsis replaces the rest.
_PATH_POINTS = 1500  # Labels avoid at most this many points of the path.
_WEIGHT = 5  # A label avoids each point of a cross or of an ellipse as much as this many points of the path.
_CROSS_SIZE = 8.0  # The cross of a true object has this width and height, points.
_ELLIPSE_POINTS = 96  # A label avoids this many points of an ellipse. With fewer, its corner fits between two of them.
_LONG_SIDE, _SHORT_SIDE = 9.0, 5.5  # The longer side of the map and the smallest width of the figure, inches.
_EDGE = 0.985  # The triangle of a far object is this share of the way from the centre of the picture to its edge.
_FONT = 8.0  # Labels and legend have this font size, points.
_USED, _REJECTED = "#8fbfee", "#ef8f86"  # Used rays are light blue, and rejected rays are light red.
_BEFORE, _AFTER, _NEUTRAL = "#8a8a8a", "#30343b", "#555555"  # Colours of the path before, the path after, the legend.


def draw_map(result: RunResult, file: Path, truth: Truth | None = None) -> None:
    """Draw the paths, rays, objects and ground truth from above as a PNG. OSError if the file cannot be written."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # The user's own style may use TeX or white text.
        _draw(result, file, truth)


def _draw(result: RunResult, file: Path, truth: Truth | None) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    up = up_axis(result.keyframes)
    plane = from_above(up)
    points = result.map.positions[:, plane]
    crosses = np.array([o.position[plane] for o in truth.objects] if truth else []).reshape(-1, 2)
    shown, low, high = _frame(result, plane, points, crosses)
    margin = 0.07 * float((high - low).max()) + 0.05
    low, high = low - margin, high + margin
    width, height = (high - low) / (high - low).max() * _LONG_SIDE
    size = max(width, _SHORT_SIDE) + 0.6, max(height, 0.5 * _SHORT_SIDE) + 1.3  # The added inches are for title and legend.
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_aspect("equal", adjustable="box")
    axes.set(
        xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel=f"{'xyz'[plane[0]]} (m)", ylabel=f"{'xyz'[plane[1]]} (m)"
    )
    axes.grid(True, color="#ececec", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in axes.spines.values():
        side.set_color("#c4c4c4")
    _draw_rays(axes, result, plane)
    _draw_paths(axes, result, plane)
    if len(crosses):
        axes.plot(
            *crosses.T, "+", color="black", markersize=_CROSS_SIZE, markeredgewidth=1.1, zorder=6, label="ground truth"
        )
    _draw_objects(axes, result, plane, points)
    ok = np.array([o.status == "ok" for o in result.map], dtype=bool)
    far = ok & ~shown & np.isfinite(points).all(axis=1)
    at, beyond = _at_edge(points[far], low, high)
    _draw_far(axes, [o for o, is_far in zip(result.map, far.tolist(), strict=True) if is_far], result, at, (low + high) / 2)
    axes.set_title(_title(result), fontsize=10, loc="left")
    legend = figure.legend(loc="outside lower left", ncols=4, fontsize=_FONT, frameon=False)
    for handle in legend.get_lines():
        handle.set(alpha=1.0, linewidth=1.2)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph", category=UserWarning)  # The font may lack letters of a label.
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # Labels are placed by pixels, so the layout is frozen.
        names = np.array([" ".join(name.split()) for name in captions(result.map)], dtype=object)
        names = np.array([_shortened(name) for name in names], dtype=object)
        names[far] = [f"{name}, {away:.1f} m out" for name, away in zip(names[far], beyond, strict=True)]
        points[far] = at
        rims = _outlines(result, plane, shown)
        left_out = _draw_labels(axes, canvas.get_renderer(), result, plane, points, shown | far, names, crosses, rims)
        if left_out:
            note = f"{left_out} labels have no room"
            axes.text(1, 1.005, note, transform=axes.transAxes, ha="right", va="bottom", fontsize=7, color="#777777")
        _save(figure, canvas, file)


def _save(figure: Any, canvas: Any, file: Path) -> None:
    """Write the figure as a PNG of 256 colours. It looks the same, and is a fifth of the size of all colours."""
    from PIL import Image

    pixels = io.BytesIO()
    figure.savefig(pixels, format="rgba")
    image = Image.frombytes("RGBA", canvas.get_width_height(), pixels.getvalue()).convert("RGB")
    few = image.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    # The method makes white a shade darker. The paper, as in the first pixel, stays white.
    palette, paper = few.getpalette() or [], int(np.asarray(few)[0, 0])
    palette[3 * paper : 3 * paper + 3] = [255, 255, 255]
    few.putpalette(palette)
    with file.open("wb") as stream:
        few.save(stream, format="png")


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
    both = np.concatenate([before, np.clip(corners, low - side, high + side), [low, high]])
    return shown[: len(points)], both.min(axis=0), both.max(axis=0)


def _draw_rays(axes: Any, result: RunResult, plane: list[int]) -> None:
    from matplotlib.collections import LineCollection

    kinds, ends = ray_kinds(result), ray_ends(result)
    used, out = kinds["used"], kinds["rejected"]
    many = f"rejected rays ({int(out.sum()):,})"
    for mask, colour, most, label in ((used, _USED, _MAX_RAYS, "rays"), (out, _REJECTED, _MAX_REJECTED, many)):
        index = sample(mask, most)
        if len(index):
            lines = list(np.stack([result.origins[index][:, plane], ends[index][:, plane]], axis=1))
            alpha = float(np.clip(150 / len(index), 0.25, 0.9))  # Many lines are fainter, so that objects stay visible.
            drawn = LineCollection(lines, colors=colour, linewidths=0.4, alpha=alpha, label=label, zorder=1)
            axes.add_collection(drawn, autolim=False)


def _draw_paths(axes: Any, result: RunResult, plane: list[int]) -> None:
    before, after = result.path.poses[:, plane, 3], result.path_after.poses[:, plane, 3]
    moved = not np.array_equal(result.map_T_base, result.keyframes.map_T_base)
    if moved:
        axes.plot(*before.T, "--", color=_BEFORE, linewidth=1.0, zorder=2, label="path before")
    axes.plot(*after.T, "-", color=_AFTER, linewidth=1.1, zorder=3, label="path after" if moved else "path")
    if len(after):
        axes.plot(*after[0], "o", color="white", markeredgecolor=_AFTER, markersize=7, zorder=4, label="start", linestyle="")


def _draw_objects(axes: Any, result: RunResult, plane: list[int], points: Floats) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Ellipse

    colours = label_colours(result.map)
    for o, point in zip(result.map.objects, points, strict=True):
        colour = colours[o.label]
        if o.status == "unresolved":
            start = o.ray[0][plane] if o.ray is not None else point
            axes.plot(*np.stack([start, point]).T, "--", color=colour, linewidth=1.0, zorder=5, dashes=(4, 3))
            axes.plot(*point, "o", color="white", markeredgecolor=colour, markersize=4.5, zorder=7)
            continue
        axes.plot(*point, "o", color=colour, markeredgecolor="white", markeredgewidth=0.5, markersize=5, zorder=7)
        if o.covariance is not None and np.isfinite(o.covariance).all():
            values, vectors = np.linalg.eigh(o.covariance[np.ix_(plane, plane)])
            width, height = 2 * 2 * np.sqrt(np.maximum(values, 0))
            angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
            style: dict[str, Any] = {"facecolor": (*colour, 0.18), "edgecolor": colour, "lw": 0.9, "zorder": 6}
            axes.add_patch(Ellipse(point, width, height, angle=angle, **style))
    # The legend shows objects in a neutral colour, because each label has its own colour.
    dot: dict[str, Any] = {"marker": "o", "color": _NEUTRAL}
    if result.map.resolved():
        axes.add_line(Line2D([], [], **dot, linestyle="", markersize=5, label="objects, 2 sigma"))
    if len(result.map.resolved()) < len(result.map):
        hollow: dict[str, Any] = {"markerfacecolor": "white", "linestyle": "--", "lw": 1, "markersize": 4.5}
        axes.add_line(Line2D([], [], **dot, **hollow, label="unresolved"))


def _at_edge(points: Floats, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return the points (F, 2) at the edge of the picture towards far points (F, 2), and the ways (F,) between them, m."""
    centre, half = (low + high) / 2, (high - low) / 2
    at = centre + (points - centre) * (_EDGE / (np.abs(points - centre) / half).max(axis=1, initial=1e-9))[:, None]
    return at, np.linalg.norm(points - at, axis=1)


def _draw_far(axes: Any, objects: list[MapObject], result: RunResult, at: Floats, centre: Floats) -> None:
    """Draw a triangle at the edge, at (F, 2), for each object that is far outside. It points to the object."""
    colours = label_colours(result.map)
    for o, place in zip(objects, at, strict=True):
        turn = np.degrees(np.arctan2(*(place - centre)[::-1])) - 90
        axes.plot(*place, marker=(3, 0, turn), markersize=8, color=colours[o.label], markeredgewidth=0, zorder=7)


def _outlines(result: RunResult, plane: list[int], shown: Bools) -> Floats:
    """Return points (P, 2), m, on the 2-sigma ellipses of the shown objects."""
    turn = np.linspace(0, 2 * np.pi, _ELLIPSE_POINTS, endpoint=False)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    points = [np.zeros((0, 2))]
    for o in (o for o, seen in zip(result.map.objects, shown.tolist(), strict=True) if seen):
        if o.status == "ok" and o.covariance is not None and np.isfinite(o.covariance).all():
            values, vectors = np.linalg.eigh(o.covariance[np.ix_(plane, plane)])
            points.append(o.position[plane] + 2 * ((vectors * np.sqrt(np.maximum(values, 0))) @ circle).T)
    return np.concatenate(points)


def _title(result: RunResult) -> str:
    resolved, total, rays = len(result.map.resolved()), len(result.map), len(result.rays)
    text = f"{resolved} object{'s' * (resolved != 1)}"
    if total > resolved:
        text += f" and {total - resolved} unresolved"
    text += f" from {rays:,} rays of {len(result.keyframes):,} keyframes, {result.settings.mode} mode"
    lost = int((~np.isfinite(result.map.positions).all(axis=1)).sum())
    return text + (f"\n{lost} of them without a position" if lost else "")


def _shortened(name: str) -> str:
    return name if len(name) <= _MAX_LETTERS else name[: _MAX_LETTERS - 1] + "…"


def _draw_labels(
    axes: Any,
    renderer: Any,
    result: RunResult,
    plane: list[int],
    points: Floats,
    shown: Bools,
    names: Any,
    crosses: Floats,
    rims: Floats,
) -> int:
    """Draw at most `_MAX_LABELS` labels, and return the number of shown objects without a label.

    names: (N,) the texts. rims: (P, 2) points, m, that labels avoid as they avoid the crosses.
    """
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2.2, foreground="white", alpha=0.85)]
    colours = label_colours(result.map)
    style = {"fontsize": _FONT, "ha": "left", "va": "bottom", "parse_math": False, "zorder": 9, "path_effects": halo}
    order = np.argsort([-o.rays for o in result.map.objects], kind="stable")
    chosen = [int(j) for j in order if shown[j]][:_MAX_LABELS]
    texts = [axes.text(0, 0, text, **style) for text in names[chosen]]
    boxes = [text.get_window_extent(renderer) for text in texts]
    sizes = np.array([(box.width, box.height) for box in boxes]).reshape(-1, 2)
    to_pixels, from_pixels = axes.transData, axes.transData.inverted()
    anchors = to_pixels.transform(points[chosen]) if chosen else np.zeros((0, 2))
    frame = axes.get_window_extent(renderer)
    path = result.map_T_base[sample(np.ones(len(result.map_T_base), dtype=bool), _PATH_POINTS)][:, plane, 3]
    arm = _CROSS_SIZE / 2 * axes.figure.dpi / 72
    arms = to_pixels.transform(crosses)[:, None] + arm * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    avoid = np.concatenate(
        [
            to_pixels.transform(path),
            np.repeat([*arms.reshape(-1, 2), *to_pixels.transform(rims)], _WEIGHT, axis=0).reshape(-1, 2),
        ]
    )
    edges = np.array([[frame.x0, frame.y0], [frame.x1, frame.y1]])
    corners, found = place_labels(anchors, sizes, edges, avoid)
    led = needs_leader(anchors, corners, sizes)
    for i, (j, text) in enumerate(zip(chosen, texts, strict=True)):
        if not found[i]:
            text.remove()
            continue
        colour = colours[result.map.objects[j].label]
        text.set(position=from_pixels.transform(corners[i]), color=colour)
        if led[i]:
            near = np.clip(anchors[i], corners[i], corners[i] + sizes[i])
            ends = from_pixels.transform(np.stack([anchors[i], near]))
            axes.plot(*ends.T, "-", color=colour, linewidth=0.6, alpha=0.8, zorder=8)
    return int(shown.sum() - found.sum())
