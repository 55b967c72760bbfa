"""What a terminal of few columns shows: tables without a cut number, and a status line that stays one line."""

import io
import re
import sys
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from waiting import wait_for

from objslam.cli import console as terminal
from objslam.cli.console import SpeakingLedger, progress_bar, report
from objslam.cli.info import _table
from objslam.cli.live_command import status
from objslam.cli.live_command.status import status_line
from objslam.cli.run import advice_on_tags, objects_table
from objslam.config.tags import Tags
from objslam.core.bodies.body import Body
from objslam.core.bodies.tag_pose import TagPose
from objslam.core.diagnostics import Ledger
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.snapshot import TOO_SLOW, Snapshot
from objslam.core.trajectory import Trajectory
from objslam.frontend.bearings import CUT_OFF

EMPTY = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))


def thing(number: int, label: str, place: tuple[float, float, float]) -> MapObject:
    return MapObject(number, label, np.array(place), 0.25 * np.eye(3), "ok", 1234, 99, 41.25, 0.375, 0.0, 1.0)


def shown(width: int) -> str:
    objects = (thing(0, "cup", (-12.345, 101.111, 2.222)), thing(117, "dispenser_button", (-2.468, -1.357, -0.975)))
    screen = Console(file=io.StringIO(), width=width)
    screen.print(objects_table(objects, screen))
    return screen.file.getvalue()


@pytest.mark.parametrize("width", range(55, 121, 5))
def test_a_table_cuts_no_number(width):
    text = shown(width)
    assert max(map(len, text.splitlines())) <= width
    for number in ("117", "-12.345", "101.111", "2.222", "-2.468", "-1.357", "-0.975", "dispenser_button"):
        assert re.search(rf"[ │]{re.escape(number)}[ │]", text), text
    assert ("41.2" in text) <= ("0.38" in text) <= ("1234" in text)  # the order in which columns go


def test_a_table_of_80_columns_leaves_out_parallax_and_not_sigma():
    assert "41.2" in shown(120)
    assert "41.2" not in shown(80)
    assert "0.500" in shown(80)


def test_a_table_is_in_the_order_of_labels_and_ids():
    """The map of a live session has its objects in the order in which they were found."""
    names = [(7, "plant"), (2, "cup"), (9, "book"), (1, "plant"), (10, "cup")]
    screen = Console(file=io.StringIO(), width=120)
    screen.print(objects_table([thing(number, label, (0.0, 0.0, 0.0)) for number, label in names], screen))
    rows = re.findall(r"│ +(\d+) │ (\w+)", screen.file.getvalue())
    assert rows == [("9", "book"), ("2", "cup"), ("10", "cup"), ("1", "plant"), ("7", "plant")]


def test_a_table_has_no_empty_column():
    assert "size m" not in shown(200)
    assert "sigma m" in shown(200)


class Tty(io.StringIO):
    def isatty(self) -> bool:
        return True


@contextmanager
def terminal_in_place_of_stderr(columns, screen=None):
    """A terminal of that width; no fixture, because pytest sets stderr anew between a fixture and its test."""
    screen = Tty() if screen is None else screen
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stderr", screen)
        patch.setenv("COLUMNS", str(columns))
        patch.setenv("TERM", "xterm")
        terminal.console_of.cache_clear()
        try:
            yield screen
        finally:
            terminal.console_of.cache_clear()


WARNING = (
    "the boxes agree only if the noise of the boxes is 20 times what the settings say, or more: unless it really is, the "
    "input is wrong; see /home/somebody/recordings/of/a/robot/with/a/path/that/no/terminal/has/room/for/camera_front.yaml"
)


@pytest.mark.parametrize("kind", [Tty, io.StringIO])
@pytest.mark.parametrize("columns", [40, 80])
def test_a_sentence_is_wrapped_between_words_where_the_width_is_known(kind, columns):
    """On a terminal, and in a pipe if COLUMNS gives a width. A path stays whole, so that it can be copied."""
    with terminal_in_place_of_stderr(columns, kind()) as screen:
        terminal.say(WARNING, stderr=True)
        lines = screen.getvalue().splitlines()
    assert " ".join(line.strip() for line in lines) == WARNING
    assert len(lines) > 2
    assert all(len(line.rstrip()) <= columns for line in lines if "/home" not in line)


def test_a_sentence_in_a_pipe_is_one_line_and_data_are_never_wrapped():
    with terminal_in_place_of_stderr(40) as screen:
        terminal.put(WARNING, stderr=True)
        assert screen.getvalue() == WARNING
    with terminal_in_place_of_stderr("", io.StringIO()) as screen:
        terminal.say(WARNING, stderr=True)
        assert screen.getvalue() == f"{WARNING}\n"


def test_the_status_line_is_one_line_and_gives_way_to_others():
    """The screen is what is left after each carriage return, erased line and line up."""
    snapshot = Snapshot(1.0, ObjectMap(()), EMPTY, 7, counters={"odometry": 5, "frames": 3}, dropped={"frame too late": 2})
    with terminal_in_place_of_stderr(60) as screen, status_line() as show:
        show(snapshot, Ledger())
        terminal.say("warning: no publisher of boxes", stderr=True)
        show(snapshot, Ledger())
    assert re.search(r"0 objects \| odometry \d+/s frames \d+/s \| lag 0 ms \| dropped 2", screen.getvalue())
    lines = [""]
    for part in re.split(r"(\x1b\[[0-9?]*[A-Za-z]|\r|\n)", screen.getvalue()):
        if part == "\n":
            lines.append("")
        elif part == "\x1b[2K":
            lines[-1] = ""
        elif part == "\x1b[1A":
            lines.pop()
        elif part != "\r" and not part.startswith("\x1b"):
            lines[-1] += part
            assert len(lines[-1]) <= 60
    assert [line for line in lines if line] == ["warning: no publisher of boxes"]


def test_a_cell_without_a_value_is_empty_and_a_body_has_its_size():
    body = Body("cuboid", np.array([0.2, 0.1, 0.3]), 0.0, np.full(3, 0.01), 0.1)
    seen_once = replace(thing(3, "cup", (np.nan, np.nan, np.nan)), rms_deg=np.nan, covariance=None, status="unresolved")
    screen = Console(file=io.StringIO(), width=120)
    screen.print(objects_table((replace(thing(1, "box", (1.0, 2.0, 3.0)), body=body), seen_once), screen))
    assert "0.20 x 0.10 x 0.30" in screen.file.getvalue()
    assert "nan" not in screen.file.getvalue()


@pytest.mark.parametrize(("given", "told"), [(Tags(), True), (Tags(size=0.16), False), (Tags(sizes={1: 0.16}), False)])
def test_tags_of_unknown_size_say_how_a_size_helps(given, told):
    tag = TagPose(np.array([0.0, 0.0, 0.0, 1.0]), 1e-4 * np.eye(3), 0.16, 0.002)
    objects = (thing(0, "cup", (1.0, 2.0, 3.0)), replace(thing(1, "tag_1", (1.0, 2.0, 3.0)), tag=tag))
    assert ("--set tags.size=METRES" in advice_on_tags(objects, given)) == told
    assert advice_on_tags(objects[:1], given) == ""


def test_the_bar_of_a_stage_forgets_the_count_of_the_stage_before():
    with terminal_in_place_of_stderr(100) as tty, progress_bar() as show:
        show("detecting", 220, 220)
        show("solving", 0, 0)
        mark = len(tty.getvalue())
    after = tty.getvalue()[mark:]
    assert "solving" in after
    assert "220" not in after


def test_the_bar_of_a_stage_shows_its_count_from_the_start_and_its_rate():
    with terminal_in_place_of_stderr(100) as tty, progress_bar() as show:
        mark = len(tty.getvalue())
        for done in range(221):
            show("detecting", done, 220)
    after = tty.getvalue()[mark:]
    assert "/?" not in after
    assert "220/220" in after
    assert "/s" in after


def test_the_status_line_says_why_most_was_dropped(monkeypatch):
    """Also what the adapter dropped, and apart from it what the settings leave unused."""
    monkeypatch.setattr("objslam.cli.live_command.status._LINES", 0.0)
    seen = io.StringIO()
    monkeypatch.setattr(sys, "stderr", seen)
    terminal.console_of.cache_clear()
    ledger = Ledger()
    ledger.drop("line malformed: not JSON", 3)
    snapshot = Snapshot(np.nan, ObjectMap(()), EMPTY, counters={"localization not used": 141}, dropped={"frame too late": 1})
    try:
        with status_line() as show:
            show(snapshot, ledger)
    finally:
        terminal.console_of.cache_clear()
    assert "dropped 4 (line malformed: not JSON), 141 localization not used" in seen.getvalue()


def test_at_80_columns_the_status_line_shows_rates_lag_and_keyframes(monkeypatch):
    """Boxes at the image's edge are dropped on every robot, so they take no room."""
    screen = Tty()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setattr("objslam.cli.live_command.status.time.monotonic", iter(range(0, 1000, 10)).__next__)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    terminal.console_of.cache_clear()
    counters = {"odometry": 200, "frames": 50}
    snapshot = Snapshot(1.0, ObjectMap(()), EMPTY, 378, lag=0.03, counters=counters)
    snapshot = replace(snapshot, dropped={CUT_OFF: 55, TOO_SLOW: 7})
    try:
        with status_line() as show:
            show(snapshot, Ledger())
    finally:
        terminal.console_of.cache_clear()
    shown = "0 objects | odometry 20/s frames 5/s | lag 30 ms | 378 keyframes | dropped 7"
    assert shown in screen.getvalue()


def test_at_80_columns_the_topics_of_a_bag_lose_columns_and_nothing_wraps(monkeypatch):
    """A pipe without COLUMNS, which has no width, gets all columns."""
    names = ("topic", "role", "type", "messages", "Hz", "gap s", "from s", "to s", "frame", "what")
    rows = [("/camera/color/camera_info", "camera_info", "sensor_msgs/CameraInfo", "445", "5.0", "0.20", "0.50", "89.30")]
    rows = [(*rows[0], "camera_color_optical_frame", "640x480 plumb_bob")]
    for screen, columns, most in ((Tty(), "80", 80), (io.StringIO(), "80", 80), (io.StringIO(), "", 200)):
        monkeypatch.setenv("COLUMNS", columns)
        monkeypatch.setattr(sys, "stdout", screen)
        terminal.console_of.cache_clear()
        try:
            _table(names, rows)
        finally:
            terminal.console_of.cache_clear()
        lines = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", screen.getvalue()).splitlines()
        assert len(lines) == 2
        assert max(map(len, lines)) <= most
        assert "/camera/color/camera_info" in lines[1]
        assert ("plumb_bob" in lines[1]) == (most > 80)


def test_a_line_clears_the_status_line_that_is_on_the_screen():
    snapshot = Snapshot(1.0, ObjectMap(()), EMPTY, 7)
    with terminal_in_place_of_stderr(80) as screen, status_line() as show:
        show(snapshot, Ledger())
        terminal.console(stderr=True).print()  # As the thread that draws the line does.
        mark = len(screen.getvalue())
        terminal.say("removed the older result from out", stderr=True)
    assert re.match(r"(\r|\x1b\[2K|\x1b\[1A)+removed the older result", screen.getvalue()[mark:])


@pytest.mark.parametrize("localised", [False, True])
def test_a_status_line_of_80_columns_tells_how_many_data_were_dropped(localised):
    counters = {"odometry": 12345, "frames": 4000} | ({"localization": 9000} if localised else {})
    objects = ObjectMap(tuple(thing(i, "cup", (1.0, 2.0, 3.0)) for i in range(25)))
    snapshot = Snapshot(1.0, objects, EMPTY, 1234, lag=0.123, counters=counters, dropped={TOO_SLOW: 123})
    for width, rest in ((80, ("25 objects", "lag 123 ms")), (200, ("25 objects, 0 unresolved", "1234 keyframes"))):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(status.time, "monotonic", iter((0.0, 100.0)).__next__)
            line = status._Rates().line(snapshot, Ledger(), width)
        assert "dropped 123" in line[:width]
        assert all(words in line for words in rest)
        assert "frames 40/s" in line


def test_numbers_of_one_thing_have_no_plural():
    snapshot = Snapshot(1.0, ObjectMap((thing(1, "cup", (1.0, 2.0, 3.0)),)), EMPTY, 1)
    line = status._Rates().line(snapshot, Ledger())
    assert "1 object," in line
    assert "1 keyframe " in line


def test_the_longest_topics_lose_their_types_too(monkeypatch):
    names = ("topic", "role", "type", "messages", "Hz")
    rows = [("/front_camera/color/image_raw/compressed", "rgb", "sensor_msgs/CompressedImage", "4450", "30.0")]
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(sys, "stdout", Tty())
    terminal.console_of.cache_clear()
    try:
        _table(names, rows)
    finally:
        terminal.console_of.cache_clear()
    lines = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", sys.stdout.getvalue()).splitlines()
    assert len(lines) == 2
    assert max(map(len, lines)) <= 80
    assert "image_raw/compressed  rgb" in lines[1]


def test_a_pipe_gets_a_plain_line_of_progress_now_and_then(monkeypatch):
    monkeypatch.setattr("objslam.cli.console._EVERY", 0.001)
    with terminal_in_place_of_stderr("", io.StringIO()) as screen:
        with progress_bar() as show:
            wait_for(lambda: "reading" in screen.getvalue())
            show("association, round 3", 0, 0)
            wait_for(lambda: "s: association, round 3\n" in screen.getvalue())
            show("detecting", 7, 220)
            wait_for(lambda: "s: detecting 7 of 220\n" in screen.getvalue())
        ended = screen.getvalue()
    assert all(re.fullmatch(r"working for \d+ s: [a-z0-9, ]+", line) for line in ended.splitlines())


def test_a_quiet_command_and_a_short_one_print_no_progress_into_a_pipe(monkeypatch):
    ledger = SpeakingLedger()
    with terminal_in_place_of_stderr("", io.StringIO()) as screen:
        with progress_bar() as show:
            show("solve", 0, 0)
        monkeypatch.setattr("objslam.cli.console._EVERY", 0.001)
        with progress_bar(ledger, quiet=True) as show:
            show("solve", 0, 0)
            ledger.warn("first")
            wait_for(lambda: len(ledger.told) == 1)
            ledger.warn("second")
            wait_for(lambda: len(ledger.told) == 2)
        assert screen.getvalue() == "warning: first\nwarning: second\n"


@pytest.mark.parametrize("kind", [Tty, io.StringIO])
def test_a_warning_is_printed_while_a_command_works_and_only_once(monkeypatch, kind):
    monkeypatch.setattr("objslam.cli.console._EVERY", 0.001)
    with terminal_in_place_of_stderr(100, kind()) as screen:
        ledger = SpeakingLedger()
        with progress_bar(ledger) as show:
            show("solve", 0, 0)
            ledger.warn("the camera is upside down")
            wait_for(lambda: "warning: the camera is upside down\n" in screen.getvalue())
        ledger.drop("boxes below rays.min_score", 2)
        ledger.warn("the camera is upside down")
        ledger.warn("the map is empty")
        mark = len(screen.getvalue())
        report(ledger)
        assert screen.getvalue()[mark:].splitlines() == [
            "warning: dropped 2: boxes below rays.min_score",
            "warning: the map is empty",
        ]


def test_a_run_that_starts_again_prints_its_new_warnings_and_takes_old_ones_back():
    """The first solve, at the given poses, warns of the input. The second one solves the poses too, and explains it."""
    with terminal_in_place_of_stderr("", io.StringIO()) as screen:
        ledger = SpeakingLedger()
        ledger.warn("tags are left out")
        before = ledger.copy()
        ledger.warn("the boxes do not agree with the poses")
        ledger.speak()
        ledger.restore(before)
        ledger.warn("the poses are solved too")
        ledger.warn("tags are left out")
        mark = len(screen.getvalue())
        report(ledger)
        assert screen.getvalue()[mark:].splitlines() == [
            "warning: the poses are solved too",
            "taken back, because the run could explain it: the boxes do not agree with the poses",
        ]


def test_the_lines_of_a_ledger_that_does_not_speak_are_printed_in_the_end():
    with terminal_in_place_of_stderr("", io.StringIO()) as screen:
        ledger = Ledger()
        ledger.warn("the camera is upside down")
        ledger.drop("boxes below rays.min_score", 2)
        report(ledger)
        assert [line.removeprefix("warning: ") for line in screen.getvalue().splitlines()] == ledger.lines()
