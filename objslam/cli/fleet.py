"""The command `objslam fleet`, which maps many logs on an engine and merges each site."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from objslam.cli.console import console, put, say
from objslam.cli.options import CalibrationFile, Config, DetectorModel, Json, Mode, Quiet, Set, settings_of, with_options
from objslam.errors import OutputError
from objslam.sources import SourceOptions

if TYPE_CHECKING:
    from objslam.fleet.driver import FleetResult, Tell
    from objslam.fleet.engines.local_engine import Engine
    from objslam.fleet.engines.ray_engine import Cluster

_GB = 1e9
_RAY_MEMORY = 4.0
"""The memory limit of a task on a cluster, GB, if the user gives none. With a larger value, larger logs can be mapped."""
_TENTHS = 10
"""The number of lines of progress of a stage if stderr is not a terminal. More lines show the progress in smaller steps."""

Sources = Annotated[
    list[str], typer.Argument(metavar="SOURCE...", help="Logs, folders with logs, glob patterns, or URLs such as s3://...")
]
OutUrl = Annotated[str, typer.Option("-o", "--out", help="Folder or URL for results, sites and tables.")]
By = Annotated[
    str,
    typer.Option(
        "--by",
        help="What names the site of a log: a field of --layout, or `folder` (its folder). `none`: all logs are one site.",
    ),
]
LayoutOption = Annotated[
    str,
    typer.Option("--layout", help="The folders above a log, such as {site}/{robot}/{day}/{log}. {log} is the log itself."),
]
Jobs = Annotated[
    int | None, typer.Option("-j", "--jobs", min=1, help="Number of processes on this machine. Default: one per core.")
]
RayAddress = Annotated[
    str | None,
    typer.Option("--ray", metavar="ADDRESS", help="Run on the Ray cluster at this address. `auto`: the cluster here."),
]
MemoryLimit = Annotated[
    float | None,
    typer.Option(
        "--memory",
        min=0.0,
        help="Memory limit of a task, GB. 0: no limit. Default: an equal share of this machine, or 4 with --ray.",
    ),
]
TimeLimit = Annotated[float, typer.Option("--time-limit", min=0.0, help="Time limit of a task, s. 0: no limit.")]
Retries = Annotated[int, typer.Option("--retries", min=0, help="How often a task is started again if its process dies.")]
Gpus = Annotated[
    float, typer.Option("--gpus", min=0.0, help="With --ray and --detector: the share of a GPU that each task takes.")
]
Again = Annotated[bool, typer.Option("--retry-failed", help="Map again the logs that failed because of their content.")]
WithReport = Annotated[bool, typer.Option("--report", help="Write report.html for each log.")]
Price = Annotated[float | None, typer.Option("--price", min=0.0, help="Price of one core per hour, for the column `cost`.")]
FAILED = 1
"""The exit code of a fleet in which a log or a site failed."""


@with_options
def fleet(
    sources: Sources,
    out: OutUrl,
    by: By = "site",
    layout: LayoutOption = "{site}/{log}",
    jobs: Jobs = None,
    ray: RayAddress = None,
    memory: MemoryLimit = None,
    time_limit: TimeLimit = 3600.0,
    retries: Retries = 2,
    retry_failed: Again = False,
    mode: Mode = None,
    config: Config = None,
    set_: Set = None,
    *,
    options: SourceOptions,
    detector: DetectorModel = None,
    gpus: Gpus = 0.0,
    calibration: CalibrationFile = None,
    report: WithReport = False,
    price: Price = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Map many logs, each as one task, and merge the results of each site to one map.

    A second run does only what is missing or changed.
    The exit code is 1 if a log or a site failed. failed.parquet lists them.
    Results have no recording for the viewer, unless --set output.recording=true.
    """
    from objslam.fleet.driver import run_fleet
    from objslam.fleet.engines.local_engine import cores, local_engine, memory_of_machine
    from objslam.fleet.engines.worker import Limits
    from objslam.fleet.job import make_job
    from objslam.fleet.logs import Layout, find_logs
    from objslam.fleet.page import PAGE, fleet_page
    from objslam.fleet.stores.open_store import is_remote, open_store
    from objslam.sources.log_folder import resembles_log

    begin = time.monotonic()
    if not is_remote(out) and resembles_log(Path(out)):
        raise OutputError(
            "this is a log, and the results of a fleet need a folder of their own", where=out, hint="name another"
        )
    settings = settings_of(mode, config, ["output.recording=false", *(set_ or ())], calibration)
    logs = find_logs(sources, Layout(layout, by))
    job = make_job(out, settings, options, detector, report=report)
    cost = float("nan") if price is None else price
    show = _silent if quiet or json else _shown
    if ray is None:
        count = jobs or cores()
        share = memory_of_machine() / count if memory is None else memory * _GB
        engine = local_engine(count, Limits(int(share), time_limit, retries))
        with show() as tell:
            found = run_fleet(job, logs, engine, price=cost, again=retry_failed, tell=tell)
    else:
        with _joined(ray, quiet or json):
            engines = _ray_engines(memory, time_limit, retries, jobs, gpus if detector is not None else 0.0)
            with show() as tell:
                found = run_fleet(job, logs, engines[0], price=cost, again=retry_failed, tell=tell, merge_engine=engines[1])
    open_store(job.store).write(PAGE, fleet_page(found, price=cost))
    summary = _summary(found, job.store, time.monotonic() - begin)
    if json:
        from objslam.io.results.files import dump_json

        put(dump_json(summary))
    elif not quiet:
        _say(found, summary)
    if found.failures:
        say(f"objslam: {len(found.failures)} failed, named in {job.store}/failed.parquet", stderr=True)
        raise typer.Exit(FAILED)


def _ray_engines(memory: float | None, seconds: float, retries: int, jobs: int | None, gpus: float) -> tuple[Engine, Engine]:
    """Return the engines of the mapping and of the merges. A memory limit that the user gave is also reserved on a node."""
    from objslam.fleet.engines.ray_engine import ray_engine
    from objslam.fleet.engines.worker import Limits

    limits = Limits(int((_RAY_MEMORY if memory is None else memory) * _GB), seconds, retries)
    reserved = int((memory or 0) * _GB)
    mapping = ray_engine(limits, most=jobs or 0, memory=reserved, gpus=gpus)
    return mapping, ray_engine(limits, most=jobs or 0, memory=reserved, gpus=0.0)


@contextmanager
def _joined(address: str, quiet: bool) -> Iterator[Cluster]:
    from objslam.fleet.engines.ray_engine import join_cluster, leave_cluster

    cluster = join_cluster(address)
    try:
        if not quiet:
            page = f"http://{cluster.dashboard}" if cluster.dashboard else "none (pip install 'ray[default]')"
            say(f"joined a Ray cluster with {cluster.cpus:g} CPUs and {cluster.gpus:g} GPUs, dashboard: {page}", stderr=True)
        yield cluster
    finally:
        leave_cluster()


@contextmanager
def _silent() -> Iterator[Tell]:
    yield lambda stage, done, failed, running, total: None


@contextmanager
def _shown() -> Iterator[Tell]:
    """Show the progress: a bar in a terminal, else a line for each tenth of the work."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    screen = console(stderr=True)
    began: dict[str, tuple[float, int]] = {}
    told: dict[str, int] = {}
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal) as bar:
        task = bar.add_task("finding")

        def tell(stage: str, done: int, failed: int, running: int, total: int) -> None:
            start, first = began.setdefault(stage, (time.monotonic(), done + failed))
            line = f"{stage}: " + _progress(done, failed, running, total, first, time.monotonic() - start)
            bar.update(task, description=line, completed=done + failed, total=total or None)
            tenth = (done + failed) * _TENTHS // max(total, 1)
            if not screen.is_terminal and tenth > told.get(stage, -1):
                told[stage] = tenth
                say(line, stderr=True)

        yield tell


def _progress(done: int, failed: int, running: int, total: int, first: int, seconds: float) -> str:
    """Return the progress in words. first: the number of tasks that had ended when the stage began. seconds: the time since
    the stage began, s."""
    by_now = done + failed - first
    line = f"{done} of {total} done, {failed} failed, {running} running, {total - done - failed - running} to do"
    if by_now <= 0 or seconds <= 0:
        return line
    left = (total - done - failed) * seconds / by_now
    return f"{line}, {60 * by_now / seconds:.0f} a minute, {left:.0f} s left"


def _summary(found: FleetResult, store: str, seconds: float) -> dict[str, Any]:
    return {
        "out": store,
        **{"logs": len(found.mapped), "new": found.new, "copies": found.copies, "seconds": seconds},
        "sites": [{name: getattr(one, name) for name in one.__slots__} for one in found.sites],
        "failures": [{"name": one.name, "kind": one.kind, "error": one.error} for one in found.failures],
    }


def _say(found: FleetResult, summary: dict[str, Any]) -> None:
    for one in found.sites:
        more = f", {one.islands} islands" if one.islands > 1 else ""
        state = "" if one.changed else ", as before"
        sessions = f"{one.sessions} session{'' if one.sessions == 1 else 's'}"
        objects = f"{one.objects} object{'' if one.objects == 1 else 's'}"
        say(f"{one.site}: {objects} ({one.gone} gone) from {sessions}{more}{state}")
    for failure in found.failures[:20]:
        say(f"failed ({failure.kind}): {failure.name}: {failure.error.removeprefix(f'{failure.name}: ')}", stderr=True)
    logs = "log" if len(found.mapped) == 1 else "logs"
    say(f"{len(found.mapped)} {logs} mapped, {found.new} of them now, in {summary['seconds']:.0f} s")
    say(f"wrote {summary['out']}")
