"""Measure the memory, descriptors, threads, journal and latency of a session hour by hour for a day.

    python tools/bench_soak.py                      # 24 hours of a robot in about 40 minutes of CPU
    python tools/bench_soak.py --hours 2 --laps 40
    python tools/bench_soak.py --check              # exit code 1 if memory or latency grow after the second hour

A robot drives the same lap of a room with 30 objects again and again, so every lap closes a loop. Its odometry drifts and
comes at 200 Hz, and its boxes at 20 Hz. A frame is pushed as soon as the session has mapped the frame before, and the
session keeps a journal. --odometry and --frames set lower rates, which take less time. Memory is the resident size of the
process. Latency is the time from the push of a frame until the map contains it, as the median and the 99th percentile.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from objslam.config import Odometry, load_settings
from objslam.core.geometry import inverse
from objslam.core.types import Log
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate

_LAP = 120.0
"""The time of a lap, s."""
_MOST_GROWTH = 0.10
"""The largest growth of the memory from the second hour to the last that --check accepts, as a share."""
_MOST_SLOWER = 2.0
"""The largest ratio of the last hour's 99 % latency to the second hour's that --check accepts."""


@dataclass(frozen=True)
class Hour:
    """What was measured at the end of an hour of the robot. resident, journal: MB. median, slow: ms. cpu: s."""

    hour: float
    resident: float
    descriptors: int
    threads: int
    journal: float
    keyframes: int
    objects: int
    median: float
    slow: float
    dropped: int
    cpu: float

    def __str__(self) -> str:
        counts = f"{self.descriptors:6d}{self.threads:9d}{self.journal:12.1f}{self.keyframes:11d}{self.objects:9d}"
        times = f"{self.median:8.1f}{self.slow:8.1f}{self.dropped:9d}{self.cpu:9.1f}"
        return f"{self.hour:6.2f}{self.resident:13.1f}{counts}{times}"


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
            false=0.0,
            localization=None,
            odometry=Odometry(),
        ),
        0,
    )


def drive(session: Session, log: Log, number: int) -> None:
    """Push a lap, each frame after the odometry before it. Lap `number` begins where the one before it ended."""
    odometry, found = log.odometry, log.cameras[0].detections
    assert odometry is not None
    assert found is not None
    step = np.linalg.matrix_power(odometry.poses[-1] @ inverse(odometry.poses[0]), number)
    span = float(odometry.stamps[-1] - odometry.stamps[0]) + float(np.diff(odometry.stamps[:2])[0])
    camera, at = log.cameras[0].camera.name, 0
    poses, stamps = step @ odometry.poses, odometry.stamps + number * span
    starts = np.searchsorted(found.frame, np.arange(len(found.frame_stamps) + 1))
    for index, stamp in enumerate(found.frame_stamps.tolist()):
        until = min(int(np.searchsorted(odometry.stamps, stamp)) + 1, len(stamps))
        for i in range(at, until):
            session.push_odometry(float(stamps[i]), poses[i])
        at = until
        mine = slice(starts[index], starts[index + 1])
        names = [found.label_names[label] for label in found.label[mine].tolist()]
        session.push_detections(stamp + number * span, camera, found.boxes[mine], names, found.scores[mine])
        session.wait()


def measure(session: Session, folder: Path, hours: float, begin: float) -> Hour:
    """The state of this process and of the session."""
    snapshot = session.snapshot()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    journal = sum(file.stat().st_size for file in folder.iterdir())
    return Hour(
        hours,
        pages * os.sysconf("SC_PAGESIZE") / 1e6,
        len(list(Path("/proc/self/fd").iterdir())),
        threading.active_count(),
        journal / 1e6,
        snapshot.keyframes,
        len(snapshot.map.resolved()),
        1e3 * snapshot.update[0],
        1e3 * snapshot.update[1],
        sum(snapshot.dropped.values()),
        time.process_time() - begin,
    )


def judge(rows: list[Hour]) -> list[str]:
    """What grew that should not have, one line each. The first hour is not judged: the map still grows then."""
    settled = [row for row in rows if row.hour >= min(2.0, rows[-1].hour / 2)]
    first, last = settled[0], settled[-1]
    return [
        f"{name} grew from {before:.1f} to {after:.1f}"
        for name, before, after, most in (
            ("resident MB", first.resident, last.resident, 1 + _MOST_GROWTH),
            ("descriptors", first.descriptors, last.descriptors, 1.0),
            ("threads", first.threads, last.threads, 1.0),
            ("99 % latency", first.slow, last.slow, _MOST_SLOWER),
        )
        if after > most * before
    ]


def main() -> int:
    """Print the table, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0, help="the hours that the robot drives")
    parser.add_argument("--odometry", type=float, default=200.0, help="the rate of the odometry, poses per second")
    parser.add_argument("--frames", type=float, default=20.0, help="the rate of the camera, frames per second")
    parser.add_argument("--every", type=float, default=1.0, help="the hours of the robot between two rows")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after this number of CPU seconds")
    parser.add_argument("--check", action="store_true", help="exit code 1 if something grows")
    options = parser.parse_args()
    log, rows = lap(options.odometry, options.frames), list[Hour]()
    print("  hour  resident MB   fds  threads  journal MB  keyframes  objects  p50 ms  p99 ms  dropped    CPU s")
    with tempfile.TemporaryDirectory() as name:
        settings = load_settings(None, ("mode=joint", "rays.pixel_sigma=2"))
        session = Session(settings, Path(name) / "journal.objslam", patient=True).start()
        session.push_camera(log.cameras[0].camera)
        begin, number, due = time.process_time(), 0, options.every
        while session.failure is None and (hours := number * _LAP / 3600) < options.hours:
            if time.process_time() - begin > options.seconds:
                break
            drive(session, log, number)
            number += 1
            if number * _LAP / 3600 >= due - 1e-9:
                due += options.every
                rows.append(measure(session, Path(name), number * _LAP / 3600, begin))
                print(rows[-1], flush=True)
        hours = number * _LAP / 3600
        failure = session.failure
        session.abort()
    print(f"{hours:.2f} hours of the robot" + (f"; the session failed: {failure}" if failure else ""))
    grown = judge(rows) if len(rows) > 2 else []
    for line in grown:
        print(line)
    return int(failure is not None or (options.check and bool(grown)))


if __name__ == "__main__":
    sys.exit(main())
