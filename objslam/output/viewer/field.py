"""The proximity field of one object: Eq. 1's cost on two slices of the map, its minimum, and the rays that pull on it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from objslam.core.arrays import Bools, Floats
from objslam.core.object_map import MapObject, ObjectMap
from objslam.errors import ConfigError, OutputError
from objslam.output.plot.style import RayKind, captions, evenly
from objslam.output.viewer.objects import log_objects
from objslam.output.viewer.rays import RAY_COLOURS
from objslam.output.viewer.view_point import ViewPoint, first_view_point, look_at
from objslam.results.files import RECORDING
from objslam.results.read import load_map, load_rays, load_trajectory
from objslam.triangulation.proximity_field import ProximityField, main_heading, proximity_field, supporting_rays

if TYPE_CHECKING:
    from objslam.io.rays_parquet import RaysTable

_MAX_RAYS = 160  # The largest number of rays of a kind that are drawn, evenly chosen.
_FROM = np.array([0.62, -0.62, 0.55])  # The direction of the view, in the slices' own axes: ahead, aside, up.
_DISTANCE = 4.2  # The distance of the view point, in half edges of a slice.
_TEXT, _ESTIMATE, _MINIMUM = (255, 255, 255), (40, 44, 52), (90, 255, 120)  # RGB: white, nearly black, green.
_HIDDEN = ("map/objects/labels", "map/objects/extent", "map/rays", "map/reconstruction")
"""Entities of the run's own recording that would cover the field and are shown at a click."""


def write_field(out: Path, number: int, file: Path) -> ProximityField:
    """Write a recording that shows the field of one object in the map.

    It is the run's own recording with the field added, or, where the run wrote none, the map and the field alone.

    Args:
        out: the result folder.
        number: the object's id.
        file: the recording to write.
    Raises:
        ConfigError: there is no such object.
        OutputError: the object has fewer than 2 rays, or the result cannot be read.
    """
    objects, rays = load_map(out), load_rays(out)
    o = next((o for o in objects.objects if o.id == number), None)
    if o is None:
        ids = ", ".join(str(o.id) for o in objects.objects) or "none"
        raise ConfigError(f"there is no object {number}", where=str(out), hint=f"objects: {ids}")
    mine = rays.object == number
    pull = supporting_rays(rays.weight, mine)
    if pull.sum() < 2:
        raise OutputError(f"object {number} has {pull.sum()} rays: Eq. 1 has no single minimum", where=str(out))
    f = proximity_field(rays.origin[pull], rays.direction[pull])
    view_point = _view_point(f, rays.direction[pull])
    name = captions(objects)[objects.objects.index(o)]

    recording = rr.RecordingStream("objslam")
    memory = recording.memory_recording()
    recording.send_recording_name(f"proximity field of {name}")
    recording.send_blueprint(_blueprint(view_point))
    if (out / RECORDING).is_file():
        _send_recording(recording, out / RECORDING)
    else:
        recording.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        path = load_trajectory(out).poses[:, :3, 3]
        log_objects(recording, objects, first_view_point(objects, path), path)
    _log_field(recording, f)
    _log_rays(recording, rays, pull, mine & ~pull, f)
    _log_marks(recording, f, o, name, view_point)
    recording.log("field", rr.TextDocument(_text(f, objects, o, name, rays, pull), media_type="text/markdown"), static=True)
    file.write_bytes(memory.drain_as_bytes())
    return f


def heat(cost: Floats, low: float, high: float) -> NDArray[np.uint8]:
    """RGB colours (..., 3) of costs (...), m: bright at the lowest cost, dark at the highest."""
    from matplotlib import colormaps

    # the cost rises like a cone: the square root gives more colours to the part around the minimum
    share = np.sqrt(np.clip((cost - low) / max(high - low, 1e-12), 0.0, 1.0))
    return (255 * colormaps["inferno"](0.97 * (1 - share))[..., :3]).round().astype(np.uint8)


def _send_recording(recording: Any, file: Path) -> None:
    try:
        recording.send_chunks(RrdReader(file).stream())
    except (ValueError, RuntimeError, OSError) as error:
        raise OutputError(f"damaged: {str(error).splitlines()[0]}", where=str(file), hint="run again") from error


def _log_field(recording: Any, f: ProximityField) -> None:
    """`map/field/horizontal` and `map/field/vertical`: the slices as points in the colours of their costs."""
    high = float(max(f.horizontal.cost.max(), f.vertical.cost.max()))
    for name, s in (("horizontal", f.horizontal), ("vertical", f.vertical)):
        spacing = float(np.linalg.norm(s.points[0, 1] - s.points[0, 0]))
        points = rr.Points3D(s.points.reshape(-1, 3), colors=heat(s.cost, f.cost, high).reshape(-1, 3), radii=0.6 * spacing)
        recording.log(f"map/field/{name}", points, static=True)


def _log_rays(recording: Any, rays: RaysTable, pull: Bools, rejected: Bools, f: ProximityField) -> None:
    """`map/field/rays`, blue, pull on the object; `map/field/rejected`, red, do not. Both reach through the slices."""
    reach = float(np.linalg.norm(f.horizontal.points[0, 0] - f.minimum))
    drawn: tuple[tuple[str, Bools, RayKind], ...] = (("rays", pull, "used"), ("rejected", rejected, "rejected"))
    for name, mask, kind in drawn:
        some = np.flatnonzero(mask)
        some = some[evenly(len(some), _MAX_RAYS)]
        if len(some):
            m, n = rays.origin[some], rays.direction[some]
            far = np.einsum("ri,ri->r", f.minimum - m, n) + reach
            strips = np.stack([m, m + np.maximum(far, 0.0)[:, None] * n], axis=1)
            lines = rr.LineStrips3D(strips, colors=[RAY_COLOURS[kind]], radii=rr.Radius.ui_points(0.6))
            recording.log(f"map/field/{name}", lines, static=True)


def _log_marks(recording: Any, f: ProximityField, o: MapObject, name: str, view_point: ViewPoint) -> None:
    """`map/field/minimum`, and `map/field/estimate`, the run's position of the object; each has its name on a pole."""
    size = float(np.ptp(f.vertical.points[..., 2]))
    nearer = -0.03 * size * view_point.axes[2]  # in front of the slice that both lie in
    for path, place, label, colour, lift in (
        ("minimum", f.minimum, f"minimum of Eq. 1, {_metres(f.cost)} in the mean", _MINIMUM, 0.26),
        ("estimate", o.position, name, _ESTIMATE, 0.42),
    ):
        if not np.isfinite(place).all():
            continue
        recording.log(f"map/field/{path}", rr.Points3D([place], colors=[colour], radii=0.045 * size), static=True)
        top = place + nearer + [0.0, 0.0, lift * size]
        text = rr.Points3D([top], colors=[_TEXT], radii=0.0, labels=[label], show_labels=True)
        recording.log(f"map/field/{path}/label", text, static=True)
        pole = rr.LineStrips3D([[place + nearer, top]], colors=[colour], radii=rr.Radius.ui_points(1))
        recording.log(f"map/field/{path}/pole", pole, static=True)


def _view_point(f: ProximityField, directions: Floats) -> ViewPoint:
    ahead = main_heading(directions)
    aside = np.array([-ahead[1], ahead[0], 0.0])
    back = _FROM @ np.stack([ahead, aside, [0.0, 0.0, 1.0]])
    reach = float(np.ptp(f.vertical.points[..., 2])) / 2
    return look_at(f.minimum, back, _DISTANCE * reach)


def _blueprint(view_point: ViewPoint) -> Any:
    from objslam.output.viewer.blueprint import map_view

    text = rrb.TextDocumentView(origin="field", name="what pulls on it")
    return rrb.Blueprint(
        rrb.Horizontal(map_view(view_point, "proximity field", hidden=_HIDDEN), text, column_shares=[3, 1]),
        rrb.TimePanel(state="collapsed"),
        collapse_panels=True,
    )


def _text(f: ProximityField, objects: ObjectMap, o: MapObject, name: str, rays: RaysTable, pull: Bools) -> str:
    gap = float(np.linalg.norm(f.minimum - o.position))
    off = np.linalg.norm(np.cross(f.minimum - rays.origin[pull], rays.direction[pull]), axis=1)
    x, y, z = f.minimum
    return "\n".join(
        [
            f"**{name}**, {o.status}, in a map of {len(objects)} objects",
            "",
            "| | |",
            "|---|---:|",
            f"| rays that pull (blue) | {pull.sum()} |",
            f"| rejected (red) | {(rays.object == o.id).sum() - pull.sum()} |",
            f"| parallax | {o.parallax_deg:.1f} deg |",
            f"| minimum of Eq. 1 | {x:.3f}, {y:.3f}, {z:.3f} m |",
            f"| its rays' distance, mean | {_metres(f.cost)} |",
            f"| median, worst | {_metres(float(np.median(off)))}, {_metres(float(off.max()))} |",
            f"| from the run's estimate | {_metres(gap)} |",
            "",
            "The colours are the mean distance of its rays to each point, Eq. 1's cost over their number: bright is close. "
            "A valley along the view means that the rays say little about the distance.",
        ]
    )


def _metres(value: float) -> str:
    return f"{value:.2f} m" if value >= 1 else f"{100 * value:.1f} cm"
