"""The proximity field of one object in the map: Eq. 1's cost on two slices, its minimum, and the rays that pull on it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from objslam.errors import ConfigError, OutputError
from objslam.proximity import Field, field, level, pulling
from objslam.results import RECORDING, load_map, load_rays, load_trajectory
from objslam.scene import RayKind, captions
from objslam.types import Bools, Floats, MapObject, ObjectMap
from objslam.viewer.eye import Eye, first_eye, look_at
from objslam.viewer.objects import log_objects
from objslam.viewer.rays import RAY_COLOURS

if TYPE_CHECKING:
    from objslam.rays_file import RaysTable

_MOST = 160  # rays drawn
_STEEP = np.array([0.62, -0.62, 0.55])  # where the eye stands, in the slices' own axes: ahead, aside, up
_AWAY = 4.2  # times the slices' half edge
_TEXT, _ESTIMATE = (255, 255, 255), (40, 44, 52)
_HIDDEN = ("map/objects/labels", "map/objects/extent", "map/rays", "map/reconstruction")


def write_field(out: Path, number: int, file: Path) -> Field:
    """Write a recording of the result in the folder `out` with the field of object `number` (its id) in it.

    It is the run's own recording where there is one, opened at the object; else the map and the field alone. ConfigError
    when there is no such object; OutputError when it has fewer than 2 rays, or the result cannot be read.
    """
    import rerun as rr

    objects, rays = load_map(out), load_rays(out)
    o = next((o for o in objects.objects if o.id == number), None)
    if o is None:
        ids = ", ".join(str(o.id) for o in objects.objects) or "none"
        raise ConfigError(f"there is no object {number}", where=str(out), hint=f"objects: {ids}")
    mine = rays.object == number
    pull = pulling(rays.weight, mine)
    if pull.sum() < 2:
        raise OutputError(f"object {number} has {pull.sum()} rays: Eq. 1 has no single minimum", where=str(out))
    f = field(rays.origin[pull], rays.direction[pull])
    eye = _eye(f, rays.direction[pull])
    name = captions(objects)[objects.objects.index(o)]

    recording = rr.RecordingStream("objslam")
    memory = recording.memory_recording()
    recording.send_recording_name(f"proximity field of {name}")
    recording.send_blueprint(_blueprint(eye))
    if (out / RECORDING).is_file():
        _send_recording(recording, out / RECORDING)
    else:
        recording.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        path = load_trajectory(out).poses[:, :3, 3]
        log_objects(recording, objects, first_eye(objects, path), path)
    _log_field(recording, f)
    _log_rays(recording, rays, pull, mine & ~pull, f)
    _log_marks(recording, f, o, name, eye)
    recording.log("field", rr.TextDocument(_text(f, objects, o, name, rays, pull), media_type="text/markdown"), static=True)
    file.write_bytes(memory.drain_as_bytes())
    return f


def heat(cost: Floats, low: float, high: float) -> NDArray[np.uint8]:
    """Colours (..., 3) of costs, m: bright where it is lowest, dark where it is highest."""
    from matplotlib import colormaps

    # the cost rises like a cone: its square root spreads the colours over the foot of it
    share = np.sqrt(np.clip((cost - low) / max(high - low, 1e-12), 0.0, 1.0))
    return (255 * colormaps["inferno"](0.97 * (1 - share))[..., :3]).round().astype(np.uint8)


def _send_recording(recording: Any, file: Path) -> None:
    from rerun.chunk import RrdReader

    try:
        recording.send_chunks(RrdReader(file).stream())
    except (ValueError, RuntimeError, OSError) as error:
        raise OutputError(f"damaged: {str(error).splitlines()[0]}", where=str(file), hint="run again") from error


def _log_field(recording: Any, f: Field) -> None:
    """`map/field/horizontal` and `map/field/vertical`: points in the colours of their cost."""
    import rerun as rr

    high = float(max(f.horizontal.cost.max(), f.vertical.cost.max()))
    for name, s in (("horizontal", f.horizontal), ("vertical", f.vertical)):
        spacing = float(np.linalg.norm(s.points[0, 1] - s.points[0, 0]))
        points = rr.Points3D(s.points.reshape(-1, 3), colors=heat(s.cost, f.cost, high).reshape(-1, 3), radii=0.6 * spacing)
        recording.log(f"map/field/{name}", points, static=True)


def _log_rays(recording: Any, rays: RaysTable, pull: Bools, rejected: Bools, f: Field) -> None:
    """`map/field/rays`, blue, those that pull on the object, through the slices; `map/field/rejected`, red, the others."""
    import rerun as rr

    reach = float(np.linalg.norm(f.horizontal.points[0, 0] - f.minimum))
    drawn: tuple[tuple[str, Bools, RayKind], ...] = (("rays", pull, "used"), ("rejected", rejected, "rejected"))
    for name, mask, kind in drawn:
        some = np.flatnonzero(mask)
        some = some[np.linspace(0, len(some) - 1, min(len(some), _MOST)).round().astype(np.int64)]
        if len(some):
            m, n = rays.origin[some], rays.direction[some]
            far = np.einsum("ri,ri->r", f.minimum - m, n) + reach
            strips = np.stack([m, m + np.maximum(far, 0.0)[:, None] * n], axis=1)
            lines = rr.LineStrips3D(strips, colors=[RAY_COLOURS[kind]], radii=rr.Radius.ui_points(0.6))
            recording.log(f"map/field/{name}", lines, static=True)


def _log_marks(recording: Any, f: Field, o: MapObject, name: str, eye: Eye) -> None:
    """`map/field/minimum`, and `map/field/estimate`, where the run put the object; each with its name on a pole."""
    import rerun as rr

    size = float(np.ptp(f.vertical.points[..., 2]))
    nearer = -0.03 * size * eye.axes[2]  # out of the slice that both stand in
    for path, place, label, colour, lift in (
        ("minimum", f.minimum, f"minimum of Eq. 1, {_metres(f.cost)} in the mean", (90, 255, 120), 0.26),
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


def _eye(f: Field, directions: Floats) -> Eye:
    ahead = level(directions)
    aside = np.array([-ahead[1], ahead[0], 0.0])
    back = _STEEP @ np.stack([ahead, aside, [0.0, 0.0, 1.0]])
    reach = float(np.ptp(f.vertical.points[..., 2])) / 2
    return look_at(f.minimum, back, _AWAY * reach)


def _blueprint(eye: Eye) -> Any:
    import rerun.blueprint as rrb

    from objslam.viewer.blueprint import map_view

    text = rrb.TextDocumentView(origin="field", name="what pulls on it")
    return rrb.Blueprint(
        rrb.Horizontal(map_view(eye, "proximity field", hidden=_HIDDEN), text, column_shares=[3, 1]),
        rrb.TimePanel(state="collapsed"),
        collapse_panels=True,
    )


def _text(f: Field, objects: ObjectMap, o: MapObject, name: str, rays: RaysTable, pull: Bools) -> str:
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
