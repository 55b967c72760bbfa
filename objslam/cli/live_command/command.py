"""The command `objslam live`, which maps objects while the robot drives."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from objslam.cli.console import progress_bar, say, warn_of_neighbours
from objslam.cli.live_command.drive import LatestObjects, drive, finish
from objslam.cli.options import CalibrationFile, Config, Out, PriorMapPath, Quiet, Set, settings_of, with_options
from objslam.live.adapters import ADAPTERS, Feed, LiveOptions, NetworkOptions
from objslam.sources import SourceOptions
from objslam.sources.options import names, unused

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.core.diagnostics import Ledger
    from objslam.core.types import Log
    from objslam.live.session.session import Session


Speed = Annotated[
    float, typer.Option("--speed", min=0.0, help="Speed factor of a replay. 0 (also for stdin): as fast as the map follows.")
]
Resume = Annotated[bool, typer.Option("--resume", help="Continue a session that was killed or has ended, from its journal.")]
Interval = Annotated[float, typer.Option("--interval", min=0.1, help="Time between two updates of objects.json, s.")]
Publish = Annotated[
    bool, typer.Option("--publish", help="At each --interval, publish objects, markers and path over DDS for RViz and Nav2.")
]
PublishTf = Annotated[bool, typer.Option("--publish-tf", help="Publish the tf map -> odom over DDS, ten times a second.")]
View = Annotated[
    str | None, typer.Option("--view", help="Where to show the map: window, web (browser), FILE.rrd, or viewer address.")
]
WithJournal = Annotated[bool, typer.Option("--journal/--no-journal", help="Record all messages on the disk.")]


@with_options
def live(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help=", ".join(f"{name} ({it.says})" for name, it in ADAPTERS.items()) + ", or a recording to replay.",
        ),
    ],
    out: Out = Path("out"),
    config: Config = None,
    set_: Set = None,
    speed: Speed = 1.0,
    resume: Resume = False,
    interval: Interval = 1.0,
    journal: WithJournal = True,
    *,
    options: LiveOptions,
    calibration: CalibrationFile = None,
    map_: PriorMapPath = None,
    publish: Publish = False,
    publish_tf: PublishTf = False,
    view: View = None,
    quiet: Quiet = False,
) -> None:
    """Map objects while the robot drives. Update objects.json, and at the end (Ctrl-C), write a complete result folder.

    With --map, the exit code is 3 if the drive is not found in that map.
    """
    from objslam.api.mapping import prior_map
    from objslam.cli.run import NOT_LOCALISED
    from objslam.errors import ConfigError, OutputError
    from objslam.io.results.files import RECORDING
    from objslam.live.adapters.replay import ReplayAdapter
    from objslam.live.class_names import NamedSink
    from objslam.live.session.session import Session
    from objslam.output.result_folder import output_folder
    from objslam.sources.journal.record_format import NAME

    if view is not None and Path(view).resolve() == (out / RECORDING).resolve():
        raise OutputError("this file is the recording of the result", where=view, hint="choose another file for --view")
    if resume and not journal:
        raise ConfigError("--resume needs the journal, and --no-journal disables it", hint="leave out one of them")
    if publish_tf and source == "rclpy":
        raise ConfigError("with rclpy, --publish-tf would send the session its own tf", hint="use the source dds")
    settings = settings_of("joint", config, set_, calibration, options.class_names)
    _say_what_is_not_used(source, options, speed, publish or publish_tf)
    known = None if map_ is None else prior_map(map_)
    # The recording is read first, because it may be the journal in OUT, which is renamed below.
    recording = None if source in ADAPTERS else _read(Path(source), options, settings, quiet)
    with output_folder(out), ExitStack() as stack:
        if not (out / NAME).exists():
            warn_of_neighbours(out)
        if journal:
            _look_for_journal(out / NAME, resume, stack)
        patient = speed == 0 if recording is not None else _is_recorded(source, speed)
        kept = out / NAME if journal else None
        session = Session(settings, kept, resume, name=Path(source).name, patient=patient, known=known)
        stack.callback(session.abort)
        truth = None
        if recording is None:
            sink = session if options.class_names is None else NamedSink(session, options.class_names, session.counters)
            feed = ADAPTERS[source].opens(sink, settings, options, session.wait if patient else None)
        else:
            (log, ledger), newest = recording, lambda: session.newest
            adapter = ReplayAdapter(session, log, speed or None, session.wait, newest, ledger=ledger, settings=settings)
            feed, truth = Feed(adapter), log.truth
        for close in feed.close:
            stack.callback(close)
        if publish:
            feed = _publishing(feed, options)
        if publish_tf:
            feed = _publishing_tf(feed, options, session)
        if view is not None:
            from objslam.output.viewer.images import of_log
            from objslam.output.viewer.live.live_view import open_view

            image = feed.image if recording is None else of_log(recording[0])
            feed = replace(feed, views=(*feed.views, stack.enter_context(open_view(view, say, image)).show))
        session.start()
        if resume:
            taken = session.counters.accepted()
            held = ", ".join(f"{kind} {n}" for kind, n in taken.items()) or "none"
            say(f"continued the session in {out / NAME}. Messages taken before: {held}", stderr=True)
        latest = LatestObjects(out)
        broken = drive(session, feed, latest, interval, quiet)
        result = finish(session, feed, out, latest, truth, broken, quiet)
    if known is not None and not result.summary["localisation"]["localised"]:
        raise typer.Exit(NOT_LOCALISED)


def _publishing(feed: Feed, options: LiveOptions) -> Feed:
    from objslam.live.dds.network import open_network
    from objslam.live.dds.publisher import DdsPublisher

    publisher = DdsPublisher(open_network(options.domain, options.interface))
    return replace(feed, views=(*feed.views, publisher.publish))


def _publishing_tf(feed: Feed, options: LiveOptions, session: Session) -> Feed:
    """Return the feed with a publisher of tf, on the topic from which the robot's tf is read."""
    from objslam.live.dds.network import open_network
    from objslam.live.dds.transform_publisher import TransformPublisher
    from objslam.ros.topics import parse_topics

    topic = next(iter(parse_topics(options.topics, live=True).of("tf")), "/tf")
    publisher = TransformPublisher(open_network(options.domain, options.interface), feed.odom_frame, topic)
    ticks = (*feed.ticks, lambda: publisher.send(session.newest))
    return replace(feed, views=(*feed.views, publisher.update), ticks=ticks)


def _say_what_is_not_used(source: str, options: LiveOptions, speed: float, publish: bool) -> None:
    """Warn of the given options that have no effect on this source. `sources.read` warns of options that have no effect on
    the kind of a recording."""
    adapter = ADAPTERS.get(source)
    taken = names(adapter.options if adapter else SourceOptions, NetworkOptions if publish else None)
    taken |= {"class_names"} if adapter else {"detector"}
    paced = speed == 0 if adapter and adapter.recorded else adapter is None
    for flag in unused(options, LiveOptions, taken) + (["--speed"] if speed != 1.0 and not paced else []):
        say(f"warning: {flag} has no meaning for {source if adapter else 'a recording'}", stderr=True)


def _is_recorded(source: str, speed: float) -> bool:
    """Return whether the messages of an adapter come from a recording. No frame of a recording may be dropped because it is
    late."""
    recorded = ADAPTERS[source].recorded
    return recorded is not None and (speed == 0 or recorded())


def _read(path: Path, options: LiveOptions, settings: Settings, quiet: bool) -> tuple[Log, Ledger]:
    """Read a recording to replay. If the options name a detector, it finds the boxes. Raises LogError if the recording is
    missing or has no boxes."""
    from objslam.api.mapping import find_boxes
    from objslam.core.diagnostics import Ledger
    from objslam.errors import LogError
    from objslam.sources import read

    if not path.exists():
        hint = f"SOURCE is {', '.join(ADAPTERS)}, a log or a bag"
        raise LogError("there is no such recording", where=str(path), hint=hint)
    ledger = Ledger()
    with progress_bar(quiet=quiet) as show:
        log = read(path, ledger, options)
        if options.detector is not None:
            log = find_boxes(log, options.detector, settings, ledger, show)
    if all(camera_log.detections is None for camera_log in log.cameras):
        raise LogError("the recording has no boxes to replay", where=str(path), hint="find them with --detector MODEL.onnx")
    return log, ledger


def _look_for_journal(file: Path, resume: bool, stack: ExitStack) -> None:
    """Check that a journal to resume exists, or rename the journal of an earlier session.

    If the new session gets no message, the renamed journal gets its name back when the session ends. If a session was killed
    before its first message, this function restores the name when the next session starts.
    """
    from objslam.errors import OutputError
    from objslam.sources.journal.aside import put_back, restore_after_kill, set_aside

    if (kept := restore_after_kill(file)) is not None:
        say(f"the last session was killed before its first message: restored {file} from {kept.name}", stderr=True)
    if resume:
        if not file.is_file():
            raise OutputError("there is no journal to resume", where=str(file), hint="leave out --resume")
        return
    aside = set_aside(file)
    if aside is None:
        return
    say(
        f"warning: renamed the journal of an earlier session to {aside} (`objslam run` maps it; to resume it, rename it to "
        f"{file.name} and use --resume)",
        stderr=True,
    )

    def end() -> None:
        if put_back(aside, file):
            say(f"no message came: restored {file} of the earlier session", stderr=True)

    stack.callback(end)
