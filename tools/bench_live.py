"""Whether the map while the robot drives keeps up, agrees with offline, and survives what robots do.

    python tools/bench_live.py [--parts realtime same overload kill disorder memory] [--minutes 60]

realtime: 200 Hz odometry and 20 Hz frames of 5 boxes, pushed at that pace until there are 10,000 keyframes (9 minutes).
same: the final map, and the last one before the end, against offline `run --mode joint` on the same data: ten simulated
drives, and UTIAS MRCLAM 6 robots 1, 3, 5 from the folder in OBJSLAM_DATA. overload: frames five times as fast as they can be
worked in. kill: twenty sessions killed with signal 9 at random moments and resumed. disorder: late, repeated and swapped
messages, a clock that jumps, odometry that starts anew. memory: an hour at 200 Hz and 10 Hz, as fast as possible.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from objslam.config import Odometry, Settings, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import align, inverse
from objslam.core.object_map import ObjectMap
from objslam.core.types import Log
from objslam.live.adapters.replay import ReplayAdapter, events
from objslam.live.session import low_latency
from objslam.live.session.session import Session
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate
from objslam.sources import SourceOptions, read

ONLY_ODOMETRY = {"localization": None, "odometry": Odometry()}
QUIET = ("output.recording=false", "output.picture=false")
LABELS = {**ONLY_ODOMETRY, "objects": 12, "classes": 12, "false": 0.0}
DRIVES = (
    *(("demo, localised", "demo", {}, seed) for seed in range(3)),
    *(("demo, odometry", "demo", ONLY_ODOMETRY, seed) for seed in range(3)),
    *(("demo, odometry, own labels", "demo", LABELS, seed) for seed in range(2)),
    *(("drift", "drift", {}, seed) for seed in range(2)),
)


def settings_for(*changes: str) -> Settings:
    return load_settings(None, ("mode=joint", *QUIET, *changes))


def replayed(log: Log, settings: Settings) -> tuple[Session, threading.Event]:
    """A session that has been fed a whole log, as fast as it takes it."""
    session = Session(settings, patient=True).start()
    ReplayAdapter(session, log, None, session.wait).run(threading.Event())
    session.wait()
    return session, threading.Event()


def compare(a: ObjectMap, b: ObjectMap, radius: float = 1.0) -> tuple[int, int, int, float, float]:
    """Objects of both maps, those of either alone, and the RMSE, m, as the maps lie and after SE(2) alignment."""
    one, two = a.resolved(), b.resolved()
    gap = np.array([[np.linalg.norm(p.position - q.position) if p.label == q.label else 99.0 for q in two] for p in one])
    gap = gap.reshape(len(one), len(two))
    i, j = linear_sum_assignment(np.minimum(gap, 2 * radius))
    same = gap[i, j] < radius
    both = int(same.sum())
    if not both:
        return 0, len(one), len(two), np.nan, np.nan
    mine, theirs = (np.array([m[k].position for k in which[same].tolist()]) for m, which in ((one, i), (two, j)))
    pose, _ = align(mine, theirs, "se2")
    laid = mine @ pose[:3, :3].T + pose[:3, 3]
    rmse, aligned = (float(np.sqrt(((x - theirs) ** 2).sum(axis=1).mean())) for x in (mine, laid))
    return both, len(one) - both, len(two) - both, rmse, aligned


def against_truth(found: ObjectMap, log: Log) -> str:
    """Objects found, missed, false, and RMSE after SE(2) alignment."""
    truth = log.truth.objects
    one = found.resolved()
    place = np.array([o.position for o in one]).reshape(-1, 3)
    true = np.array([o.position for o in truth])
    for _ in range(2):
        gap = np.linalg.norm(place[:, None] - true, axis=2)
        gap[np.array([[o.label != t.label for t in truth] for o in one]).reshape(gap.shape)] = 99.0
        i, j = linear_sum_assignment(np.minimum(gap, 3.0))
        good = gap[i, j] < 1.5
        pose, _ = align(place[i[good]], true[j[good]], "se2")
        place = place @ pose[:3, :3].T + pose[:3, 3]
    error = np.linalg.norm(place[i[good]] - true[j[good]], axis=1)
    rmse = np.sqrt(np.mean(error**2)) if len(error) else np.nan
    return f"{good.sum()} of {len(truth)} objects, {len(one) - good.sum()} false, RMSE {rmse:.3f} m"


def same() -> None:
    """Live against offline."""
    print("the same answer: live against offline joint; objects of both, of one alone, RMSE of those of both")
    print(
        f"{'drive':<28}{'both':>6}{'live':>6}{'offline':>9}{'RMSE m':>9}{'aligned':>9}{'before the end':>18}{'live s':>8}"
        f"{'offline s':>11}"
    )
    simulated = settings_for("rays.pixel_sigma=2")
    jobs = [(f"{what} {seed}", simulate(preset(name, **changes), seed), simulated) for what, name, changes, seed in DRIVES]
    folder = os.environ.get("OBJSLAM_DATA")
    if folder and (Path(folder) / "mrclam_ds6").is_dir():
        for robot in (1, 3, 5):
            for with_range in (True, False):
                options = SourceOptions(robot=robot, with_range=with_range)
                log = read(Path(folder) / "mrclam_ds6", Ledger(), options)
                jobs.append((f"MRCLAM {robot} {'with range' if with_range else 'bearings'}", log, settings_for()))
    else:
        print("SKIPPED MRCLAM: OBJSLAM_DATA names no folder with mrclam_ds6", file=sys.stderr)
    for name, log, settings in jobs:
        begin = time.perf_counter()
        session, _ = replayed(log, settings)
        last = session.snapshot().map
        live = session.stop()
        between = time.perf_counter()
        reference = pipeline.run(log, settings, Ledger())
        end = time.perf_counter()
        both, mine, theirs, rmse, aligned = compare(live.map, reference.map)
        also, more, fewer, error, _ = compare(last, reference.map)
        before = f"{also} +{more} -{fewer} {error:.3f}"
        print(
            f"{name:<28}{both:6d}{mine:6d}{theirs:9d}{rmse:9.3f}{aligned:9.3f}{before:>18}{between - begin:8.1f}"
            f"{end - between:11.1f}",
            flush=True,
        )


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
    """Pushed at the pace of the robot: how long until a frame is in the map."""
    log = large(int(1.25 * keyframes), 20.0, classes)
    settings = settings_for("rays.pixel_sigma=2")
    boxes = len(log.cameras[0].detections) / len(log.cameras[0].detections.frame_stamps)
    print(f"real time: 200 Hz odometry, 20 Hz frames of {boxes:.1f} boxes, 200 objects of {classes} labels", flush=True)
    session = Session(settings)
    updates: list[float] = []
    count = session.counters.updated
    session.counters.updated = lambda seconds: (updates.append(seconds), count(seconds))[1]  # type: ignore[method-assign]
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
    ms = 1e3 * np.array(updates)
    tenth = len(ms) // 10
    p50, p95, p99 = np.percentile(ms, [50, 95, 99])
    first, final = np.percentile(ms[:tenth], 95), np.percentile(ms[-tenth:], 95)
    print(
        f"{len(ms)} keyframes: push to updated p50 {p50:.1f} ms, p95 {p95:.1f} ms, p99 {p99:.1f} ms, max {ms.max():.0f} ms"
    )
    print(f"p95 of the first tenth {first:.1f} ms, of the last {final:.1f} ms: {final / first:.1f} times")
    print(f"dropped {last.dropped or 'nothing'}; {session.counters.accepted()}; {against_truth(last.map, log)}", flush=True)
    session.abort()


def overload() -> None:
    """Frames five times as fast as they can be worked in: from a robot at its own speed, and from one that much faster."""
    drive = {**ONLY_ODOMETRY, "classes": 12, "false": 0.0}
    log = simulate(preset("demo", **drive, frames=3000, frame_rate=10.0), 0)
    settings = settings_for("rays.pixel_sigma=2", "live.keyframe_distance=0", "live.keyframe_angle_deg=0")
    begin = time.perf_counter()
    session, _ = replayed(log, settings)
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


def kill(times: int = 20) -> None:
    """Killed at random moments, resumed each time; against a session that was left alone."""
    log = simulate(preset("demo", **ONLY_ODOMETRY, classes=12, frames=400, false=0.0, odometry_rate=100.0), 0)
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        source, out, whole = (Path(folder) / name for name in ("log", "out", "whole"))
        from objslam.sources.log_folder import write_log_folder

        write_log_folder(log, source)
        quiet = [f"--set={change}" for change in (*QUIET, "rays.pixel_sigma=2")]
        command = [sys.executable, "-m", "objslam", "live", str(source), "-o"]
        subprocess.run([*command, str(whole), "--speed", "0", *quiet], check=True, capture_output=True)
        from objslam.sources.journal.reader import messages

        done, killed, torn, length, sizes = False, 0, 0, 0, [0]
        while not done:
            resume = ["--resume"] if (out / "journal.objslam").exists() else []
            process = subprocess.Popen(
                [*command, str(out), "--speed", "5" if killed < times else "0", *resume, *quiet], stderr=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )  # fmt: skip
            if killed < times:
                wait, file = time.monotonic() + 60, out / "journal.objslam"
                while time.monotonic() < wait and not (file.exists() and file.stat().st_size > length):
                    time.sleep(0.02)
                time.sleep(float(rng.uniform(0.0, 1.5)))
                if process.poll() is None:
                    os.kill(process.pid, signal.SIGKILL)
                    killed += 1
                process.wait()
                length = file.stat().st_size
                ledger = Ledger()
                found = sum(1 for _ in messages(out, ledger))
                torn += bool(ledger.dropped)
                assert found >= sizes[-1], "messages were lost"
                sizes.append(found)
                if process.returncode == 0:
                    done = True
            else:
                assert process.wait() == 0
                done = True
        from objslam.results.read import load_map

        both, mine, theirs, rmse, _ = compare(load_map(out), load_map(whole))
        here, there = (list(messages(f, Ledger())) for f in (out, whole))
        print(f"kill -9: {killed} times, {torn} torn records; messages at each kill {sizes[1:]}")
        print(f"messages in the end {len(here)}, unbroken {len(there)}; {both} objects in both, {mine} and {theirs} in one, "
              f"RMSE {rmse:.5f} m", flush=True)  # fmt: skip


def disorder() -> None:
    """Each kind of disorder, against the same drive in order."""
    log = simulate(preset("demo", **ONLY_ODOMETRY, classes=12, frames=400, false=0.0, odometry_rate=100.0), 0)
    settings = settings_for("rays.pixel_sigma=2")
    session, _ = replayed(log, settings)
    clean = session.stop().map
    pushes = list(events(log))
    print(f"in order: {against_truth(clean, log)}")
    for name, changed in (
        ("late and swapped", _swapped(pushes)),
        ("repeated", [p for push in pushes for p in (push, push)]),
        ("clock + 10 s", None),
        ("clock - 10 s", None),
        ("odometry to zero", None),
        ("rubbish", None),
    ):
        session = Session(settings).start()
        session.push_camera(log.cameras[0].camera)
        if changed is not None:
            for _, frame, push in changed:
                push(session)
                if frame:
                    session.wait()
        else:
            _disturbed(session, log, name)
        session.wait()
        dropped, accepted = session.counters.dropped(), session.counters.accepted()
        found = session.stop().map
        both, mine, theirs, rmse, _ = compare(found, clean)
        events_ = {k: v for k, v in accepted.items() if k not in ("odometry", "frames", "boxes", "cameras", "notes")}
        print(f"{name}: {against_truth(found, log)}; against in order {both} +{mine} -{theirs}, {rmse:.3f} m")
        print(f"    dropped {dropped}; {events_}", flush=True)


def _swapped(pushes: list) -> list:  # type: ignore[type-arg]
    rng = np.random.default_rng(1)
    at = np.arange(len(pushes)) + np.where(rng.random(len(pushes)) < 0.1, rng.integers(0, 40, len(pushes)), 0)
    return [pushes[i] for i in np.argsort(at, kind="stable")]


def _disturbed(session: Session, log: Log, name: str) -> None:
    middle = log.odometry.stamps[len(log.odometry.stamps) // 2]
    shift = {"clock + 10 s": 10.0, "clock - 10 s": -10.0}.get(name, 0.0)
    reset = np.eye(4)
    before = log.odometry.poses[np.searchsorted(log.odometry.stamps, middle) - 1]
    if name == "odometry to zero":
        reset = inverse(before)
    moved = np.where(log.odometry.stamps >= middle, shift, 0.0)
    detections = log.cameras[0].detections
    rng = np.random.default_rng(2)
    order = np.argsort(np.concatenate([log.odometry.stamps, detections.frame_stamps + 1e-6]), kind="stable")
    count = len(log.odometry.stamps)
    for i in order.tolist():
        if i < count:
            pose = log.odometry.poses[i]
            pose = reset @ pose if log.odometry.stamps[i] >= middle else pose
            session.push_odometry(float(log.odometry.stamps[i] + moved[i]), pose)
            if name == "rubbish" and rng.random() < 0.05:
                session.push_odometry(float(log.odometry.stamps[i]), np.full((4, 4), np.nan))
                session.push_odometry(float("nan"), pose)
                session.push_odometry(float(log.odometry.stamps[i]), "pose")  # type: ignore[arg-type]
            continue
        f = i - count
        mine = detections.frame == f
        labels = [detections.label_names[k] for k in detections.label[mine]]
        stamp = float(detections.frame_stamps[f])
        at = stamp + (shift if stamp >= middle else 0.0)
        session.push_detections(at, log.cameras[0].camera.name, detections.boxes[mine], labels, detections.scores[mine])
        if name == "rubbish":
            session.push_detections(at + 0.01, "nobody", detections.boxes[mine], labels, detections.scores[mine])
            session.push_detections(at + 0.02, log.cameras[0].camera.name, np.full((1, 4), np.nan), ["cup"], np.ones(1))
            session.push_detections(at + 0.03, log.cameras[0].camera.name, np.zeros((3, 4)), ["cup"], np.ones(1))
        session.wait()


def memory(minutes: int) -> None:
    """An hour of driving, as fast as possible: resident size along the way."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("realtime", "same", "overload", "kill", "disorder", "memory")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--keyframes", type=int, default=10_000)
    parser.add_argument("--classes", type=int, default=10)
    arguments = parser.parse_args()
    low_latency.configure()
    for part in arguments.parts:
        if part == "realtime":
            realtime(arguments.keyframes, arguments.classes)
        elif part == "memory":
            memory(arguments.minutes)
        else:
            {"same": same, "overload": overload, "kill": kill, "disorder": disorder}[part]()


if __name__ == "__main__":
    main()
