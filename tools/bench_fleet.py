"""What a fleet costs beside its runs: whether the processes are busy, and how the driver grows.

    python tools/bench_fleet.py run --logs 24 --jobs 1 2                # real tasks on processes of this machine
    python tools/bench_fleet.py run --logs 24 --jobs --ray ADDRESS      # on a cluster: PYTHONPATH=tools ray start ...
    python tools/bench_fleet.py driver --logs 100 1000 10000            # simulated task results

`run` tells for each engine the share of its slots' time in which a task ran (occupancy), and the parts of a log: the pause
of a process before its next task, which is what the engine costs, the upload of the result, and the writing of the record.
The last two are parts of the task. The CPU time of first tasks and later ones shows what a process imports once. On a
machine that does other things as well, the share is still right, because both parts of it wait alike. At the end it tells
whether all engines made the same bytes. `--folder` keeps logs and results, and takes the logs that are there. `driver` finds
the logs, takes simulated results from an engine that computes nothing, merges nothing, and writes tables and page; then it
runs once more with nothing to do. Each size is a process of its own, which tells its CPU time and its most memory.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from objslam import __version__
from objslam.config import Settings
from objslam.config.settings import change_settings
from objslam.core.geometry import lift_se2
from objslam.fleet.driver import run_fleet
from objslam.fleet.engines.local_engine import Answer, Engine, local_engine
from objslam.fleet.engines.worker import Limits
from objslam.fleet.job import make_job
from objslam.fleet.keys import key_of
from objslam.fleet.logs import Layout, find_logs
from objslam.fleet.page import PAGE, fleet_page
from objslam.fleet.record import Parameter, Record, record_name, seen_name
from objslam.fleet.stores.open_store import open_store
from objslam.fleet.stores.store import Store
from objslam.fleet.tasks import map_task
from objslam.fleet.tasks.map_task import MapTask
from objslam.fleet.tasks.merge_task import MergeTask
from objslam.fleet.tasks.site_task import SiteResult, SiteTask
from objslam.io.results.files import SUMMARY, dump_json
from objslam.mapping.localization import moved_log
from objslam.simulation import preset, simulate
from objslam.sources import SourceOptions
from objslam.sources.log_folder import write_log_folder

LAYOUT = Layout("{site}/{robot}/{log}", "site")
SITES, ROBOTS = 3, 10


def write_logs(folder: Path, count: int) -> None:
    """Write simulated drives of three places, each in a frame of its own."""
    truths = [simulate(preset("demo", objects=14), 50 + site).truth for site in range(SITES)]
    for k in range(count):
        truth = truths[k % SITES]
        assert truth is not None
        placed = tuple((o.label, tuple(o.position)) for o in truth.objects)
        log = simulate(preset("demo", objects=0, placed=placed), 1000 + k)
        log = replace(moved_log(log, lift_se2(np.random.default_rng(k).uniform(-5, 5, 3))), truth=None)
        write_log_folder(log, folder / f"site_{k % SITES}" / f"robot_{k % ROBOTS}" / f"log_{k:05d}")


class TimedStore:
    """A store that counts the seconds of its calls."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self.spent = {"upload": 0.0, "write": 0.0}

    def __getattr__(self, name: str) -> Any:
        call = getattr(self._store, name)
        if name not in self.spent:
            return call

        def timed(*given: Any) -> Any:
            begin = time.monotonic()
            try:
                return call(*given)
            finally:
                self.spent[name] += time.monotonic() - begin

        return timed


@dataclass(frozen=True)
class Timed:
    """A task that ran. process: its number. begin, end: s of a clock that the processes of a machine share. cpu: s.

    upload, write: the seconds of the result, and of the record with its mark in `seen`.
    """

    process: int
    begin: float
    end: float
    cpu: float
    upload: float
    write: float
    error: str


def map_timed(task: MapTask) -> Timed:
    """Map one log as the task of a fleet does, and time the parts. Engines call this in their processes."""
    begin, cpu = time.monotonic(), time.process_time()
    store = TimedStore(open_store(task.job.store))
    map_task.open_store = lambda url: store  # type: ignore[assignment]
    error = map_task.map_one(task).error
    used = time.process_time() - cpu
    return Timed(os.getpid(), begin, time.monotonic(), used, store.spent["upload"], store.spent["write"], error)


def bench_run(count: int, jobs: list[int], address: str | None, folder: Path) -> None:
    """Print what each engine does with the same logs."""
    settings = change_settings(Settings(), {"output.recording": False})
    if not (folder / "logs").exists():
        write_logs(folder / "logs", count)
    logs = find_logs([f"{folder}/logs"], LAYOUT)[:count]
    engines: list[tuple[str, int, Engine]] = [(f"jobs_{n}", n, local_engine(n, Limits())) for n in jobs]
    if address is not None:
        from objslam.fleet.engines.ray_engine import join_cluster, ray_engine

        slots = int(join_cluster(address).cpus)
        engines.append((f"ray_{slots}", slots, ray_engine(Limits(), most=0, memory=0, gpus=0.0)))
    print("                       pause before a task, ms  upload, ms  record, ms      task, CPU s       driver, CPU ms")
    print("engine   logs  occupancy    median     mean       median      median     first   median   at most    a log")
    made = []
    for name, slots, engine in engines:
        job = make_job(str(folder / name), settings, SourceOptions(), None, report=False)
        tasks = [MapTask(job, log.path, key_of(log.fingerprint, job.digest)) for log in logs]
        own = time.process_time()
        done: list[Timed] = [answer.value for answer in engine(f"{Path(__file__).stem}:map_timed", tasks)]
        own = time.process_time() - own
        assert not [one.error for one in done if one.error]
        print(_row(name, slots, sorted(done, key=lambda one: one.begin), 1000 * own / count), flush=True)
        made.append(_hashes(folder / name / "results"))
    print(f"{len(made[0])} files of results, {'the same bytes' if all(one == made[0] for one in made) else 'OTHER BYTES'}")


def _row(name: str, slots: int, done: list[Timed], own: float) -> str:
    """Return the line of an engine. done: in the order of time. own: the CPU time of the driver, ms a log."""
    took = max(one.end for one in done) - done[0].begin  # The start of the processes is not a cost of a log.
    busy = sum(one.end - one.begin for one in done) / (slots * took)
    last: dict[int, Timed] = {}
    pauses, first, later = [], [], []
    for one in done:
        if one.process in last:
            pauses.append(1000 * (one.begin - last[one.process].end))
        (later if one.process in last else first).append(one.cpu)
        last[one.process] = one
    upload, write = (1000 * float(np.median([getattr(one, part) for one in done])) for part in ("upload", "write"))
    cpu = f"{np.mean(first):9.2f}{np.median(later):9.2f}{np.max(later):10.2f}"
    return (
        f"{name:<7}{len(done):6d}{busy:11.3f}{np.median(pauses):10.1f}{np.mean(pauses):9.1f}{upload:13.1f}{write:12.1f} "
        f"{cpu}{own:9.1f}"
    )


def _hashes(folder: Path) -> dict[str, str]:
    """Return the hash of each file. The seconds in a summary do not count."""

    def content(file: Path) -> bytes:
        data = file.read_bytes()
        return dump_json({**json.loads(data), "seconds": None}).encode() if file.name == SUMMARY else data

    files = (file for file in sorted(folder.rglob("*")) if file.is_file())
    return {str(file.relative_to(folder)): sha256(content(file)).hexdigest() for file in files}


def simulated(store_url: str) -> Engine:
    """Return an engine that computes nothing: each log has a result, each merge and each site is done."""

    def write(name: str, data: bytes) -> None:
        """Write as a worker does, but without waiting for the disk."""
        file = Path(store_url, name)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)

    names = ("front.clock", "front.roll", "front.tilt", "front.yaw")

    def record(task: MapTask) -> Record:
        number = int(task.path.rpartition("_")[2])
        calibration = tuple(Parameter(name, number * 1e-6, 1e-3, "rad", True) for name in names)
        more: dict[str, Any] = {"begin": 1.7e9 + 3600 * number, "end": 1.7e9 + 3600 * number + 60, "mode": "fixed"}
        counts = {"objects": 14, "unresolved": 0, "keyframes": 349, "rays": 973, "detections": 981}
        key = key_of(task.path)
        found = Record(key, task.path, key, "settings", __version__, verdict="good", counts=counts, **more)
        found = replace(found, calibration=calibration, warnings=("a warning",), seconds=1.0, cpu=1.0, memory=3 * 10**8)
        write(record_name(key), found.dump())
        write(seen_name(task.task, key, True), b"")
        return found

    def run(work: str, arguments: Iterable[Any]) -> Iterator[Answer]:
        for one in arguments:
            if isinstance(one, MapTask):
                yield Answer(one, record(one))
            elif isinstance(one, MergeTask):
                write(f"merges/{one.node.key}.json", b"[]")
                yield Answer(one, 1)
            elif isinstance(one, SiteTask):
                yield Answer(one, SiteResult(one.site, 1, len(one.members), 14, 0, True))

    return run


def bench_driver(count: int) -> None:
    """Print the CPU time and the memory of the driver of one size, in this process."""
    with tempfile.TemporaryDirectory() as folder:
        for k in range(count):
            log = Path(folder, "logs", f"site_{k % SITES}", f"robot_{k % ROBOTS}", f"log_{k}")
            log.mkdir(parents=True)
            for name in ("odometry.txt", "camera.yaml", "detections.jsonl"):
                (log / name).touch()
        out = f"{folder}/out"
        for again in (False, True):
            begin = time.process_time()
            logs = find_logs([f"{folder}/logs"], LAYOUT)
            found_at = time.process_time()
            engine = simulated(out)
            job = make_job(out, Settings(), SourceOptions(), None, report=False)
            found = run_fleet(job, logs, engine)
            open_store(out).write(PAGE, fleet_page(found, price=0.05))
            end = time.process_time()
            assert (len(found.mapped), found.new) == (count, 0 if again else count)
            most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            name = "again" if again else "first"
            print(
                f"{count:6d}  {name}  {1000 * (found_at - begin) / count:12.3f}  {1000 * (end - found_at) / count:11.3f}  "
                f"{most:11.0f}",
                flush=True,
            )


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_subparsers(dest="what", required=True)
    run = what.add_parser("run")
    run.add_argument("--logs", type=int, default=24)
    run.add_argument("--jobs", type=int, nargs="*", default=[1, 2])
    run.add_argument("--ray", metavar="ADDRESS")
    run.add_argument("--folder", type=Path, help="keeps logs and results")
    driver = what.add_parser("driver")
    driver.add_argument("--logs", type=int, nargs="+", default=[100, 1000, 10000])
    given = parser.parse_args()
    if given.what == "run":
        os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
        with tempfile.TemporaryDirectory() as folder:
            bench_run(given.logs, given.jobs, given.ray, given.folder or Path(folder))
    elif len(given.logs) == 1:
        bench_driver(given.logs[0])
    else:
        print(
            "  logs  run    finding, ms  the rest, ms  most memory, MB   (CPU time of the driver for each log)", flush=True
        )
        for count in given.logs:
            subprocess.run([sys.executable, __file__, "driver", "--logs", str(count)], check=True)


if __name__ == "__main__":
    main()
