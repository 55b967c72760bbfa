"""The targets write bags as the tests of the bag readers do, and push to the sink that the tests of live sessions use.

tools/fuzz.sh prints a table at the end: the inputs that each target got, and the CPU seconds that they took.
"""

import os
import resource
import sys
from pathlib import Path

import pytest

sys.path += [str(Path(__file__).parents[1] / part) for part in ("sources/ros", "live", "detection")]

from mutations import COUNTED, LEAST, ROUNDS

ROOM = 16 << 30
"""How much address space a target may ask for, bytes. More is refused, so that no input takes the memory of the computer.
Libraries reserve some GB that they do not use."""
TABLE: dict[str, tuple[int, float]] = {}


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
    try:
        return (yield)
    finally:
        end = os.times()
        TABLE[item.name] = COUNTED["inputs"] - before, end.user + end.system - begin.user - begin.system


def pytest_terminal_summary(terminalreporter):
    if ROUNDS > 1 or LEAST > 0:
        for name, (inputs, seconds) in TABLE.items():
            terminalreporter.write_line(f"{name:60s}{inputs:10d}{seconds:10.1f}")
        inputs, seconds = (sum(column) for column in zip(*TABLE.values(), strict=True))
        terminalreporter.write_line(f"{'all inputs, CPU s':60s}{inputs:10d}{seconds:10.1f}")
