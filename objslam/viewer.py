"""recording.rrd: a run to look at and to play back with the rerun viewer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from objslam.geometry import quaternion
from objslam.scene import captions, ellipsoid, frame_objects, label_colours, ray_ends, ray_kinds, sample
from objslam.types import Floats, Truth

if TYPE_CHECKING:
    from objslam.results import RunResult

TIMELINE = "stamp"
_UNIX_TIME = 1e8  # s; stamps beyond it are dates, those below count from a start of their own
_MAX_STATIC_RAYS = 400
_MAX_LABELS = 60  # the viewer keeps no distance between labels
_COLOURS = {"used": (86, 156, 230), "rejected": (224, 82, 70), "unexplained": (150, 150, 150)}
_FAINT = {"used": (198, 220, 245), "rejected": (246, 205, 200), "unexplained": (222, 222, 222)}
_BEFORE, _AFTER, _TRUTH, _TEXT = (140, 140, 140), (40, 44, 52), (0, 0, 0), (255, 255, 255)


def write_recording(result: RunResult, file: Path, truth: Truth | None = None) -> None:
    """Write a run as a rerun recording (.rrd) with its blueprint.

    Under `map` (z up, m): `path/before`, `path/after`, `path/truth`, `objects` (points and 2-sigma ellipsoids),
    `objects/unresolved`, `truth`, a sample of all rays in `rays/used`, `rays/rejected` and `rays/unexplained` (the last two
    not shown at first), and, on the timeline `stamp`, the robot in `base` and every ray of the moment in `rays/now`. Counts
    and warnings go to `log`.
    OSError when the file cannot be written.
    """
    import rerun as rr

    recording = rr.RecordingStream("objslam")
    # bytes in memory: a file sink writes in a thread of its own, and what the disk refuses there is a line on stderr
    memory = recording.memory_recording()
    recording.send_blueprint(_blueprint(result))
    recording.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_paths(recording, result, truth)
    _log_objects(recording, result, truth)
    if len(result.keyframes):
        _log_base(recording, result)
        _log_rays(recording, result)
        _log_text(recording, result)
    file.write_bytes(memory.drain_as_bytes())


def time_column(stamps: Floats) -> Any:
    """The timeline `stamp` for stamps (N,), s: dates where they are Unix time, durations otherwise."""
    import rerun as rr

    if len(stamps) and stamps[0] > _UNIX_TIME:
        return rr.TimeColumn(TIMELINE, timestamp=stamps)
    return rr.TimeColumn(TIMELINE, duration=stamps)


def _log_paths(recording: Any, result: RunResult, truth: Truth | None) -> None:
    import rerun as rr

    paths = {"before": (result.path.poses, _BEFORE, 1.0), "after": (result.path_after.poses, _AFTER, 2.0)}
    if truth is not None and truth.trajectory is not None:
        paths["truth"] = (truth.trajectory.poses, _TRUTH, 0.7)
    for name, (poses, colour, width) in paths.items():
        strip = rr.LineStrips3D([poses[:, :3, 3]], colors=[colour], radii=rr.Radius.ui_points(width))
        recording.log(f"map/path/{name}", strip, static=True)


def _log_objects(recording: Any, result: RunResult, truth: Truth | None) -> None:
    import rerun as rr

    objects, texts = result.map.objects, captions(result.map)
    colours = {label: tuple(round(255 * c) for c in rgb) for label, rgb in label_colours(result.map).items()}
    if truth is not None and truth.objects:
        positions = [o.position for o in truth.objects]
        labels = [o.label for o in truth.objects]
        points = rr.Points3D(positions, colors=[_TRUTH], radii=rr.Radius.ui_points(3), labels=labels, show_labels=False)
        recording.log("map/truth", points, static=True)
    resolved = [i for i, o in enumerate(objects) if o.status == "ok"]
    if resolved:
        points = rr.Points3D(
            [objects[i].position for i in resolved],
            colors=[colours[objects[i].label] for i in resolved],
            radii=rr.Radius.ui_points(5),
            labels=[texts[i] for i in resolved],
            show_labels=False,
        )
        recording.log("map/objects", points, static=True)
    shapes = [(i, shape) for i in resolved if (shape := ellipsoid(objects[i])) is not None]
    if shapes:
        bodies = rr.Ellipsoids3D(
            centers=[objects[i].position for i, _ in shapes],
            half_sizes=[half for _, (half, _) in shapes],
            quaternions=Rotation.from_matrix(np.stack([axes for _, (_, axes) in shapes])).as_quat(),
            colors=[colours[objects[i].label] for i, _ in shapes],
            line_radii=rr.Radius.ui_points(0.6),
        )
        recording.log("map/objects/uncertainty", bodies, static=True)
    unresolved = [i for i, o in enumerate(objects) if o.ray is not None and np.isfinite(o.position).all()]
    if unresolved:
        strips = rr.LineStrips3D(
            [np.stack([objects[i].ray[0], objects[i].position]) for i in unresolved],  # type: ignore[index]
            colors=[colours[objects[i].label] for i in unresolved],
            radii=rr.Radius.ui_points(1),
        )
        recording.log("map/objects/unresolved", strips, static=True)
    named = [i for i, o in enumerate(objects) if np.isfinite(o.position).all()]
    if named:
        # the viewer writes a label in its point's colour into a dark box: white is read on it, an object's colour is not
        names = rr.Points3D(
            [objects[i].position for i in named],
            colors=[_TEXT],
            radii=0.0,
            labels=[texts[i] if objects[i].status == "ok" else f"{texts[i]}, unresolved" for i in named],
            show_labels=len(named) <= _MAX_LABELS,
        )
        recording.log("map/objects/labels", names, static=True)


def _log_base(recording: Any, result: RunResult) -> None:
    """The robot's pose at each distinct stamp, as axes that move along the path."""
    import rerun as rr

    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    poses = result.map_T_base[first]
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], quaternion=quaternion(poses))
    recording.send_columns("map/base", [time_column(stamps)], columns)
    recording.log("map/base", rr.TransformAxes3D(0.4), static=True)


def _log_rays(recording: Any, result: RunResult) -> None:
    import rerun as rr

    strips = np.stack([result.origins, ray_ends(result)], axis=1).astype(np.float32)
    colours = np.zeros((len(strips), 3), dtype=np.uint8)
    for kind, mask in ray_kinds(result).items():
        colours[mask] = _COLOURS[kind]
        index = sample(mask, _MAX_STATIC_RAYS)
        if len(index):
            lines = rr.LineStrips3D(strips[index], colors=[_FAINT[kind]], radii=rr.Radius.ui_points(0.4))
            recording.log(f"map/rays/{kind}", lines, static=True)
    # one row a distinct stamp, also where it has no ray: the rays of the moment before must go
    stamps, moment = np.unique(result.keyframes.stamps, return_inverse=True)
    counts = np.bincount(moment[result.rays.keyframe], minlength=len(stamps))
    columns = rr.LineStrips3D.columns(strips=strips, colors=colours).partition(counts)
    recording.send_columns("map/rays/now", [time_column(stamps)], columns)
    recording.log("map/rays/now", rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(1.2)), static=True)


def _log_text(recording: Any, result: RunResult) -> None:
    import rerun as rr

    resolved = len(result.map.resolved())
    objects = f"{resolved} objects, {len(result.map) - resolved} unresolved"
    lines = [("INFO", f"{objects}, {len(result.rays)} rays, {len(result.keyframes)} keyframes")]
    lines += [("WARN", str(text)) for text in result.summary.get("warnings", [])]
    texts, levels = [text for _, text in lines], [level for level, _ in lines]
    at_start = np.full(len(lines), result.keyframes.stamps[0])
    recording.send_columns("log", [time_column(at_start)], rr.TextLog.columns(text=texts, level=levels))


def _blueprint(result: RunResult) -> Any:
    """The map seen from the south, half from above, with the text below it."""
    import rerun.blueprint as rrb

    positions = np.array([o.position for o in result.map.objects]).reshape(-1, 3)
    _, low, high = frame_objects(positions, result.map_T_base[:, :3, 3])
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low)) + 0.5
    eye = rrb.EyeControls3D(position=centre + size * np.array([-0.2, -0.68, 0.8]), look_target=centre, eye_up=[0, 0, 1])
    hidden = rrb.EntityBehavior(visible=False)  # a click away: lines are opaque, and many would cover the map
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Spatial3DView(
                origin="map",
                name="map",
                background=[250, 250, 250],
                eye_controls=eye,
                overrides={"map/rays/rejected": hidden, "map/rays/unexplained": hidden},
            ),
            rrb.TextLogView(origin="log", name="log"),
            row_shares=[5, 1],
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        collapse_panels=True,
    )
