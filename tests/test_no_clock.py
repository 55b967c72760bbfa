"""No test depends on how long something takes: what else the machine does may make that ten times as long."""

import ast
from collections.abc import Iterator
from pathlib import Path

from hypothesis import HealthCheck, settings

TESTS = Path(__file__).parent
CLOCKS = {"waiting.py", "robot.py"}
"""They wait, and drive a robot in real time; nothing in them asks how long something took."""
WAITING = {"join", "wait", "communicate"}


def asked(module: Path) -> Iterator[str]:
    """What asks the clock in a module."""
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module] if isinstance(node, ast.ImportFrom) else [name.name for name in node.names]
            if "time" in names:
                yield f"{module.name}:{node.lineno} imports time"
        elif isinstance(node, ast.Call):
            for keyword in node.keywords:
                if keyword.arg == "deadline" and module.name != "conftest.py":
                    yield f"{module.name}:{node.lineno} sets a deadline"
                if keyword.arg == "timeout" and not (isinstance(keyword.value, ast.Name) and keyword.value.id == "LIMIT"):
                    yield f"{module.name}:{node.lineno} has a limit of its own"
            method = node.func.attr if isinstance(node.func, ast.Attribute) else ""
            numbers = [a for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, int | float)]
            if method in WAITING and numbers:
                yield f"{module.name}:{node.lineno} has a limit of its own"


def test_no_test_asks_the_clock():
    modules = sorted(module for module in TESTS.rglob("*.py") if module.name not in CLOCKS)
    assert len(modules) > 80
    assert [line for module in modules for line in asked(module)] == []


def test_no_example_of_hypothesis_is_too_slow():
    assert settings().deadline is None
    assert HealthCheck.too_slow in settings().suppress_health_check
