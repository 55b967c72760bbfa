"""The commands `objslam register`, `merge` and `diff`, which take the maps of several sessions."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from objslam.cli.console import console, put, say, warn_of_neighbours
from objslam.cli.options import Json, Out

if TYPE_CHECKING:
    from rich.table import Table

    from objslam.mapping.sites.compare import Comparison

NOT_REGISTERED = 1
"""The exit code if the objects of two maps do not prove that both show one place."""


def register_results(
    a: Annotated[Path, typer.Argument(metavar="A", help="A result folder, or an objects.json.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="The other map.")],
) -> None:
    """Find the transform from map A to map B by the relative positions of their objects.

    The exit code is 1 if the transform is uncertain.
    """
    import numpy as np

    from objslam.association.registration.object_maps import reason, register
    from objslam.frontend.up import on_its_side
    from objslam.io.results.object_map import ObjectMap
    from objslam.io.results.read import load_up

    one, other = ObjectMap.load(a), ObjectMap.load(b)
    found = register(one, other)
    if np.isfinite(found.b_T_a).all():
        x, y, z = found.b_T_a[:3, 3]
        yaw = np.degrees(np.arctan2(found.b_T_a[1, 0], found.b_T_a[0, 0]))
        sigma = np.sqrt(np.diag(found.covariance)) * [1, 1, 1, np.degrees(1)]
        say(f"B_T_A: x {x:z.3f} y {y:z.3f} z {z:z.3f} m, yaw {yaw:z.2f} deg")
        say("sigma: x {:.3f} y {:.3f} z {:.3f} m, yaw {:.2f} deg".format(*sigma))
    for i, k in found.matches.tolist():
        say(f"  {one[i].label} #{one[i].id} is #{other[k].id}")
    why = reason(found, one, other, (str(a), str(b)))
    if not found.accepted:
        why = on_its_side({str(a): load_up(a), str(b): load_up(b)}) or why
    say(f"registered: {why}" if found.accepted else f"not registered: {why}")
    if not found.accepted:
        raise typer.Exit(NOT_REGISTERED)


def merge_results(
    results: Annotated[
        list[Path], typer.Argument(metavar="RESULT...", help="Result folders, sites, or objects.json files.")
    ],
    out: Out = Path("site"),
) -> None:
    """Join the maps of several sessions to one map of the site, with the life of each object.

    Give the sessions in the order of time. The map has the frame of the first
    session. Each session is registered to the map of the sessions placed so far,
    so the time grows with the number of sessions. Sessions that share no objects
    stay apart, each group in a folder of its own. To add a session later, give
    the site and the new result.
    """
    from objslam.api.sites import load_session, warnings_of
    from objslam.core.object_map import FATES
    from objslam.mapping.sites.merge import merge_sessions
    from objslam.output.result_folder import prepare_output, refuse_session
    from objslam.output.site_folder import islands_of_earlier_merges, summarise_site, write_site

    refuse_session(out)
    prepare_output(out)
    warn_of_neighbours(out)
    sessions = [load_session(path) for path in results]
    islands = merge_sessions(sessions)
    names = [session.name for session in sessions]
    warnings = warnings_of(sessions, islands)
    folders = write_site(islands, names, out, warnings)
    warnings += [f"{old} remains from an earlier merge" for old in islands_of_earlier_merges(out, len(islands))]
    for line in warnings:
        say(f"warning: {line}", stderr=True)
    for folder, island in zip(folders, islands, strict=True):
        for told in summarise_site(island, names)["sessions"]:
            say(f"{told['name']}: " + _session_line(told))
        objects = island.objects
        lives = [o.life.state for o in objects if o.life is not None]
        count = f"{len(island.sessions)} session{'' if len(island.sessions) == 1 else 's'}"
        fates = ", ".join(f"{lives.count(fate)} {fate}" for fate in FATES if fate != "gone")
        number = f"{len(objects)} object{'' if len(objects) == 1 else 's'}"
        say(f"{number} ({len(objects.gone)} gone) from {count}: {fates}")
        say(f"wrote {folder}")


def _session_line(told: dict[str, Any]) -> str:
    at = "x {x:z.3f} y {y:z.3f} z {z:z.3f} m, yaw {yaw_deg:z.2f} deg, {common_objects} objects in common".format(**told)
    odds = told["log_odds"]
    return f"{at}, log odds {odds:.1f}" if math.isfinite(odds) else at


def diff_results(
    a: Annotated[Path, typer.Argument(metavar="MAP_A", help="The earlier map: result folder, site, or objects.json.")],
    b: Annotated[
        Path, typer.Argument(metavar="MAP_B", help="The later map: the folder of a run, which says what was in view.")
    ],
    picture: Annotated[Path | None, typer.Option("-o", "--out", help="Draw the changes into this PNG file.")] = None,
    json: Json = False,
) -> None:
    """Compare two maps of one place: which objects are confirmed, moved, gone, new or unconfirmed.

    An object is unconfirmed if only one map has it, and the other drive did not
    have its place in view. The ids are from map A and map B.

    The result of a live session does not say what was in view. If it is map B, no
    object counts as gone or moved. In this case, map the journal of the session
    (objslam run LIVE_RESULT -o AGAIN), and compare the new result.

    The exit code is 1 if the maps cannot be registered to each other.
    """
    from objslam.api.sites import diff
    from objslam.core.object_map import FATES
    from objslam.io.atomic_files import write_file

    found = diff(a, b)
    if picture is not None and found.registration.accepted:
        from objslam.output.plot.changes_plot import draw_comparison

        write_file(picture, draw_comparison(found))
    warnings = _not_in_view(found, a, b)
    for line in warnings:
        say(f"warning: {line}", stderr=True)
    if json:
        _say_json(found, warnings)
    elif not found.registration.accepted:
        say(f"not registered: {found.reason}")
    else:
        console().print(_changes_table(found))
        say(", ".join(f"{len(found.of(outcome))} {outcome}" for outcome in FATES))
        if found.of("unconfirmed"):
            say(
                "unconfirmed: only one map has it, and the other drive did not have its place in view, or left its label out"
            )
        if picture is not None:
            say(f"wrote {picture}")
    if not found.registration.accepted:
        raise typer.Exit(NOT_REGISTERED)


def _not_in_view(found: Comparison, a: Path, b: Path) -> list[str]:
    """Return a warning for each map that does not say what was in view. A warning says what the comparison cannot show."""
    from objslam.io.results.files import VIEWS
    from objslam.sources.journal.record_format import NAME

    if not found.registration.accepted:
        return []
    warnings = []
    if not found.has_views[1]:
        so = f"{b} does not say what was in view (it has no {VIEWS}), so nothing can be called gone or moved"
        if (b / NAME).is_file():
            again = b.with_name(f"{b.resolve().name}_again")
            so += f". It is the result of a live session: objslam run {b} -o {again}, then objslam diff {a} {again}"
        warnings.append(so)
    if not found.has_views[0]:
        warnings.append(f"{a} does not say what was in view (it has no {VIEWS}), so objects that only {b} has count as new")
    return warnings


def _changes_table(found: Comparison) -> Table:
    from rich.table import Table

    table = Table(title="changes, in the frame of map A", caption="A, B: the id in each map. prob.: of the outcome")
    for name in ("outcome", "label", "A", "B", "x m", "y m", "z m", "prob.", "was at m"):
        words = name in ("outcome", "label")
        wraps = name in ("label", "was at m")
        table.add_column(name, justify="left" if words else "right", overflow="fold", no_wrap=not wraps)
    for one in found.changes:
        was = None if one.outcome != "moved" or one.item.life is None else one.item.life.moved_from
        ids = ("-" if number is None else str(number) for number in (one.id_a, one.id_b))
        before = "" if was is None else ", ".join(f"{x:.3f}" for x in was)
        place = (f"{x:.3f}" for x in one.item.position)
        table.add_row(one.outcome, one.item.label, *ids, *place, f"{one.probability:.2f}", before)
    return table


def _say_json(found: Comparison, warnings: list[str]) -> None:
    from objslam.io.results.files import dump_json

    changes = [
        {
            "outcome": one.outcome,
            "id_a": one.id_a,
            "id_b": one.id_b,
            "label": one.item.label,
            "position": one.item.position,
            "moved_from": None if one.item.life is None else one.item.life.moved_from,
            "probability": one.probability,
        }
        for one in found.changes
    ]
    said = {"registered": found.registration.accepted, "reason": found.reason, "warnings": warnings}
    put(dump_json({**said, "a_T_b": found.a_T_b, "changes": changes}))
