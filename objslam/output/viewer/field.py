"""Make a recording of the proximity field of one object: the cost of Eq. 1 on two slices, its minimum, and the rays."""

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
from objslam.io.results.files import RECORDING
from objslam.io.results.read import load_map, load_rays, load_trajectory
from objslam.output.plot.style import RayKind, captions, evenly
from objslam.output.viewer.event_log import markdown, table
from objslam.output.viewer.objects import log_objects
from objslam.output.viewer.rays import RAY_COLOURS
from objslam.output.viewer.view_point import ViewPoint, first_view_point, look_at
from objslam.triangulation.proximity_field import ProximityField, main_heading, proximity_field, supporting_rays

if TYPE_CHECKING:
    from objslam.io.rays_parquet import RaysTable

_MAX_RAYS = 160  # The largest number of rays of each kind in the recording, evenly chosen.
_FROM = np.array([0.62, -0.62, 0.55])  # The direction of the view point from the minimum, in the axes ahead, left and up.
_DISTANCE = 4.2  # The distance of the view point, as a multiple of half the edge of a slice.
_TEXT, _ESTIMATE, _MINIMUM = (255, 255, 255), (40, 44, 52), (90, 255, 120)  # The RGB colours: white, nearly black, green.
_HIDDEN = ("map/objects/labels", "map/objects/extent", "map/rays", "map/reconstruction")
"""The entities of the run that are invisible until the user clicks on them. If visible, they would cover the field."""


def write_field(out: Path, number: int, file: Path) -> ProximityField:
    """Write a recording of the run with the proximity field of one object, and return the field.

    If the run wrote no recording, the new recording has only the map and the field.

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
        raise OutputError(f"object {number} has {pull.sum()} rays: Eq. 1 has no minimum below 2 rays", where=str(out))
    f = proximity_field(rays.origin[pull], rays.direction[pull])
    ahead = main_heading(rays.direction[pull])
    back = _FROM @ np.stack([ahead, [-ahead[1], ahead[0], 0.0], [0.0, 0.0, 1.0]])
    view_point = look_at(f.minimum, back, _DISTANCE * float(np.ptp(f.vertical.points[..., 2])) / 2)
    name = captions(objects)[objects.objects.index(o)]
    recording = rr.RecordingStream("objslam")
    memory = recording.memory_recording()
    recording.send_recording_name(f"proximity field of {name}")
    recording.send_blueprint(_blueprint(view_point))
    if (own := out / RECORDING).is_file():
        try:
            recording.send_chunks(RrdReader(own).stream())
        except (ValueError, RuntimeError, OSError) as error:
            why = str(error).splitlines()[0]
            raise OutputError(f"the recording is damaged: {why}", where=str(own), hint="run again") from error
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
    """Return RGB colours (..., 3) for costs (...), m: bright at the lowest cost `low`, dark at the highest cost `high`."""
    import cv2

    # The cost rises from the minimum like a cone, so the square root gives more colours to the part near the minimum.
    share = np.sqrt(np.clip((cost - low) / max(high - low, 1e-12), 0.0, 1.0))
    level = (255 * 0.97 * (1 - share)).round().astype(np.uint8)
    coloured = np.asarray(cv2.applyColorMap(level.reshape(-1, 1), cv2.COLORMAP_INFERNO), dtype=np.uint8)
    return coloured[:, 0, ::-1].reshape(*level.shape, 3)


def _log_field(recording: Any, f: ProximityField) -> None:
    """Log both slices, `map/field/horizontal` and `map/field/vertical`, as points. The colour of a point shows its cost."""
    high = float(max(f.horizontal.cost.max(), f.vertical.cost.max()))
    for name, s in (("horizontal", f.horizontal), ("vertical", f.vertical)):
        spacing = float(np.linalg.norm(s.points[0, 1] - s.points[0, 0]))
        points = rr.Points3D(s.points.reshape(-1, 3), colors=heat(s.cost, f.cost, high).reshape(-1, 3), radii=0.6 * spacing)
        recording.log(f"map/field/{name}", points, static=True)


def _log_rays(recording: Any, rays: RaysTable, pull: Bools, rejected: Bools, f: ProximityField) -> None:
    """Log the used rays, `map/field/rays`, in blue, and the rejected rays, `map/field/rejected`, in red."""
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
    """Log two points with labels: the minimum of Eq. 1 to `map/field/minimum`, and the run's estimate to
    `map/field/estimate`."""
    size = float(np.ptp(f.vertical.points[..., 2]))
    nearer = -0.03 * size * view_point.axes[2]  # The labels lie in front of the vertical slice.
    for path, place, label, colour, lift in (
        ("minimum", f.minimum, f"minimum of Eq. 1, mean distance {_metres(f.cost)}", _MINIMUM, 0.26),
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


def _blueprint(view_point: ViewPoint) -> Any:
    from objslam.output.viewer.blueprint import map_view

    text = rrb.TextDocumentView(origin="field", name="rays")
    return rrb.Blueprint(
        rrb.Horizontal(map_view(view_point, "proximity field", hidden=_HIDDEN), text, column_shares=[3, 1]),
        rrb.TimePanel(state="collapsed"),
        collapse_panels=True,
    )


def _text(f: ProximityField, objects: ObjectMap, o: MapObject, name: str, rays: RaysTable, pull: Bools) -> str:
    gap = float(np.linalg.norm(f.minimum - o.position))
    off = np.linalg.norm(np.cross(f.minimum - rays.origin[pull], rays.direction[pull]), axis=1)
    x, y, z = f.minimum
    rows = [
        ("used rays (blue)", str(pull.sum())),
        ("rejected rays (red)", str((rays.object == o.id).sum() - pull.sum())),
        ("parallax", f"{o.parallax_deg:.1f} deg"),
        ("minimum of Eq. 1", f"{x:.3f}, {y:.3f}, {z:.3f} m"),
        ("mean distance of its used rays", _metres(f.cost)),
        ("median distance, largest distance", f"{_metres(float(np.median(off)))}, {_metres(float(off.max()))}"),
        ("distance from the run's estimate", _metres(gap)),
    ]
    head = f"**{markdown(name)}**, {o.status}, in a map of {len(objects)} objects"
    colour = "The colour of a point shows its mean distance from the used rays (Eq. 1's cost / the number of rays)."
    valley = "Bright points are close. A valley along the rays means that the distance of the object is uncertain."
    return "\n".join([head, "", *table(rows), "", f"{colour} {valley}"])


def _metres(value: float) -> str:
    return f"{value:.2f} m" if value >= 1 else f"{100 * value:.1f} cm"
