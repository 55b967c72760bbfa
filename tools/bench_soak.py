"""Measure the memory, descriptors, threads, journal and time per frame of a session hour by hour for a day.

    python tools/bench_soak.py                               # 24 hours of a robot in about 3 hours of CPU
    python tools/bench_soak.py --odometry 20 --frames 4      # the same day at lower rates, in about 30 minutes of CPU
    python tools/bench_soak.py --check                       # exit code 1 if something grows
    python tools/bench_soak.py --hours 4 --owners 10         # and the lines of code whose memory grew most

A robot drives the same lap of a room with 30 objects again and again, so every lap closes a loop. Its odometry drifts and
comes at 200 Hz, and its boxes at 20 Hz. One box in 50 is false, so tracks begin and are lost. In every 10th lap the camera
is silent for 30 s. After every 30th lap, once an hour, all publishers begin anew: stamps and odometry start again at 0. A
frame is pushed as soon as the session has mapped the frame before, and the session keeps a journal.

Memory is the resident size of the process. Descriptors and threads are the most that any lap of the hour ended with. The
journal is the size of the open segment and of all segments. Two times are measured for each frame, with the odometry before
it: the CPU time of the process, and the wall time until the map contains the frame. Other work on the machine changes the
wall time much, and the CPU time less. Both are told as the median and the 99th percentile of the hour.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
import time
import tracemalloc
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import objslam
from objslam.config import Odometry, load_settings
from objslam.core.geometry import inverse
from objslam.core.types import Log
from objslam.live.session import low_latency
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate
from objslam.sources.journal.record_format import NAME

_LAP = 120.0
"""The time of a lap, s."""
_SILENT = 30.0
"""How long the camera is silent in some laps, s."""
_CAMERA_RESTS, _ALL_BEGIN_ANEW = 10, 30
"""The period of the laps in which the camera is silent, and of those after which all publishers begin anew."""
_MOST_GROWTH = 20.0
"""The largest growth of the memory from the end of the first hour to the last that --check accepts, MB."""
_MOST_SLOWER = 1.2
"""The largest ratio of the last hour's 99 % CPU time of a frame to the second hour's that --check accepts."""


@dataclass
class Spent:
    """What the frames of an hour cost, and the most descriptors and threads. cpu, wall: ms, a number for each frame."""

    cpu: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)
    descriptors: int = 0
    threads: int = 0

    def look(self) -> None:
        """Count the descriptors and threads of this process now."""
        self.descriptors = max(self.descriptors, len(list(Path("/proc/self/fd").iterdir())))
        self.threads = max(self.threads, threading.active_count())


@dataclass(frozen=True)
class Hour:
    """What was measured at the end of an hour of the robot. resident, segment, journal: MB. cpu, wall: 50 and 99 %, ms."""

    hour: float
    resident: float
    descriptors: int
    threads: int
    segment: float
    journal: float
    keyframes: int
    objects: int
    cpu: tuple[float, float]
    wall: tuple[float, float]
    dropped: int
    seconds: float

    def __str__(self) -> str:
        counts = f"{self.descriptors:5d}{self.threads:9d}{self.segment:9.1f}{self.journal:9.1f}{self.keyframes:11d}"
        times = "".join(f"{value:8.1f}" for value in (*self.cpu, *self.wall))
        return f"{self.hour:6.2f}{self.resident:13.1f}{counts}{self.objects:9d}{times}{self.dropped:9d}{self.seconds:9.0f}"


_HEAD = (
    "  hour  resident MB  fds  threads  open MB   all MB  keyframes  objects CPU p50     p99    wall     p99  dropped    CPU"
)


def lap(odometry_rate: float, frame_rate: float) -> Log:
    """A lap that ends where it began, with odometry of this rate."""
    return simulate(
        preset(
            "demo",
            room=(14.0, 10.0),
            objects=30,
            classes=10,
            frames=round(_LAP * frame_rate),
            frame_rate=frame_rate,
            odometry_rate=odometry_rate,
            laps=1.0,
            false=0.02,
            localization=None,
            odometry=Odometry(),
        ),
        0,
    )


def drive(session: Session, log: Log, number: int, spent: Spent) -> None:
    """Push a lap, each frame after the odometry before it. Lap `number` begins where the one before it ended.

    After every `_ALL_BEGIN_ANEW` laps, stamps and odometry start again at 0.
    """
    odometry, found = log.odometry, log.cameras[0].detections
    assert odometry is not None
    assert found is not None
    since = number % _ALL_BEGIN_ANEW
    step = np.linalg.matrix_power(odometry.poses[-1] @ inverse(odometry.poses[0]), since)
    span = float(odometry.stamps[-1] - odometry.stamps[0]) + float(np.diff(odometry.stamps[:2])[0])
    camera, at = log.cameras[0].camera.name, 0
    poses, stamps = step @ odometry.poses, odometry.stamps + since * span
    starts = np.searchsorted(found.frame, np.arange(len(found.frame_stamps) + 1))
    quiet = found.frame_stamps[-1] - _SILENT
    for index, stamp in enumerate(found.frame_stamps.tolist()):
        until = min(int(np.searchsorted(odometry.stamps, stamp)) + 1, len(stamps))
        rests = stamp > quiet and number % _CAMERA_RESTS == _CAMERA_RESTS - 1
        cpu = time.process_time()
        for i in range(at, until):
            session.push_odometry(float(stamps[i]), poses[i])
        at = until
        if rests:
            session.wait()
            continue
        wall, mine = time.perf_counter(), slice(starts[index], starts[index + 1])
        names = [found.label_names[label] for label in found.label[mine].tolist()]
        session.push_detections(stamp + since * span, camera, found.boxes[mine], names, found.scores[mine])
        session.wait()
        spent.wall.append(1e3 * (time.perf_counter() - wall))
        spent.cpu.append(1e3 * (time.process_time() - cpu))
    spent.look()


def measure(session: Session, folder: Path, hours: float, begin: float, spent: Spent) -> Hour:
    """The state of this process and of the session."""
    snapshot = session.snapshot()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    sizes = {file.name: file.stat().st_size / 1e6 for file in folder.iterdir()}
    cpu, wall = (np.quantile(values, (0.5, 0.99)) for values in (spent.cpu, spent.wall))
    return Hour(
        hours,
        pages * os.sysconf("SC_PAGESIZE") / 1e6,
        spent.descriptors,
        spent.threads,
        sizes.get(NAME, 0.0),
        sum(sizes.values()),
        snapshot.keyframes,
        len(snapshot.map.resolved()),
        (float(cpu[0]), float(cpu[1])),
        (float(wall[0]), float(wall[1])),
        sum(snapshot.dropped.values()),
        time.process_time() - begin,
    )


def told_owners(before: tracemalloc.Snapshot, most: int) -> list[str]:
    """The lines of code whose memory has grown most since a snapshot, and the growth of all, one line each."""
    grown = tracemalloc.take_snapshot().compare_to(before, "lineno")
    package = str(Path(objslam.__file__).parent) + os.sep
    named = [(one.size_diff / 1e6, one.count_diff, str(one.traceback[0]).removeprefix(package)) for one in grown]
    named.sort(reverse=True)
    rows = [f"{size:10.2f} MB {count:9d} blocks  {place}" for size, count, place in named[:most]]
    return [*rows, f"{sum(size for size, _, _ in named):10.2f} MB in all"]


def judge(rows: list[Hour], segment: float) -> list[str]:
    """What grew that should not have, one line each. segment: the largest size of the journal's open segment, MB."""
    settled = [row for row in rows if row.hour >= min(2.0, rows[-1].hour / 2)]
    first, second, last = rows[0], settled[0], settled[-1]
    return [
        f"{name}: {value:.1f}, at most {most:.1f}"
        for name, value, most in (
            ("resident MB", last.resident, first.resident + _MOST_GROWTH),
            ("descriptors", last.descriptors, second.descriptors),
            ("threads", last.threads, second.threads),
            ("99 % CPU time, ms", last.cpu[1], _MOST_SLOWER * second.cpu[1]),
            ("MB of the open segment", max(row.segment for row in rows), segment),
        )
        if value > most
    ]


def main() -> int:
    """Print the table, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0, help="the hours that the robot drives")
    parser.add_argument("--odometry", type=float, default=200.0, help="the rate of the odometry, poses per second")
    parser.add_argument("--frames", type=float, default=20.0, help="the rate of the camera, frames per second")
    parser.add_argument("--every", type=float, default=1.0, help="the hours of the robot between two rows")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after this number of CPU seconds")
    parser.add_argument("--owners", type=int, default=0, help="trace the memory (twice the CPU time), and name this many")
    parser.add_argument("--check", action="store_true", help="exit code 1 if something grows")
    options = parser.parse_args()
    log, rows, spent = lap(options.odometry, options.frames), list[Hour](), Spent()
    first: tracemalloc.Snapshot | None = None
    low_latency.configure()  # As `objslam live` does.
    if options.owners:
        tracemalloc.start()
    print(f"odometry at {options.odometry:g} Hz, frames at {options.frames:g} Hz; times in ms\n{_HEAD}", flush=True)
    with tempfile.TemporaryDirectory() as name:
        settings = load_settings(None, ("mode=joint", "rays.pixel_sigma=2"))
        session = Session(settings, Path(name) / "journal.objslam", patient=True).start()
        session.push_camera(log.cameras[0].camera)
        begin, number, due = time.process_time(), 0, options.every
        while session.failure is None and (hours := number * _LAP / 3600) < options.hours:
            if time.process_time() - begin > options.seconds:
                break
            drive(session, log, number, spent)
            number += 1
            if number * _LAP / 3600 >= due - 1e-9:
                due += options.every
                rows.append(measure(session, Path(name), number * _LAP / 3600, begin, spent))
                spent = Spent()
                print(rows[-1], flush=True)
                if options.owners and first is None:
                    first = tracemalloc.take_snapshot()
        hours = number * _LAP / 3600
        owners = told_owners(first, options.owners) if first is not None and len(rows) > 1 else []
        failure, counted, dropped = session.failure, session.counters.accepted(), session.counters.dropped()
        session.abort()
    print(*owners, sep="\n", end="\n" if owners else "")
    for reason, count in (counted | dropped).items():
        print(f"{count:12d} {reason}")
    print(f"{hours:.2f} hours of the robot" + (f"; the session failed: {failure}" if failure else ""))
    grown = judge(rows, 1.1 * settings.live.journal_segment_mb) if len(rows) > 2 else []
    for line in grown:
        print(line)
    return int(failure is not None or (options.check and bool(grown)))


if __name__ == "__main__":
    sys.exit(main())
