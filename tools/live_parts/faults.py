"""Faults: sessions that are killed and resumed, and messages in disorder."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from live_parts.common import ONLY_ODOMETRY, QUIET, against_truth, compare, replayed, settings_for
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse
from objslam.core.types import Log
from objslam.io.results.read import load_map
from objslam.live.adapters.replay import events
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate
from objslam.sources.journal.reader import messages
from objslam.sources.log_folder import write_log_folder


def kill(times: int = 20) -> None:
    """Kill a session at random moments, and resume it each time. Compare its map with that of a session that was left
    alone."""
    log = simulate(preset("demo", **ONLY_ODOMETRY, classes=12, frames=400, false=0.0, odometry_rate=100.0), 0)
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        source, out, whole = (Path(folder) / name for name in ("log", "out", "whole"))
        write_log_folder(log, source)
        quiet = [f"--set={change}" for change in (*QUIET, "rays.pixel_sigma=2")]
        command = [sys.executable, "-m", "objslam", "live", str(source), "-o"]
        subprocess.run([*command, str(whole), "--speed", "0", *quiet], check=True, capture_output=True)
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
        both, mine, theirs, rmse, _ = compare(load_map(out), load_map(whole))
        here, there = (list(messages(f, Ledger())) for f in (out, whole))
        print(f"kill -9: {killed} times, {torn} torn records; messages at each kill {sizes[1:]}")
        print(f"messages in the end {len(here)}, unbroken {len(there)}; {both} objects in both, {mine} and {theirs} in one, "
              f"RMSE {rmse:.5f} m", flush=True)  # fmt: skip


def disorder() -> None:
    """Compare each kind of disorder with the same drive in order."""
    log = simulate(preset("demo", **ONLY_ODOMETRY, classes=12, frames=400, false=0.0, odometry_rate=100.0), 0)
    settings = settings_for("rays.pixel_sigma=2")
    session = replayed(log, settings)
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
