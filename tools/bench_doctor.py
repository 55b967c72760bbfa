"""Put each kind of mistake into a log, and print what is said of it.

    python tools/bench_doctor.py [--map] [--live] [--modes fixed joint] [--log LOG] [--cases NAME ...]

Without --log, the log is simulated. In the mode fixed, the true path is the localisation of a recorded log that has none.
Without --map, the table has the messages of the checks before the solve. With --map, each log is mapped with the default
settings, and the table has these columns:

said: the names of the findings (with * if no object is called ok because of it), and the first words of warnings that the
unchanged log does not give. ok: the objects that are called ok. over: how many of them are more than 3 sigmas from the true
object of their label (squared Mahalanobis distance above 13.9). squared: the median of the squared distances; 2.4 is honest.
off: the median error, m. A map in the frame of the odometry is laid on the truth first, and its objects are judged by the
covariances that this alignment leaves. Without true objects, the map of the unchanged log is the truth.
With --live, each log is replayed into a session, and the table has the result of its end.
verdict: right (no more objects over 3 sigmas than in the unchanged log, or a median that is at most 1.5 times larger), named
(no object is called ok), or WRONG, with or without a word.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from live_parts.common import replayed
from scipy.stats import chi2
from wrong_inputs import MISTAKES, join

from objslam.config import Odometry, Settings, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.types import Log, Truth, TruthObject
from objslam.errors import ObjslamError
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.mapping.checks.diagnosis import diagnose
from objslam.simulation import DepthNoise, PoseNoise, preset, simulate
from objslam.sources import SourceOptions, read

Run = Callable[[Log, Settings, Ledger], RunResult]
"""A function that maps a log."""
ROOM = {"objects": 10, "classes": 10, "pixel_sigma": 2.0, "missed": 0.1, "false": 0.01, "frames": 300}
JOINED = ("half the boxes of another day", "half the log of another day")
"""The mistakes that need a second log."""
OVER = float(chi2.ppf(0.997, 3))
"""The squared Mahalanobis distance beyond which an error in x, y and z is over 3 sigmas: 0.3 % of right errors are."""
RADIUS = 2.0
"""The radius of a match for the alignment, m. Labels identify the objects, and a large error is not a missed object."""
MORE = 1.5
"""The largest median of the squared distances of a right map, as a multiple of that of the unchanged log."""
WORDS = 7
"""The number of words of a warning in the table."""


@dataclass(frozen=True)
class Row:
    """The outcome of a run. said: the warnings, the names of findings first. spoilt: whether no object is called ok because
    of a finding. off, squared: (N,) errors (m) and squared Mahalanobis distances of the objects that are ok."""

    said: tuple[str, ...]
    spoilt: bool
    off: np.ndarray
    squared: np.ndarray
    truth: Truth | None

    @property
    def over(self) -> int:
        """The number of objects over 3 sigmas."""
        return int((self.squared > OVER).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", type=Path, help="a recorded log instead of a simulated one")
    parser.add_argument("--robot", type=int, help="the robot of an MRCLAM folder")
    parser.add_argument("--label", help="the label of the boxes of a TUM RGB-D folder")
    parser.add_argument("--without-range", action="store_true", help="drop the depths of boxes")
    parser.add_argument("--modes", nargs="+", default=["fixed", "joint"], choices=["fixed", "joint"])
    parser.add_argument("--cases", nargs="+", help="the names of the mistakes, by default all", metavar="NAME")
    parser.add_argument("--clean", type=int, default=0, metavar="N", help="count false alarms in N logs a mode instead")
    parser.add_argument("--map", action="store_true", help="map each log, and compare errors with sigmas (takes minutes)")
    parser.add_argument("--live", action="store_true", help="the same, by a session that gets the log message by message")
    options = parser.parse_args()
    if options.clean:
        clean(options.clean, options.modes)
        return
    recorded = None
    if options.log is not None:
        source = SourceOptions(robot=options.robot, label=options.label, with_range=not options.without_range)
        recorded = read(options.log, Ledger(), source)
    for mode in options.modes:
        settings = load_settings(None, (f"mode={mode}", "output.recording=false", "reconstruction.use=false"))
        names = options.cases or [*MISTAKES, *(JOINED if recorded is None else ())]
        logs = ((name, simulated(mode, name) if recorded is None else mistaken(recorded, mode, name)) for name in names)
        if options.map or options.live:
            unchanged = simulated(mode, "none") if recorded is None else mistaken(recorded, mode, "none")
            table(mode, unchanged, logs, settings, live_run if options.live else pipeline.run)
        else:
            for name, log in logs:
                print(f"{mode:5s} | {name:30s} | {told(log, settings)}", flush=True)


def drive(mode: str, seed: int, *, depth: bool = False) -> Log:
    """A drive with localisation for `fixed`, with odometry alone for `joint`."""
    changes = {**ROOM, "depth": DepthNoise() if depth else None}
    changes |= {"odometry": None} if mode == "fixed" else {"odometry": Odometry(), "localization": None}
    if mode == "fixed":
        changes["localization"] = PoseNoise(xy=0.02, yaw=0.005)
    return simulate(preset("demo", **changes), seed)


def simulated(mode: str, name: str) -> Log:
    """A simulated log with a mistake."""
    log = drive(mode, 0, depth="depth" in name)
    if name in JOINED:
        return join(log, drive(mode, 1), interleaved="boxes" in name)
    return MISTAKES[name](log) if name != "none" else log


def mistaken(log: Log, mode: str, name: str) -> Log:
    """A recorded log with a mistake. In the mode fixed, it has a localisation."""
    if mode == "fixed" and log.localization is None and log.truth is not None:
        log = replace(log, odometry=None, localization=log.truth.trajectory)
    return MISTAKES[name](log) if name != "none" else log


def told(log: Log, settings: Settings) -> str:
    """The messages of the checks before the solve."""
    try:
        return "; ".join(finding.message for finding in diagnose(log, settings, Ledger()).findings) or "-"
    except ObjslamError as error:
        return f"refused: {error}"


def live_run(log: Log, settings: Settings, ledger: Ledger) -> RunResult:
    """Replay a log into a session as fast as it follows, and return the session's result."""
    session = replayed(log, settings)
    try:
        return session.stop()
    finally:
        ledger.add(session.counters.ledger)


def table(mode: str, unchanged: Log, logs: Iterator[tuple[str, Log]], settings: Settings, run: Run) -> None:
    """Map each log, and print its row."""
    print("mode  | case                           | said | ok | over | squared | off | verdict | CPU s")
    first = mapped(unchanged, unchanged.truth, settings, run)
    assert not isinstance(first, str)
    print_row(mode, "none", first, Row((), False, first.off, first.squared, None), 0.0)
    for name, log in logs:
        begin = time.process_time()
        row = mapped(log, first.truth, settings, run)
        print_row(mode, name, row, first, time.process_time() - begin)


def print_row(mode: str, name: str, row: Row | str, unchanged: Row, seconds: float) -> None:
    """Print a row, or the error of a run."""
    if isinstance(row, str):
        cells = f"{row} |  |  |  |  | refused"
    else:
        said = [one for one in row.said if one not in unchanged.said]
        middle = f"{np.median(row.squared):.2g} | {np.median(row.off):.2g}" if len(row.off) else " | "
        right = row.over <= unchanged.over or np.median(row.squared) <= MORE * np.median(unchanged.squared)
        verdict = "named" if row.spoilt else "right" if right else "WRONG"
        verdict += " and silent" if verdict == "WRONG" and not said else ""
        cells = f"{'; '.join(said) or '-'} | {len(row.squared)} | {row.over} | {middle} | {verdict}"
    print(f"{mode:5s} | {name:30s} | {cells} | {seconds:.0f}", flush=True)


def mapped(log: Log, truth: Truth | None, settings: Settings, run: Run) -> Row | str:
    """Map a log. Return its row, or the line of its error."""
    ledger = Ledger()
    try:
        result = run(log, settings, ledger)
    except ObjslamError as error:
        return str(error).splitlines()[0]
    findings = result.summary["wrong_input"]
    messages = {finding["message"] for finding in findings}
    said = [f"{finding['name']}{'*' if finding['spoils_positions'] else ''}" for finding in findings]
    said += [" ".join(w.split()[:WORDS]) for w in ledger.warnings if w not in messages and "is called ok" not in w]
    objects = result.map.resolved()
    if truth is None or not truth.objects:
        truth = Truth(tuple(TruthObject(item.id, item.label, item.position) for item in objects), None)
    align = "se2" if result.summary["map_frame"] == "odometry" else "none"
    found = evaluate(result.map, truth, align=align, radius=RADIUS).objects
    assert found is not None
    matches = {match.object.id: match for match in found.matches}
    off, squared = [], []
    for item in objects:
        match = matches.get(item.id)
        if match is not None and match.squared_3d is not None:
            # The alignment takes out what all objects share, and spreads the rest, so it changes the covariances too.
            off.append(match.error)
            squared.append(match.squared_3d)
            continue
        turn = found.transform.pose[:3, :3]
        covariance = turn @ item.covariance @ turn.T
        offsets = [
            found.transform.apply(item.position) - true.position for true in truth.objects if true.label == item.label
        ]
        nearest = min(offsets, key=lambda x: float(np.linalg.norm(x)), default=np.full(3, np.inf))
        off.append(np.linalg.norm(nearest))
        squared.append(nearest @ np.linalg.solve(covariance, nearest))
    spoilt = any(finding["spoils_positions"] for finding in findings)
    return Row(tuple(said), spoilt, np.array(off), np.array(squared), truth)


def drives(number: int, modes: list[str]) -> Iterator[tuple[str, Log]]:
    for seed in range(number):
        for mode in modes:
            yield mode, drive(mode, 100 + seed, depth=seed % 2 == 1)


def clean(number: int, modes: list[str]) -> None:
    """Print how many clean logs are found fault with."""
    alarms, logs = 0, 0
    for mode, log in drives(number, modes):
        found = diagnose(log, load_settings(None, (f"mode={mode}",)), Ledger(), thorough=True).findings
        alarms, logs = alarms + bool(found), logs + 1
        for finding in found:
            print(f"{mode}: {finding.message}", flush=True)
    print(f"{alarms} false alarms in {logs} clean logs")


if __name__ == "__main__":
    main()
