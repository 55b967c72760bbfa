"""The layout of a recording when the viewer first opens it."""

from typing import Any

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TextLogColumnKind, TimelineColumn

from objslam.output.viewer.times import ITERATION, STAMP
from objslam.output.viewer.view_point import ViewPoint

_ITERATIONS = 4.0  # The number of iterations of the solver that playback shows per second.
_HIDDEN = ("map/rays/rejected", "map/rays/unexplained", "map/reconstruction/before", "map/doubts")
"""The entities that are invisible until the user clicks on them. If they were visible, they would cover the map."""


def blueprint(
    view_point: ViewPoint,
    cameras: list[tuple[str, str]],
    *,
    solver: bool = True,
    calibrated: bool = False,
    live: bool = False,
) -> Any:
    """Make the layout: the map on the left, cameras and curves on the right, the event log below.

    Args:
        cameras: the entity path and the name of each camera.
        solver: whether the recording has iterations of the solver.
        calibrated: whether the recording has shared errors by iteration.
        live: whether to show the curves of a running session instead of the curves of a finished run.
    """
    views = [rrb.Spatial2DView(origin=path, name=name, background=[40, 44, 52]) for path, name in cameras]
    right = [rrb.Tabs(*views) if len(views) > 1 else views[0]] if views else []
    right.append(_live_curves() if live else _curves(solver, calibrated))
    column = rrb.Vertical(*right, row_shares=[3, 2][-len(right) :])
    # The log shows no entity path, because all lines share it, and no times, because each text begins with its time.
    shown = {"LogLevel": True, "Body": True, "EntityPath": False}
    columns = rrb.TextLogColumns(
        timeline_columns=[TimelineColumn(name, visible=False) for name in (STAMP, ITERATION)],
        text_log_columns=[TextLogColumn(TextLogColumnKind[kind], visible=visible) for kind, visible in shown.items()],
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(map_view(view_point), column, column_shares=[3, 2]),
            rrb.TextLogView(origin="log", name="events", columns=columns),
            row_shares=[7, 2],
        ),
        rrb.TimePanel(timeline=STAMP, state="collapsed", fps=_ITERATIONS, play_state="following" if live else "playing"),
        collapse_panels=True,
    )


def map_view(view_point: ViewPoint, name: str = "map", hidden: tuple[str, ...] = _HIDDEN) -> Any:
    """Make the 3D view of the map. hidden: the entities that are invisible at first."""
    controls = rrb.EyeControls3D(position=view_point.position, look_target=view_point.target, eye_up=view_point.up)
    return rrb.Spatial3DView(
        origin="map",
        name=name,
        background=[250, 250, 250],
        eye_controls=controls,
        overrides={path: rrb.EntityBehavior(visible=False) for path in hidden},
    )


def _curves(solver: bool, calibrated: bool) -> Any:
    # Each view has a curve of the drive and a curve of the solver. The viewer shows the curve of the chosen timeline.
    pairs = {"residual": ("residual, deg", "cost"), "boxes": ("boxes", "rounds")}
    views = [
        _curve([f"plots/{drive}", *([f"plots/{step}"] if solver else [])], f"{name}; {step}" if solver else name)
        for drive, (name, step) in pairs.items()
    ]
    if calibrated and solver:
        views.append(_curve(["plots/calibration"], "shared errors"))
        views.append(_curve(["plots/calibration_sigma"], "their sigmas"))
    seconds = rrb.BarChartView(origin="plots/seconds", name="seconds")
    return rrb.Tabs(*views, seconds, rrb.TextDocumentView(origin="summary", name="summary"), active_tab=0)


def _live_curves() -> Any:
    names = {"lag": "lag, ms", "objects": "objects", "dropped": "dropped"}
    views = [_curve([f"plots/live/{path}"], name) for path, name in names.items()]
    return rrb.Tabs(*views, rrb.TextDocumentView(origin="summary", name="counters"), active_tab=0)


def _curve(paths: list[str], name: str) -> Any:
    whole = rr.TimeRange(rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.infinite())
    return rrb.TimeSeriesView(contents=[f"{path}/**" for path in paths], name=name, axis_x=rrb.TimeAxis(view_range=whole))
