"""What a fleet costs beside its runs: whether the processes are busy, and how the driver grows.

    python tools/bench_fleet.py run --logs 24 --jobs 1 2        # real tasks on processes of this machine
    python tools/bench_fleet.py run --logs 24 --ray ADDRESS     # and on a cluster
    python tools/bench_fleet.py driver --logs 100 1000 10000    # simulated task results

`run` tells for each engine the share of its slots' time in which a task ran (occupancy), the time of a slot beside its task
for each log, and what the first task of a process costs more than the rest. On a machine that does other things as well, the
share is still right, because both parts of it wait alike. `driver` finds the logs, takes simulated results from an engine
that computes nothing, merges nothing, and writes tables and page; then it runs once more with nothing to do. Each size is a
process of its own, which tells its CPU time and its most memory.
"""

from __future__ import annotations

import argparse
import math
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
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
from objslam.fleet.tasks import map_task
from objslam.fleet.tasks.map_task import MapTask
from objslam.fleet.tasks.merge_task import MergeTask
from objslam.fleet.tasks.site_task import SiteResult, SiteTask
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


def bench_run(count: int, jobs: list[int], address: str | None) -> None:
    """Print what each engine does with the same logs."""
    settings = change_settings(Settings(), {"output": {"recording": False, "picture": False}})
    with tempfile.TemporaryDirectory() as folder:
        write_logs(Path(folder, "logs"), count)
        logs = find_logs([f"{folder}/logs"], LAYOUT)
        engines: list[tuple[str, int, Engine]] = [(f"--jobs {n}", n, local_engine(n, Limits())) for n in jobs]
        if address is not None:
            from objslam.fleet.engines.ray_engine import join_cluster, ray_engine

            cluster = join_cluster(address)
            engines.append(("--ray", int(cluster.cpus), ray_engine(Limits(), most=0, memory=0, gpus=0.0)))
        print("engine     logs  occupancy  beside a task, ms  first tasks, CPU s  other tasks, CPU s  driver, CPU ms a log")
        for number, (name, slots, engine) in enumerate(engines):
            job = make_job(f"{folder}/out_{number}", settings, SourceOptions(), None, report=False)
            tasks = [MapTask(job, log.path, key_of(log.fingerprint, job.digest)) for log in logs]
            begin, own = time.monotonic(), time.process_time()
            answers = []
            first = math.nan
            for answer in engine(map_task.WORK, tasks):
                if math.isnan(first):  # The start of the processes is not overhead of a log.
                    first = time.monotonic() - answer.value.seconds
                answers.append(answer.value)
            took, used = time.monotonic() - first, time.process_time() - own
            assert len(answers) == count, begin
            busy = sum(one.seconds for one in answers)
            cpu = sorted(one.cpu for one in answers)
            beside = 1000 * (slots * took - busy) / count
            told = f"{busy / (slots * took):9.3f}  {beside:17.1f}"
            print(
                f"{name:<9}{count:6d}  {told}  {np.mean(cpu[-slots:]):18.2f}  {np.median(cpu[:-slots]):18.2f}  "
                f"{1000 * used / count:20.1f}"
            )


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
    driver = what.add_parser("driver")
    driver.add_argument("--logs", type=int, nargs="+", default=[100, 1000, 10000])
    given = parser.parse_args()
    if given.what == "run":
        bench_run(given.logs, given.jobs, given.ray)
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
