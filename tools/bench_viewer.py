"""Measure what the viewer costs a run and a session.

python tools/bench_viewer.py [LOG ...] [--mode joint] [--set KEY=VALUE ...] [--skip-live]

The time and the size of the recording of a run, per keyframe, are compared with logging each entity of each keyframe one by
one. Each time is the best of several repetitions. Without a LOG, the run maps a simulated drive of 15 minutes without
images. Then a session with a viewer that works, hangs or is killed is compared with a session without a viewer.
"""

from __future__ import annotations

import argparse
import dataclasses
import signal
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from one_line import end_with

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.snapshot import Snapshot
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.live.session import low_latency
from objslam.mapping import pipeline
from objslam.output.plot.style import ray_ends
from objslam.output.viewer import application
from objslam.output.viewer.cameras import box_colours
from objslam.output.viewer.live.live_view import LiveView
from objslam.output.viewer.rays import kind_colours
from objslam.output.viewer.recording import write_recording
from objslam.simulation import preset, simulate
from objslam.sources import read

REPEAT = 3
LIVE_SECONDS = 5.0
WORK = 20_000  # of a step that stands for a session's: it holds the interpreter, as much of a session's work does


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", type=Path)
    parser.add_argument("--mode", default="joint")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--skip-live", action="store_true")
    options = parser.parse_args()
    settings = load_settings(None, (f"mode={options.mode}", "reconstruction.use=false", *options.set))
    result: RunResult | None = None
    for log in [read(path, Ledger()) for path in options.logs] or [long_drive()]:
        result = pipeline.run(log, settings, Ledger())
        print(f"\n{log.name}: {len(result.keyframes)} keyframes, {len(result.rays)} rays, {images_of(result)} images")
        row("recording", *best(result, lambda r, f: write_recording(r, f)), len(result.keyframes))
        if images_of(result):
            bare = dataclasses.replace(result, images=())
            row("  without images", *best(bare, lambda r, f: write_recording(r, f)), len(result.keyframes))
        row("  one by one", *best(result, one_by_one), len(result.keyframes))
    if not options.skip_live and result is not None:
        live(result)


def long_drive() -> Log:
    return simulate(preset("demo", frames=4500, laps=20), 0)


def images_of(result: RunResult) -> int:
    return sum(len(images.paths) for images in result.images if images is not None)


def best(result: RunResult, write: Any) -> tuple[float, int]:
    """The shortest time, s, and the size of the file, bytes."""
    seconds, size = [], 0
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(REPEAT):
            file = Path(folder) / "a.rrd"
            start = time.perf_counter()
            write(result, file)
            seconds.append(time.perf_counter() - start)
            size = file.stat().st_size
    return min(seconds), size


def row(name: str, seconds: float, size: int, keyframes: int) -> None:
    print(
        f"{name:18s} {seconds:7.3f} s  {1e3 * seconds / keyframes:7.3f} ms a keyframe  "
        f"{size / 1e6:6.2f} MB  {size / 1e3 / keyframes:6.2f} kB a keyframe"
    )


def one_by_one(result: RunResult, file: Path) -> None:
    """The alternative: rays, boxes and pose alone, each logged at each keyframe with `log`."""
    import rerun as rr

    recording = rr.RecordingStream("bench")
    recording.save(str(file))
    strips = np.stack([result.origins, ray_ends(result)], axis=1).astype(np.float32)
    colours, of_boxes, box = kind_colours(result), box_colours(result), result.rays.box
    first = np.searchsorted(result.rays.keyframe, np.arange(len(result.keyframes) + 1))
    for k, stamp in enumerate(result.keyframes.stamps):
        recording.set_time("stamp", duration=stamp)
        mine = slice(first[k], first[k + 1])
        pose = result.map_T_base[k]
        recording.log("map/base", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        recording.log("map/rays/now", rr.LineStrips3D(list(strips[mine]), colors=colours[mine]))
        half = (box[mine, 2:] - box[mine, :2]) / 2
        recording.log("map/camera/boxes", rr.Boxes2D(centers=box[mine, :2] + half, half_sizes=half, colors=of_boxes[mine]))
    recording.flush()
    recording.disconnect()


def live(result: RunResult) -> None:
    """Work like a session that shows ten snapshots a second to a viewer: one that works, is frozen or is killed, or none."""
    low_latency.configure()  # as `objslam live` is
    print(f"\nlive: {LIVE_SECONDS:g} s each, snapshots of {len(result.map)} objects ten times a second")
    path = Trajectory(
        *(a[np.unique(result.keyframes.stamps, return_index=True)[1]] for a in (result.keyframes.stamps, result.map_T_base))
    )
    snapshot = Snapshot(float(path.stamps[-1]), result.map, path, len(path))
    for how in ("well", "frozen", "killed"):
        port = application.free_port()
        viewer = application.start_listening(port, "--serve-grpc", "--port", str(port))
        view = LiveView(address=application.address(port))
        view.show(snapshot)
        while not view.shown:
            time.sleep(0.05)
        if how == "frozen":
            viewer.send_signal(signal.SIGSTOP)
        if how == "killed":
            viewer.kill()
            viewer.wait()
        without = session(None, snapshot)  # each time: other programs come and go
        with_view = session(view, snapshot)
        start = time.perf_counter()
        view.close(timeout=1.0)
        closing = time.perf_counter() - start
        print(
            f"{how:8s} of that without: CPU a step {with_view.cpu / without.cpu:.3f}, "
            f"steps a second {with_view.steps / without.steps:.2f}; "
            f"show() median {1e3 * np.median(with_view.took):.3f} ms, p99 {1e3 * np.quantile(with_view.took, 0.99):.3f} ms, "
            f"longest {1e3 * with_view.took.max():.3f} ms; shown {view.shown}, dropped {view.dropped}; "
            f"closed in {closing:.2f} s"
        )
        viewer.kill()
        viewer.wait()


@dataclass(frozen=True)
class Session:
    """steps: per second. cpu: s per step, of this process with all its threads. took: (N,) s, the time of each `show`."""

    steps: float
    cpu: float
    took: np.ndarray


def session(view: LiveView | None, snapshot: Snapshot) -> Session:
    """Work for a while, with or without a view."""
    began, cpu, due, steps, took = time.perf_counter(), time.process_time(), 0.0, 0, [0.0]
    while (now := time.perf_counter() - began) < LIVE_SECONDS:
        sum(range(WORK))
        steps += 1
        if view is not None and now >= due:
            due += 0.1
            start = time.perf_counter()
            view.show(snapshot)
            took.append(time.perf_counter() - start)
    return Session(steps / LIVE_SECONDS, (time.process_time() - cpu) / steps, np.array(took))


if __name__ == "__main__":
    end_with(main)
