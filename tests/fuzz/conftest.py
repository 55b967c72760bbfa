"""The targets write bags as the tests of the bag readers do, and push to the sink that the tests of live sessions use.

tools/fuzz.sh prints a table at the end: the inputs that each target got in all rounds, and the CPU seconds that they took.
"""

import os
import resource
import sys
from pathlib import Path

import pytest

sys.path += [str(Path(__file__).parents[1] / part) for part in ("sources/ros", "live", "detection")]

from mutations import COUNTED

ROOM = 16 << 30
"""How much address space a target may ask for, bytes. More is refused, so that no input takes the memory of the computer.
Libraries reserve some GB that they do not use."""
TABLE = os.environ.get("OBJSLAM_FUZZ_TABLE", "")
"""The file that gets a line for each target as soon as it ends. The table at the end has the sums of all its lines."""


@pytest.fixture(autouse=True)
def _bounded():
    """No target gets more than ROOM."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (ROOM if soft == resource.RLIM_INFINITY else min(soft, ROOM), hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    before, begin = COUNTED["inputs"], os.times()
    COUNTED["slowest"], failed = 0.0, 1
    try:
        found = yield
        failed = 0
        return found
    finally:
        end = os.times()
        if TABLE:
            seconds = end.user + end.system - begin.user - begin.system
            with Path(TABLE).open("a") as file:
                print(COUNTED["inputs"] - before, seconds, COUNTED["slowest"], failed, item.name, file=file)


def pytest_terminal_summary(terminalreporter):
    if TABLE and Path(TABLE).exists():
        terminalreporter.write("\n".join(["", *told(Path(TABLE).read_text().splitlines()), ""]))


def told(lines):
    """The table of the targets: the inputs, the CPU seconds, and the CPU seconds of the slowest input."""
    sums = {}
    for line in lines:
        inputs, seconds, slowest, failed, name = line.split(maxsplit=4)
        row = sums.setdefault(name, [0, 0.0, 0.0, 0])
        row[:] = row[0] + int(inputs), row[1] + float(seconds), max(row[2], float(slowest)), row[3] + int(failed)
    every = list(zip(*sums.values(), strict=True))
    rows = {**sums, f"all {len(sums)} targets": [sum(every[0]), sum(every[1]), max(every[2]), sum(every[3])]} if sums else {}
    yield f"{'target':56s}{'inputs':>10s}{'CPU s':>10s}{'slowest':>10s}{'failures':>10s}"
    for name, (inputs, seconds, slowest, failed) in rows.items():
        yield f"{name:56s}{inputs:10d}{seconds:10.1f}{slowest:10.2f}{failed:10d}"
