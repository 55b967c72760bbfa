"""How a recording is laid out at first opening."""

from __future__ import annotations

from typing import Any

from objslam.viewer.eye import Eye
from objslam.viewer.times import ITERATION, STAMP

_ITERATIONS = 4.0  # a second, played back
HIDDEN = ("map/rays/rejected", "map/rays/unexplained", "map/reconstruction/before")
"""A click away: lines are opaque, and many would cover the map."""


def blueprint(eye: Eye, cameras: list[tuple[str, str]], *, solver: bool = True, live: bool = False) -> Any:
    """The map on the left; the cameras (entity, name) and curves on the right; what was decided below.

    solver: whether there are iterations to step through. live: the curves are those of a session at work.
    """
    import rerun.blueprint as rrb

    right = [_cameras(cameras)] if cameras else []
    right.append(_live_curves() if live else _curves(solver))
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(map_view(eye), rrb.Vertical(*right, row_shares=[3, 2][-len(right) :]), column_shares=[3, 2]),
            rrb.TextLogView(origin="log", name="what was decided", columns=_columns()),
            row_shares=[7, 2],
        ),
        rrb.TimePanel(timeline=STAMP, state="collapsed", fps=_ITERATIONS, play_state="following" if live else "playing"),
        collapse_panels=True,
    )


def map_view(eye: Eye, name: str = "map", hidden: tuple[str, ...] = HIDDEN) -> Any:
    """The 3D view of the map from this eye; hidden: entities not shown at first."""
    import rerun.blueprint as rrb

    controls = rrb.EyeControls3D(position=eye.position, look_target=eye.target, eye_up=[0, 0, 1])
    return rrb.Spatial3DView(
        origin="map",
        name=name,
        background=[250, 250, 250],
        eye_controls=controls,
        overrides={path: rrb.EntityBehavior(visible=False) for path in hidden},
    )


def _cameras(cameras: list[tuple[str, str]]) -> Any:
    import rerun.blueprint as rrb

    views = [rrb.Spatial2DView(origin=path, name=name, background=[40, 44, 52]) for path, name in cameras]
    return rrb.Tabs(*views) if len(views) > 1 else views[0]


def _curves(solver: bool) -> Any:
    import rerun.blueprint as rrb

    # a view shows what the timeline at hand has: residuals and boxes of the drive, cost and objects of the solver
    pairs = {"residual": ("residual, deg", "cost"), "boxes": ("boxes", "rounds")}
    views = [
        _curve([f"plots/{drive}", *([f"plots/{step}"] if solver else [])], f"{name}; {step}" if solver else name)
        for drive, (name, step) in pairs.items()
    ]
    seconds = rrb.BarChartView(origin="plots/seconds", name="seconds")
    return rrb.Tabs(*views, seconds, rrb.TextDocumentView(origin="summary", name="summary"), active_tab=0)


def _live_curves() -> Any:
    import rerun.blueprint as rrb

    names = {"lag": "lag, ms", "objects": "objects", "dropped": "dropped"}
    views = [_curve([f"plots/live/{path}"], name) for path, name in names.items()]
    return rrb.Tabs(*views, rrb.TextDocumentView(origin="summary", name="counters"), active_tab=0)


def _curve(paths: list[str], name: str) -> Any:
    import rerun as rr
    import rerun.blueprint as rrb

    whole = rr.TimeRange(rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.infinite())
    return rrb.TimeSeriesView(contents=[f"{path}/**" for path in paths], name=name, axis_x=rrb.TimeAxis(view_range=whole))


def _columns() -> Any:
    """Level and text alone: the text begins with the time, and every line has the same path."""
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import TextLogColumn, TextLogColumnKind, TimelineColumn

    kinds = {"LogLevel": True, "Body": True, "EntityPath": False}
    return rrb.TextLogColumns(
        timeline_columns=[TimelineColumn(name, visible=False) for name in (STAMP, ITERATION)],
        text_log_columns=[TextLogColumn(TextLogColumnKind[kind], visible=shown) for kind, shown in kinds.items()],
    )
