"""The layout: each room imports only what is below it, and nothing goes round in a circle.

Every import statement counts, those inside functions and those for type checkers as well.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import objslam

PACKAGE = Path(objslam.__file__).parent
LAYERS = (
    ("__main__",),
    ("cli",),
    ("fleet",),
    ("api",),
    ("live",),
    ("output", "simulation"),
    ("mapping", "detection", "sources", "evaluation"),
    ("graph", "frontend", "ros"),
    ("association", "triangulation", "io"),
    ("core",),
    ("config",),
    ("errors",),
)
"""From the top down; rooms of one layer do not import each other. The package's own `__init__`, the door, may import all."""

Edges = Mapping[str, set[str]]


def files_of(package: Path) -> dict[str, Path]:
    """Every module of a package, by its dotted path from the package's folder; a package by that of its `__init__`."""
    return {".".join(file.relative_to(package.parent).with_suffix("").parts): file for file in package.rglob("*.py")}


def imports_of(package: Path) -> dict[str, set[str]]:
    """For each module the modules that it imports, anywhere in it."""
    files = files_of(package)
    edges: dict[str, set[str]] = {}
    for module, file in files.items():
        found = (target for node in ast.walk(ast.parse(file.read_text("utf-8"))) for target in targets(node, module, files))
        edges[module] = {target for target in found if target != module}
    return edges


def targets(node: ast.AST, module: str, files: Mapping[str, Path]) -> Iterator[str]:
    """The modules of the package that an import statement names."""
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        above = module.split(".")[: -node.level] if node.level else []
        base = ".".join([*above, *([node.module] if node.module else [])])
        names = [f"{base}.{alias.name}" for alias in node.names]
    else:
        return
    for name in names:
        for candidate in (name, name.rpartition(".")[0]):
            if candidate in files or f"{candidate}.__init__" in files:
                yield candidate if candidate in files else f"{candidate}.__init__"
                break


def circle(edges: Edges) -> list[str] | None:
    """One circle of imports, None where there is none."""
    try:
        TopologicalSorter(edges).prepare()
    except CycleError as error:
        return list(error.args[1])
    return None


def between_folders(edges: Edges) -> dict[str, dict[str, set[str]]]:
    """For each folder the imports between what lies directly in it, files and folders; a folder's `__init__` left aside."""
    folders: dict[str, dict[str, set[str]]] = {}
    for module, imported in edges.items():
        for target in imported:
            one, two = module.split("."), target.split(".")
            depth = next(i for i, (a, b) in enumerate(zip(one, two, strict=False)) if a != b)
            if "__init__" not in (one[depth], two[depth]):
                folders.setdefault(".".join(one[:depth]), {}).setdefault(one[depth], set()).add(two[depth])
    return folders


def upward(edges: Edges) -> list[str]:
    """Imports of a room that is not below the one that imports it."""
    height = {room: -i for i, layer in enumerate(LAYERS) for room in layer}
    return sorted(
        f"{module} -> {target}"
        for module, imported in edges.items()
        for target in imported
        if (one := module.split(".")[1]) != (two := target.split(".")[1]) and one != "__init__" and two != "__init__"
        if height[one] <= height[two]
    )


@pytest.fixture(scope="module")
def edges() -> Edges:
    return imports_of(PACKAGE)


def test_each_room_imports_only_what_is_below_it(edges: Edges) -> None:
    assert upward(edges) == []


def test_no_circle_between_files(edges: Edges) -> None:
    assert circle(edges) is None


def test_no_circle_between_folders(edges: Edges) -> None:
    folders = between_folders(edges)
    assert {parent: found for parent, edges in folders.items() if (found := circle(edges))} == {}


def test_every_room_has_its_layer() -> None:
    rooms = {module.split(".")[1] for module in files_of(PACKAGE)} - {"__init__"}
    assert rooms == {room for layer in LAYERS for room in layer}


@pytest.mark.parametrize(
    "statement",
    [
        "from objslam.cli import main\n",
        "def late():\n    from objslam.cli import main\n",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import objslam.cli.run\n",
        "from ..cli import run\n",
    ],
)
def test_an_import_that_runs_up_is_found(tmp_path: Path, statement: str) -> None:
    package = copy_of_the_names(tmp_path)
    (package / "core" / "geometry.py").write_text(statement)
    found = upward(imports_of(package))
    assert len(found) == 1
    assert found[0].startswith("objslam.core.geometry -> objslam.cli")


def test_a_circle_of_files_and_one_of_folders_are_found(tmp_path: Path) -> None:
    package = copy_of_the_names(tmp_path)
    (package / "live" / "session" / "clock.py").write_text("def late():\n    from objslam.live.mapper import mapper\n")
    (package / "live" / "mapper" / "tracks.py").write_text("from objslam.live.session.session import Session\n")
    edges = imports_of(package)
    assert circle(edges) is None  # four files in a row, but two folders that import each other
    found = circle(between_folders(edges)["objslam.live"])
    assert found is not None
    assert {"session", "mapper"} <= set(found)
    (package / "live" / "session" / "session.py").write_text("from objslam.live.mapper.tracks import Track\n")
    assert circle(imports_of(package)) is not None


def test_no_folder_is_crowded_and_no_file_is_long() -> None:
    names = {
        file.relative_to(PACKAGE).parts[0]
        for file in PACKAGE.rglob("*")
        if file.is_file() and file.parent.name != "__pycache__"
    }
    assert len(names) <= 22
    for folder in {file.parent for file in files_of(PACKAGE).values()}:
        assert len([p for p in folder.iterdir() if p.is_file()]) <= 20, folder
    assert {
        name: n for name, file in files_of(PACKAGE).items() if (n := len(file.read_text("utf-8").splitlines())) > 350
    } == {}


def test_every_folder_says_in_two_sentences_what_lives_there() -> None:
    for file in PACKAGE.rglob("__init__.py"):
        said = ast.get_docstring(ast.parse(file.read_text("utf-8"))) or ""
        assert said.rstrip().endswith("."), file
        assert file.parent == PACKAGE or len([s for s in said.replace("\n", " ").split(". ") if s]) >= 2, file


def copy_of_the_names(to: Path) -> Path:
    """The package's modules, all of them empty."""
    package = to / "objslam"
    for file in files_of(PACKAGE).values():
        copied = package / file.relative_to(PACKAGE)
        copied.parent.mkdir(parents=True, exist_ok=True)
        copied.write_text("")
    return package
