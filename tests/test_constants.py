"""A constant has one home: no module sets one twice."""

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import objslam


def names(target: ast.expr) -> Iterator[str]:
    if isinstance(target, ast.Name):
        yield target.id
    elif isinstance(target, ast.Tuple):
        for part in target.elts:
            yield from names(part)


def constants(module: Path) -> Iterator[str]:
    for node in ast.parse(module.read_text(encoding="utf-8")).body:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        for target in targets:
            yield from (name for name in names(target) if name.isupper())


def test_no_constant_is_set_twice_in_a_module():
    modules = sorted(Path(objslam.__file__).parent.rglob("*.py"))
    twice = {(module.stem, name) for module in modules for name, times in Counter(constants(module)).items() if times > 1}
    assert len(modules) > 100
    assert twice == set()
