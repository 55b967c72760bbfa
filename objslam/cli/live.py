"""objslam live: the map while the robot drives."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from objslam.cli.console import console, report, say
from objslam.cli.live_status import status_line, times
from objslam.cli.options import (
    Anonymous,
    BaseFrame,
    CameraInfo,
    Config,
    DetectorModel,
    Format,
    Label,
    Out,
    Rectified,
    Robot,
    Set,
    Topics,
    WithoutRange,
    settings_of,
    source_options,
)

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.ledger import Ledger
    from objslam.live.adapters import Feed
    from objslam.live.session import Session
    from objslam.sources import SourceOptions
    from objslam.types import Log, Truth

_POLL = 0.1  # s; how soon the end of a source is seen

Speed = Annotated[
    float, typer.Option("--speed", min=0.0, help="Replay so many times as fast as it was driven; 0: as fast as it can be.")
]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with the journal of a session that was killed.")]
Interval = Annotated[float, typer.Option("--interval", min=0.1, help="s between two writings of objects.json.")]
Domain = Annotated[int | None, typer.Option("--domain", help="DDS domain. [default: ROS_DOMAIN_ID, else 0]")]
Interface = Annotated[
    str | None,
    typer.Option(
        "--interface",
        help="DDS: auto, or a network interface's name or address. [default: as CYCLONEDDS_URI says, else loopback]",
    ),
]
Publish = Annotated[
    bool, typer.Option("--publish", help="Send objects, markers and the path over DDS, for RViz and Nav2, every --interval.")
]
View = Annotated[
    str | None,
    typer.Option("--view", help="Look at it: window, web (a browser on this machine), FILE.rrd, or a viewer's address."),
]
WithJournal = Annotated[bool, typer.Option("--journal/--no-journal", help="Keep what comes on the disk.")]


def live(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="dds (a ROS 2 robot), rclpy (the same, as a ROS node), stdin (JSON lines), or a recording: replayed.",
        ),
    ],
    out: Out = Path("out"),
    config: Config = None,
    set_: Set = None,
    speed: Speed = 1.0,
    resume: Resume = False,
    interval: Interval = 1.0,
    journal: WithJournal = True,
    format_: Format = None,
    robot: Robot = None,
    without_range: WithoutRange = False,
    anonymous: Anonymous = False,
    label: Label = None,
    topic: Topics = None,
    camera_info: CameraInfo = None,
    base_frame: BaseFrame = None,
    rectified: Rectified = None,
    detector: DetectorModel = None,
    domain: Domain = None,
    interface: Interface = None,
    publish: Publish = False,
    view: View = None,
) -> None:
    """Map objects while the robot drives: objects.json follows, and at the end (Ctrl-C) there is a whole result folder."""
    from objslam.errors import ConfigError, OutputError
    from objslam.live.adapters import ADAPTERS, LiveOptions
    from objslam.live.journal import NAME
    from objslam.live.session import Session
    from objslam.results import RECORDING, output_folder

    if view is not None and Path(view).resolve() == (out / RECORDING).resolve():
        raise OutputError("the recording of the result goes there", where=view, hint="name another file with --view")
    if resume and not journal:
        raise ConfigError("--resume goes on with the journal that --no-journal does without", hint="leave out one of them")
    settings = settings_of("joint", config, set_)
    options = source_options(format_, robot, without_range, anonymous, label, topic, camera_info, base_frame, rectified)
    _say_what_is_not_used(source, options, detector, domain, interface, speed, publish)
    recording = None if source in ADAPTERS else _read(Path(source), options)  # first, for it may be the journal in OUT
    with output_folder(out), ExitStack() as stack:
        if journal:
            _look_for_journal(out / NAME, resume, stack)
        patient = recording is not None and speed == 0
        session = Session(settings, out / NAME if journal else None, resume, name=Path(source).name, patient=patient)
        stack.callback(session.abort)
        truth = None
        if recording is None:
            feed = ADAPTERS[source](session, LiveOptions(settings, detector, options, domain, interface))
        else:
            feed, truth = _replay(recording, session, settings, speed or None)
        for close in feed.close:
            stack.callback(close)
        if publish:
            from objslam.live.dds_network import open_network
            from objslam.live.publish import DdsPublisher

            feed = replace(feed, views=(*feed.views, DdsPublisher(open_network(domain, interface)).publish))
        if view is not None:
            from objslam.viewer.images import of_log
            from objslam.viewer.live import open_view

            image = feed.image if recording is None else of_log(recording[0])
            feed = replace(feed, views=(*feed.views, stack.enter_context(open_view(view, say, image)).show))
        session.start()
        if resume:
            kept = session.counters.accepted()
            say(f"{out / NAME} gone on with: {', '.join(f'{n} {kind}' for kind, n in kept.items())}", stderr=True)
        _drive(session, feed, out, interval)
        _finish(session, feed, out, truth)


def _say_what_is_not_used(
    source: str,
    options: SourceOptions,
    detector: Path | None,
    domain: int | None,
    interface: str | None,
    speed: float,
    publish: bool,
) -> None:
    """Warn of options that mean nothing for a source; `sources.read` does so for what concerns recordings alone."""
    from objslam.live.adapters import ADAPTERS

    ros, network = source in ("dds", "rclpy"), publish or source == "dds"
    bags = {
        "--topic": options.topics,
        "--camera-info": options.camera_info,
        "--base-frame": options.base_frame,
        "--rectified": options.rectified,
        "--label": options.label,
    }
    recorded = {
        "--format": options.format,
        "--robot": options.robot,
        "--without-range": None if options.with_range else True,
        "--anonymous": options.anonymous or None,
    }
    unused = {
        "--detector": None if ros else detector,
        "--domain": None if network else domain,
        "--interface": None if network else interface,
        "--speed": speed if source in ADAPTERS and speed != 1.0 else None,
        **(bags if source in ADAPTERS and not ros else {}),
        **(recorded if source in ADAPTERS else {}),
    }
    for option, value in unused.items():
        if value is not None and value != ():
            say(f"warning: {option} has no meaning for {source if source in ADAPTERS else 'a recording'}", stderr=True)


def _read(path: Path, options: SourceOptions) -> tuple[Log, Ledger]:
    from objslam.errors import LogError
    from objslam.ledger import Ledger
    from objslam.sources import read

    if not path.exists():
        raise LogError("there is no such recording", where=str(path), hint="SOURCE is dds, rclpy, stdin, or a log or bag")
    ledger = Ledger()
    return read(path, ledger, options), ledger


def _look_for_journal(file: Path, resume: bool, stack: ExitStack) -> None:
    """Nothing that a session kept is lost: what is there is gone on with, or set aside until the new one holds anything."""
    from objslam.errors import OutputError
    from objslam.live.journal import put_back, set_aside

    if resume:
        if not file.is_file():
            raise OutputError("there is no journal to go on with", where=str(file), hint="leave out --resume")
        return
    aside = set_aside(file)
    if aside is None:
        return
    say(
        f"warning: kept the journal of an earlier session as {aside} (`objslam run` maps it; to go on with it, name it "
        f"{file.name} again and --resume)",
        stderr=True,
    )

    def end() -> None:
        if put_back(aside, file):
            say(f"nothing came: {file} is the journal of the earlier session again", stderr=True)

    stack.callback(end)


def _replay(
    recording: tuple[Log, Ledger], session: Session, settings: Settings, speed: float | None
) -> tuple[Feed, Truth | None]:
    from objslam.live.adapters import Feed
    from objslam.live.adapters.replay import ReplayAdapter

    log, ledger = recording
    adapter = ReplayAdapter(
        session, log, speed, session.wait, after=lambda: session.newest, ledger=ledger, settings=settings
    )
    return Feed(adapter), log.truth


def _drive(session: Session, feed: Feed, out: Path, interval: float) -> None:
    """Run the adapter until it ends or Ctrl-C, with a status line and objects.json."""
    from objslam.atomic_files import write_file
    from objslam.live.promptness import be_prompt
    from objslam.objects_file import dump_objects
    from objslam.results import OBJECTS, clear_result

    be_prompt()
    stop, failure = threading.Event(), list[BaseException]()

    def bring() -> None:
        try:
            feed.adapter.run(stop)
        except Exception as error:  # noqa: BLE001 - told below, in the thread that can tell it
            failure.append(error)

    bringing = threading.Thread(target=bring, name="objslam adapter", daemon=True)
    told, begun = 0, False
    with _ends_by_signal(stop), status_line() as show:
        bringing.start()
        due = time.monotonic() + interval
        while bringing.is_alive() and not stop.is_set() and not session.failed:
            bringing.join(_POLL)
            for warning in feed.adapter.ledger.warnings[told:]:
                told += 1
                say(f"warning: {warning}", stderr=True)
            if time.monotonic() >= due:
                due = time.monotonic() + interval
                snapshot = session.snapshot()
                if snapshot.keyframes and not begun:
                    begun = True
                    if removed := clear_result(out):
                        say(f"removed from {out}, for it was of an older result: {', '.join(removed)}", stderr=True)
                if begun:
                    write_file(out / OBJECTS, dump_objects(snapshot.map).encode())
                for view in feed.views:
                    view(snapshot)
                show(snapshot)
        stop.set()
        bringing.join()
    if failure:
        say(f"warning: the source ended: {failure[0]}", stderr=True)


def _finish(session: Session, feed: Feed, out: Path, truth: Truth | None) -> None:
    from objslam.cli.run import objects_table, say_written
    from objslam.results import write_result

    session.counters.ledger.add(feed.adapter.ledger)
    result = session.stop()
    last = session.snapshot()
    for view in feed.views:
        view(last)
    removed = write_result(result, out, truth)
    ledger = session.counters.ledger
    report(ledger)
    console().print(objects_table(result.map))
    counts = result.summary["counts"]
    resolved, thinned = counts["objects"] - counts["unresolved"], last.counters.get("keyframes left out", 0)
    more = f" ({thinned} more left out: live.max_keyframes)" if thinned else ""
    say(
        f"{resolved} object{'' if resolved == 1 else 's'} ({counts['unresolved']} unresolved) from {counts['rays']} rays "
        f"({counts['rays_unexplained']} of no object) in {counts['keyframes']} keyframes{more}; {times(last, ', ')}"
        f"{last.rebuilds} rebuilds"
    )
    say_written(out, removed)


@contextmanager
def _ends_by_signal(stop: threading.Event) -> Iterator[None]:
    """Ctrl-C and SIGTERM set stop; a second Ctrl-C ends at once."""

    def end(number: int, frame: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
