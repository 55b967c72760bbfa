"""The command `objslam info`, which describes a recording and what is missing in it for a run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from objslam.cli.console import progress_bar, put, report, say, width
from objslam.cli.options import Json, with_options
from objslam.sources import Source, SourceOptions, choose, read

if TYPE_CHECKING:
    from objslam.core.arrays import Floats
    from objslam.core.camera import Camera
    from objslam.sources.ros_bag.info import BagInfo
    from objslam.sources.summary import Contents, Timing

_NUMERIC = ("messages", "Hz", "gap s", "from s", "to s")  # The right-aligned columns of numbers.
_OTHER_CLOCK = 86400.0
"""The largest time from the start of a recording to the first header stamp of a topic on the same clock, s. The stamps of a
simulation are decades off. A wrong clock of a robot is mostly minutes off. With a larger value, more clocks count as the
same."""
_SPARE = ("from s", "to s", "frame", "what", "gap s", "type")
"""The columns that are left out on a narrow terminal, in this order. `--json` has them all."""


@with_options
def info(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="A ROS bag, a log folder, or another recording.")],
    *,
    options: SourceOptions,
    json: Json = False,
) -> None:
    """Describe a recording: its streams with rates, gaps and times, the role of each topic, and what a run lacks."""
    from objslam.core.diagnostics import Ledger
    from objslam.io.results.files import dump_json
    from objslam.mapping.checks.boxes import check_boxes
    from objslam.mapping.checks.stamps import check_stamps
    from objslam.sources.ros_bag.info import describe
    from objslam.sources.summary import contents

    kind = choose(source, options.format)
    if kind.name == "ros":
        with progress_bar():
            bag = describe(source, options)
            whole = options.begin is None and options.end is None
            part = None if whole else contents(read(source, Ledger(), options))
        put(dump_json(asdict(bag) | ({} if part is None else {"part": asdict(part)}))) if json else _show_bag(bag, part)
        return
    ledger = Ledger()
    with progress_bar():
        log = read(source, ledger, options)
    for finding in (check_stamps(log), *check_boxes(log, ledger)):
        if finding is not None:
            ledger.warn(finding.message)
    found = contents(log)
    put(dump_json({"kind": kind.name, **asdict(found), "warnings": ledger.lines()})) if json else _show_log(found, kind)
    report(ledger)


def _show_log(found: Contents, kind: Source) -> None:
    from objslam.sources.summary import in_words

    starts, ends = ([getattr(s.timing, end) for s in found.streams] for end in ("start", "end"))
    begin = min(starts, default=0.0)
    say(f"{found.name}: {kind.name}; {_span(begin, max(ends, default=0.0))}")
    for line in in_words(found):
        say(line)
    rows = [(s.role, str(s.timing.count), *_numbers(s.timing, begin), s.detail) for s in found.streams]
    _table(("role", *_NUMERIC, "what"), rows)
    _show_cameras(found.cameras)
    _list("missing for a run", found.missing, "nothing is missing for a run")


def _show_bag(bag: BagInfo, part: Contents | None) -> None:
    """Show all topics of the bag, so that the user can choose among them. Then show the streams of the part of the bag that
    the options choose."""
    from objslam.core.diagnostics import is_drop
    from objslam.sources.summary import in_words

    files = f"{len(bag.files)} file{'s' if len(bag.files) > 1 else ''}"
    lost = f" ({bag.lost} lost)" if bag.lost else ""
    say(f"{bag.name}: {bag.format}, {files}, {bag.messages} messages{lost}; {_span(bag.start, bag.end)}")
    parts = (("base frame", bag.base), ("odometry", bag.odometry), ("localisation", bag.localization))
    say("; ".join(f"{name} {value or 'none'}" for name, value in parts))
    topics = sorted(bag.topics, key=lambda topic: (not topic.role, topic.name))
    other = {t.name: t.timing.start for t in topics if t.timing.count and abs(t.timing.start - bag.start) > _OTHER_CLOCK}
    begins = {name: min(other.values()) for name in other}
    rows = [
        (
            *(t.name, t.role, t.type.replace("/msg/", "/"), str(t.messages)),
            *_numbers(t.timing, begins.get(t.name, bag.start)),
            *(t.frame, t.detail),
        )
        for t in topics
    ]
    _table(("topic", "role", "type", *_NUMERIC, "frame", "what"), rows)
    if other:
        clock = f"are on another clock than the recording (simulated time?), from {min(other.values()):.3f} s on"
        say(f"the stamps of {', '.join(other)} {clock}")
    _show_cameras(bag.cameras)
    for place in bag.places:
        where = "moves" if place.base_T_frame is None else _place(place.base_T_frame)
        say(f"{' -> '.join(place.chain)}: {where}")
    refused = [f"{topic.name}: {reason}" for topic in bag.topics for reason in topic.refused]
    _list("messages that cannot be used", refused)
    _list("damage", bag.damage)
    for line in in_words(part) if part else ():
        say(line)
    _list("warnings", [line for line in bag.warnings if not is_drop(line)])
    _list("missing for a run", bag.missing, "nothing is missing for a run")


def _show_cameras(cameras: Iterable[Camera]) -> None:
    from objslam.core.camera import spoken_name
    from objslam.sources.camera_words import doubts_of, view_of

    for camera in cameras:
        fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
        say(
            f"{spoken_name(camera.name)}: {camera.width}x{camera.height}, f {fx:.1f} {fy:.1f} px, "
            f"{camera.distortion_model}, at {_place(camera.base_T_camera)} in base: {view_of(camera)}"
        )
        if camera.distortion.any():
            advice = "if they are of rectified images: --rectified (ROS), or no distortion in camera.yaml"
            say(f"{spoken_name(camera.name)}: its boxes are taken as those of raw images, which are distorted; {advice}")
        for doubt in doubts_of(camera):
            say(f"warning: {doubt}", stderr=True)


def _place(pose: Floats) -> str:
    from objslam.core.geometry import quaternion

    x, y, z = pose[:3, 3]
    turn = ", ".join(f"{value + 0.0:.4f}" for value in quaternion(pose[None])[0])
    return f"({x:.4f}, {y:.4f}, {z:.4f}) m, xyzw ({turn})"


def _numbers(when: Timing, begin: float) -> tuple[str, ...]:
    rate, gap = f"{when.rate:.1f}" if when.rate else "", f"{when.longest_gap:.2f}" if when.count > 1 else ""
    start, end = (f"{round(stamp - begin, 2) + 0.0:.2f}" for stamp in (when.start, when.end))  # + 0.0 makes -0.0 positive.
    return rate, gap, start, end


def _span(start: float, end: float) -> str:
    from objslam.core.validity import is_date

    first = datetime.fromtimestamp(start, UTC).strftime("%Y-%m-%d %H:%M:%S UTC") if is_date(start) else f"{start:.3f} s"
    return f"{end - start:.1f} s from {first}"


def _table(names: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows of text in aligned columns. If lines are too narrow, columns of `_SPARE` are left out. No text is cut."""
    most = width()
    for spare in (None, *_SPARE):
        if spare in names:
            at = names.index(spare)
            names, *rows = ([*row[:at], *row[at + 1 :]] for row in (names, *rows))
        widths = [max(len(row[i]) for row in (names, *rows)) for i in range(len(names))]
        if most is None or sum(widths) + 2 * (len(widths) - 1) <= most:
            break
    for row in (names, *rows):
        cells = (c.rjust(w) if name in _NUMERIC else c.ljust(w) for c, w, name in zip(row, widths, names, strict=True))
        put("  ".join(cells).rstrip() + "\n")


def _list(title: str, lines: Sequence[str], otherwise: str = "") -> None:
    if lines:
        say(f"{title}:")
        for line in lines:
            say(f"  {line}")
    elif otherwise:
        say(otherwise)
