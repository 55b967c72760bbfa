"""The pace of a robot: real time, frames that come too fast, and an hour of driving."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import numpy as np

from live_parts.common import ONLY_ODOMETRY, against_truth, replayed, settings_for
from live_parts.undisturbed import Undisturbed
from objslam.core.types import Log
from objslam.live.adapters.replay import ReplayAdapter, events
from objslam.live.session import low_latency
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate


def large(frames: int, rate: float, classes: int = 10) -> Log:
    """200 objects in a hall of 30 x 20 m, 5 boxes a frame, 200 Hz odometry that drifts."""
    return simulate(
        preset(
            "large", **ONLY_ODOMETRY, frames=frames, frame_rate=rate, classes=classes, odometry_rate=200.0, speed=0.8,
            laps=None, max_range=6.0, min_view_share=0.002,
        ),
        1,
    )  # fmt: skip


def realtime(keyframes: int, classes: int) -> None:
    """Push at the pace of the robot, and print how long it takes until a frame is in the map, here and as `Undisturbed`."""
    log = large(int(1.25 * keyframes), 20.0, classes)
    settings = settings_for("rays.pixel_sigma=2")
    boxes = len(log.cameras[0].detections) / len(log.cameras[0].detections.frame_stamps)
    print(f"real time: 200 Hz odometry, 20 Hz frames of {boxes:.1f} boxes, 200 objects of {classes} labels", flush=True)
    session = Session(settings)
    updates: list[float] = []
    count = session.counters.updated
    session.counters.updated = lambda seconds: (updates.append(seconds), count(seconds))[1]  # type: ignore[method-assign]
    undisturbed = Undisturbed(session)
    session.start()
    low_latency.configure()  # as `objslam live` is once the log is read
    stop = threading.Event()
    adapter = ReplayAdapter(session, log, 1.0)
    bringing = threading.Thread(target=adapter.run, args=(stop,))
    bringing.start()
    while bringing.is_alive() and len(updates) < keyframes:
        bringing.join(1.0)
        session.snapshot()
    stop.set()
    bringing.join()
    session.wait()
    last = session.snapshot()
    for name, lags in (("push to updated", updates), ("on a core of its own", undisturbed.lags)):
        ms = 1e3 * np.array(lags)
        tenth = len(ms) // 10
        p50, p95, p99, rare = np.percentile(ms, [50, 95, 99, 99.9])
        first, final = np.percentile(ms[:tenth], 95), np.percentile(ms[-tenth:], 95)
        print(
            f"{len(ms)} keyframes: {name} p50 {p50:.1f} ms, p95 {p95:.1f} ms, p99 {p99:.1f} ms, p99.9 {rare:.1f} ms, "
            f"max {ms.max():.0f} ms; p95 of the first tenth {first:.1f} ms, of the last {final:.1f} ms: "
            f"{final / first:.1f} times"
        )
    print(f"dropped {last.dropped or 'nothing'}; {session.counters.accepted()}; {against_truth(last.map, log)}", flush=True)
    session.abort()


def overload() -> None:
    """Push frames five times as fast as a session can process them. They come from a robot at its own speed, and then from
    one that is that much faster."""
    drive = {**ONLY_ODOMETRY, "classes": 12, "false": 0.0}
    log = simulate(preset("demo", **drive, frames=3000, frame_rate=10.0), 0)
    settings = settings_for("rays.pixel_sigma=2", "live.keyframe_distance=0", "live.keyframe_angle_deg=0")
    begin = time.perf_counter()
    session = replayed(log, settings)
    one = (time.perf_counter() - begin) / 3000
    session.abort()
    rate = 5 / one
    print(f"overload: a frame takes {1e3 * one:.1f} ms, they come every {1e3 / rate:.1f} ms")
    flood = simulate(preset("demo", **drive, frames=int(40 * rate), frame_rate=rate), 0)
    for name, given, speed in (("a flood of frames", flood, 1.0), ("a hasty robot", log, rate / 10.0)):
        session, lags, stop = Session(settings).start(), list[float](), threading.Event()
        update = session.counters.updated
        session.counters.updated = lambda seconds: (lags.append(seconds), update(seconds))[1]  # type: ignore[method-assign] # noqa: B023
        begin = time.perf_counter()
        ReplayAdapter(session, given, speed).run(stop)
        took = time.perf_counter() - begin
        session.wait()
        last = session.snapshot()
        frames = len(given.cameras[0].detections.frame_stamps)
        print(
            f"{name}: one every {1e3 * took / frames:.2f} ms for {took:.0f} s; lag max {max(lags):.3f} s; {len(lags)} "
            f"keyframes; dropped {last.dropped}; {against_truth(last.map, given)}",
            flush=True,
        )
        session.abort()


def memory(minutes: int) -> None:
    """Push an hour of driving as fast as possible, and print the resident size along the way."""
    lap = preset("demo", **ONLY_ODOMETRY, frames=600 * minutes, frame_rate=10.0, odometry_rate=200.0, classes=4)
    log = simulate(lap, 0)
    session = Session(settings_for("rays.pixel_sigma=2")).start()
    session.push_camera(log.cameras[0].camera)
    begin, first, due = time.perf_counter(), None, 0.0
    sizes: list[tuple[float, float]] = []
    for stamp, frame, push in events(log):
        first = stamp if first is None else first
        push(session)
        if frame:
            session.wait()
        if stamp - first >= due:
            due += 60.0
            session.snapshot()
            sizes.append(((stamp - first) / 60, _resident()))
            if len(sizes) % 5 == 1:
                print(
                    f"  {sizes[-1][0]:5.0f} min {sizes[-1][1]:7.1f} MB, {session.snapshot().keyframes} keyframes", flush=True
                )
    late = np.array([s for s in sizes if s[0] >= minutes / 6])
    slope = np.polyfit(late[:, 0] / 60, late[:, 1], 1)[0]
    took = time.perf_counter() - begin
    print(
        f"memory: {sizes[-1][1]:.0f} MB after {minutes} min, {slope:+.1f} MB/h from minute {minutes / 6:.0f} on; "
        f"{took:.0f} s"
    )
    print(
        f"{against_truth(session.snapshot().map, log)}; {session.counters.accepted()}; dropped {session.counters.dropped()}"
    )
    session.abort()


def _resident() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
