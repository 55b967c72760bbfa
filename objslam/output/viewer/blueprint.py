"""How the viewer lays a recording out when it is first opened."""

from __future__ import annotations

from typing import Any

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TextLogColumnKind, TimelineColumn

from objslam.output.viewer.times import ITERATION, STAMP
from objslam.output.viewer.view_point import ViewPoint

_ITERATIONS = 4.0  # The solver's iterations that playing shows in a second.
_HIDDEN = ("map/rays/rejected", "map/rays/unexplained", "map/reconstruction/before")
"""Entities that are shown at a click: lines are opaque, and many would cover the map."""


def blueprint(view_point: ViewPoint, cameras: list[tuple[str, str]], *, solver: bool = True, live: bool = False) -> Any:
    """The layout: the map on the left, cameras and curves on the right, the decisions below.

    Args:
        cameras: the entity path and the name of each camera.
        solver: whether there are iterations to step through.
        live: whether the curves are those of a session at work.
    """
    right = [_cameras(cameras)] if cameras else []
    right.append(_live_curves() if live else _curves(solver))
    column = rrb.Vertical(*right, row_shares=[3, 2][-len(right) :])
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(map_view(view_point), column, column_shares=[3, 2]),
            rrb.TextLogView(origin="log", name="what was decided", columns=_columns()),
            row_shares=[7, 2],
        ),
        rrb.TimePanel(timeline=STAMP, state="collapsed", fps=_ITERATIONS, play_state="following" if live else "playing"),
        collapse_panels=True,
    )


def map_view(view_point: ViewPoint, name: str = "map", hidden: tuple[str, ...] = _HIDDEN) -> Any:
    """The 3D view of the map; hidden: the entities that are not shown at first."""
    controls = rrb.EyeControls3D(position=view_point.position, look_target=view_point.target, eye_up=[0, 0, 1])
    return rrb.Spatial3DView(
        origin="map",
        name=name,
        background=[250, 250, 250],
        eye_controls=controls,
        overrides={path: rrb.EntityBehavior(visible=False) for path in hidden},
    )


def _cameras(cameras: list[tuple[str, str]]) -> Any:
    views = [rrb.Spatial2DView(origin=path, name=name, background=[40, 44, 52]) for path, name in cameras]
    return rrb.Tabs(*views) if len(views) > 1 else views[0]


def _curves(solver: bool) -> Any:
    # each view shows two curves, of which the chosen timeline has one: of the drive, or of the solver
    pairs = {"residual": ("residual, deg", "cost"), "boxes": ("boxes", "rounds")}
    views = [
        _curve([f"plots/{drive}", *([f"plots/{step}"] if solver else [])], f"{name}; {step}" if solver else name)
        for drive, (name, step) in pairs.items()
    ]
    seconds = rrb.BarChartView(origin="plots/seconds", name="seconds")
    return rrb.Tabs(*views, seconds, rrb.TextDocumentView(origin="summary", name="summary"), active_tab=0)


def _live_curves() -> Any:
    names = {"lag": "lag, ms", "objects": "objects", "dropped": "dropped"}
    views = [_curve([f"plots/live/{path}"], name) for path, name in names.items()]
    return rrb.Tabs(*views, rrb.TextDocumentView(origin="summary", name="counters"), active_tab=0)


def _curve(paths: list[str], name: str) -> Any:
    whole = rr.TimeRange(rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.infinite())
    return rrb.TimeSeriesView(contents=[f"{path}/**" for path in paths], name=name, axis_x=rrb.TimeAxis(view_range=whole))


def _columns() -> Any:
    """The columns of the log: level and text, because the text begins with the time and all lines have one entity path."""
    kinds = {"LogLevel": True, "Body": True, "EntityPath": False}
    return rrb.TextLogColumns(
        timeline_columns=[TimelineColumn(name, visible=False) for name in (STAMP, ITERATION)],
        text_log_columns=[TextLogColumn(TextLogColumnKind[kind], visible=shown) for kind, shown in kinds.items()],
    )
