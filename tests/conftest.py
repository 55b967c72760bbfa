"""What holds for all tests."""

import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator
from typing import Any

import pytest
from commands import Call
from hypothesis import HealthCheck, settings

from objslam.cli import console
from objslam.detection import onnx_model

settings.register_profile(
    "objslam",
    deadline=None,  # No example is too slow. That depends on what else the machine does.
    suppress_health_check=[HealthCheck.too_slow],
    derandomize="OBJSLAM_FUZZ_SEED" not in os.environ,  # The same examples in every run. tools/fuzz.sh looks for new ones.
)
settings.load_profile("objslam")

# The plugin that runs tests in several processes sets a width of 80 columns, which commands obey even in a pipe. So does
# readline, which pytest imports: Python does not see that, but the processes that it starts do.
os.environ.pop("COLUMNS", None)
os.unsetenv("COLUMNS")

# A suite in the background of a shell has SIGINT ignored. Commands that its tests start and interrupt would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def few_gigabytes() -> None:
    """Damaged models may fill the pool of memory that all models of a process share, and it is made once."""
    onnx_model._MOST_MEMORY = 1 << 30


@pytest.fixture(scope="session", autouse=True)
def no_progress() -> None:
    """How long a command takes, and so what it says while it works, is no part of a test. Tests of it set another time."""
    console._EVERY = threading.TIMEOUT_MAX


@pytest.fixture(scope="session", autouse=True)
def no_boxes_of_earlier_runs(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The user's cache has the boxes that a detector found when the tests ran before, perhaps with other code."""
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="session", autouse=True)
def no_waiting_for_the_disk() -> None:
    """No test cuts the power: they kill processes, and a killed process leaves what it wrote to the kernel. So nothing waits
    until it is on the disk, which takes some milliseconds each time. A descriptor that is no file is still an error. Tests
    that count such calls, or let them fail, replace these functions in turn."""

    def sync(file: Any) -> None:
        os.fstat(file if isinstance(file, int) else file.fileno())

    os.fsync = os.fdatasync = sync  # type: ignore[assignment]


@pytest.fixture(scope="session", autouse=True)
def processes_beside_sessions() -> Iterator[None]:
    """They are kept for later tests. Tests of how they start and end take the fixture `own_processes`."""
    from kept_workers import kept_workers

    with kept_workers():
        yield


@pytest.fixture
def own_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each session starts and ends the processes beside it, as it does for a user."""
    from kept_workers import AS_EVER

    for of, name, value in AS_EVER:
        monkeypatch.setattr(of, name, value)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Every second process collects from the last file to the first. Without compiled files, it takes as long to rewrite the
    tests as to import them. So each of two processes rewrites one half, and finds the other half done."""
    report = yield
    worker = getattr(collector.config, "workerinput", {}).get("workerid", "gw0")
    if isinstance(collector, pytest.Dir | pytest.Session) and int(worker.removeprefix("gw")) % 2:
        report.result.reverse()
    return report


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the tests that fork their process many times. A fork takes longer the more memory the process has, and that
    is least at first. Then come the tests that take longest. At the end, one process would run them while the others have
    nothing to do. Otherwise, files come in the order of their paths, in all processes."""
    first = ("forks", "long")

    def place(item: pytest.Item) -> tuple[int, tuple[str, ...]]:
        return next((i for i, name in enumerate(first) if item.get_closest_marker(name)), len(first)), item.path.parts

    items.sort(key=place)


def pytest_collection_finish() -> None:
    """The garbage collector looks no more at what is there before the first test: modules and tests, half a million objects.
    Each full collection took 0.35 s, a fiftieth of the time of the tests."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module")
def one_start() -> Iterator[None]:
    """No map of a joint solve is tried from other starts, as unclear maps are. Other starts take most of the time of a test
    that asks what the first start finds, and can hide that it finds nothing."""
    from objslam.mapping import several_starts

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(several_starts, "_unclear", lambda state, confirmed: False)
        yield


@pytest.fixture
def objslam(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Call]:
    """The entry point of the console script, in this process. A process of its own pays a second for its imports."""
    from objslam.cli import main

    def call(*arguments: object) -> Call:
        monkeypatch.setattr(sys, "argv", ["objslam", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as exit_:
            main()
        captured = capsys.readouterr()
        assert isinstance(exit_.value.code, int)
        return Call(exit_.value.code, captured.out, captured.err)

    return call
