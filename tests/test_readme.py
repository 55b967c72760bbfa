"""What README.md and docs/ say is what happens: blocks run in their order, commands exist, tables are true."""

from __future__ import annotations

import ast
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
import yaml
from commands import Call, call
from waiting import LIMIT

import objslam
from objslam import ObjectMap
from objslam.cli.commands import build_app
from objslam.config import Settings, load_settings
from objslam.mapping import several_starts

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCK = re.compile(
    r"^( *)(<!-- not run: (?P<why>[^\n]+?) -->\n *)?```(?P<language>\w+)\n(?P<body>.*?)^\1```$", re.MULTILINE | re.DOTALL
)
"""A fenced block. A comment before it, which the reader does not see, says why it cannot run here."""


def in_order(nav: Any) -> list[str]:
    """The pages of a table of contents."""
    if isinstance(nav, str):
        return [nav]
    return [page for entry in (nav.values() if isinstance(nav, dict) else nav) for page in in_order(entry)]


def pages() -> dict[str, str]:
    """The text of README and of each page of docs/, in the order in which a reader meets them."""
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8").replace("!!python/name:", ""))["nav"]
    files = [ROOT / "README.md", *(ROOT / "docs" / name for name in in_order(nav))]
    return {str(file.relative_to(ROOT)): file.read_text(encoding="utf-8") for file in files}


PAGES = pages()
TEXT = "\n".join(PAGES.values())


def blocks(language: str) -> list[str]:
    """The fenced blocks of a language, without their indentation."""
    return [textwrap.dedent(found["body"]) for found in BLOCK.finditer(TEXT) if found["language"] == language]


def marked() -> list[tuple[str, str]]:
    """(language, text) of every block of commands that runs here, in the order of the pages."""
    return [
        (found["language"], textwrap.dedent(found["body"]))
        for found in BLOCK.finditer(TEXT)
        if found["language"] in ("bash", "python") and not found["why"]
    ]


def commands() -> list[list[str]]:
    """Every `objslam ...` of the blocks and of the text, as arguments."""
    lines = [line for block in blocks("bash") for line in block.splitlines() if line.startswith("objslam ")]
    lines += re.findall(r"`(objslam [^`]+)`", TEXT)
    return [shlex.split(line.split(" > ")[0])[1:] for line in lines]


def rows(first: str) -> list[list[str]]:
    """The cells of the table whose first column is called so."""
    table = re.search(rf"^\| {first} \|.*\n\|[-|]+\|\n((?:\|.*\n)+)", TEXT, re.MULTILINE)
    assert table
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in table[1].splitlines()]


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings: small letters, hyphens for blanks, no other signs."""
    prose = re.sub(r"^ *```.*?^ *```$", "", text, flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", re.sub(r"[`*]|\]\(.*?\)|\[", "", one).lower()).replace(" ", "-") for one in headings}


def dead_links(file: Path) -> list[str]:
    """The relative links of a page whose file or anchor is not there."""
    text = file.read_text(encoding="utf-8")
    dead = []
    for link in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"^ *```.*?^ *```$", "", text, flags=re.MULTILINE | re.DOTALL)):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = file.parent / name if name else file
        if not target.is_file() or (anchor and anchor not in anchors(target.read_text(encoding="utf-8"))):
            dead.append(link)
    return dead


def steps() -> Iterator[tuple[str, str]]:
    """(kind, text) of all that a reader types. The kind is python, objslam for one whole command of it, else bash."""
    for language, block in marked():
        if language == "python":
            yield language, block
        else:  # Lines with a pipe or a redirection are for bash.
            for part in re.split(r"^(objslam [^|>\n]+)\n", block, flags=re.MULTILINE):
                if part.strip():
                    yield "objslam" if re.fullmatch(r"objslam [^|>\n]+", part) else "bash", part


def typed(kind: str, text: str) -> Call:
    """What happens when a reader types it. Python and commands of objslam run in this process, which has its imports."""
    if kind == "python":
        exec(compile(text, "block", "exec"), {"__name__": "__main__"})
        return Call(0, "", "")
    if kind == "objslam":
        return call(*shlex.split(text, comments=True)[1:])
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    words = ["bash", "-euo", "pipefail", "-c", text]
    environment = {**os.environ, "PATH": path}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False)
    return Call(done.returncode, done.stdout, done.stderr)


def thinned(detections: Path) -> None:
    """Keep the boxes of every sixth image."""
    lines = detections.read_text(encoding="utf-8").splitlines(keepends=True)
    detections.write_text("".join(lines[::6]), encoding="utf-8")


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which all marked blocks ran, one after the other, as a reader types them.

    The demo itself is compared with a table. Later blocks only show how to use its log, so they get fewer of its images.
    """
    folder = tmp_path_factory.mktemp("readme")
    shutil.copytree(ROOT / "configs", folder / "configs")
    with chdir(folder), pytest.MonkeyPatch.context() as patch:
        for kind, text in steps():
            done = typed(kind, text)
            assert done.code == 0, f"{text}\n{done.out}\n{done.err}"
            assert "Traceback" not in done.err
            if text.startswith("objslam demo --boxes"):
                thinned(folder / "demo_boxes" / "log" / "detections.jsonl")
                patch.setattr(several_starts, "_unclear", lambda state, confirmed: False)  # As `one_start` does.
    return folder


@pytest.mark.long
def test_the_marked_blocks_do_what_the_text_says(played: Path) -> None:
    for result in ("demo_boxes/fixed", "demo_boxes/joint", "my_map", "out"):
        assert (played / result / "map.png").is_file()
        assert (played / result / "recording.rrd").is_file()
    (cup,) = json.loads((played / "my_map" / "objects.json").read_text())["objects"]
    (shown,) = (o for o in map(json.loads, blocks("json")) if "existence" in o)
    assert set(cup) == set(shown)
    assert cup["status"] == shown["status"]
    np.testing.assert_allclose(cup["position"], shown["position"], atol=0.005)
    np.testing.assert_allclose(cup["position"], [2.5, 0.5, 0.4], atol=0.02)
    sigma = np.sqrt(np.linalg.eigvalsh(cup["covariance"])[-1])
    assert f"Its sigma is {sigma:.2f} m" in README
    assert load_settings(played / "my_settings.yaml").fixed.loss == "huber"
    assert (played / "my_copy" / "groundtruth" / "objects.json").is_file()
    assert (played / "out" / "objects.csv").is_file()
    assert (played / "out" / "map.mcap").is_file()
    assert json.loads((played / "map.geojson").read_text())["type"] == "FeatureCollection"
    mapped = ObjectMap.load(played / "out"), ObjectMap.load(played / "demo_boxes" / "fixed")
    both = ObjectMap.load(played / "both.json")
    assert max(map(len, mapped)) <= len(both) < sum(map(len, mapped))  # the same room twice


def test_the_python_blocks_use_public_names() -> None:
    """They run in a process that has imported more of objslam than a reader's."""
    blocks = [ast.parse(text) for kind, text in steps() if kind == "python"]
    nodes = [node for block in blocks for node in ast.walk(block) if isinstance(node, ast.Attribute)]
    used = {node.attr for node in nodes if isinstance(node.value, ast.Name) and node.value.id == "objslam"}
    assert {"read", "run"} <= used <= set(objslam.__all__)


@pytest.mark.long
def test_every_field_and_file_of_a_result_is_explained(played: Path) -> None:
    fields = set(re.findall(r"`(\w+)`", " ".join(row[0] for row in rows("field"))))
    written: set[str] = set()
    for file in played.glob("**/objects.json"):
        objects = json.loads(file.read_text())
        written |= {key for o in objects["objects"] for key in o}
    assert written <= fields
    # No object was unresolved, moved to its body, or a fiducial, and no box had an appearance vector.
    assert fields - written <= {"ray", "ray_point", "tag", "features"}
    results = {file.name for name in ("demo_boxes/joint", "my_map") for file in (played / name).iterdir()}
    for name in results:
        assert f"`{name}`" in PAGES["docs/results.md"], name


@pytest.mark.long
def test_the_demo_is_as_good_as_the_table_says(played: Path) -> None:
    table = {row[1]: row for row in rows("drive")}
    for mode in ("fixed", "joint"):
        evaluation = json.loads((played / "demo_boxes" / mode / "evaluation.json").read_text())
        row = table[mode]
        assert row[4] in README  # its line of numbers is that of the table
        assert row[2] == f"{evaluation['matched']} / {evaluation['matched'] + evaluation['missed']}"
        assert row[3] == str(evaluation["false"])
        assert abs(float(row[4].removesuffix(" m")) - evaluation["position_rmse"]) < 0.002
        assert abs(float(row[5].removesuffix(" m")) - evaluation["ate"]) < 0.002


@pytest.mark.parametrize("arguments", commands(), ids=" ".join)
def test_every_command_has_the_options_that_are_shown(arguments: list[str]) -> None:
    """Parses each command line, down to its last option, without running it."""
    command: Any = typer.main.get_command(build_app())
    context = command.make_context("objslam", ["config"], resilient_parsing=True)
    arguments = [argument for argument in arguments if argument not in ("--debug", "--help", "...")]
    while hasattr(command, "resolve_command") and arguments and arguments[0] != "COMMAND":
        name, command, arguments = command.resolve_command(context, arguments)
        if arguments and not hasattr(command, "resolve_command"):
            command.make_context(name, arguments, parent=context)


@pytest.mark.parametrize("row", rows("setting"), ids=lambda row: row[0].strip("`"))
def test_the_settings_have_the_defaults_that_are_shown(row: list[str]) -> None:
    value: object = Settings()
    for part in row[0].strip("`").split("."):
        value = getattr(value, part)
    assert yaml.safe_load(row[1]) == (list(value) if isinstance(value, tuple) else value)


MARKDOWN = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]


@pytest.mark.parametrize("file", MARKDOWN, ids=lambda file: file.name)
def test_no_link_is_dead(file: Path) -> None:
    assert dead_links(file) == []


def test_a_dead_link_and_a_dead_anchor_are_found(tmp_path: Path) -> None:
    (tmp_path / "b.md").write_text("# A heading, with `code`\n```\n# no heading\n[no](link.md)\n```\n")
    page = tmp_path / "a.md"
    page.write_text(
        "[1](b.md) [2](c.md) [3](b.md#a-heading-with-code) [4](b.md#no-heading) [5](https://x.y/z.md) [6](#none)"
    )
    assert dead_links(page) == ["c.md", "b.md#no-heading", "#none"]


def test_what_is_named_is_there() -> None:
    named = re.findall(r"\b(?:configs|tools|objslam|examples)/[\w/]+\.\w+", TEXT)
    assert named
    for name in named:
        assert (ROOT / name).is_file(), name


def test_every_page_is_in_the_table_of_contents() -> None:
    assert {f"docs/{file.name}" for file in (ROOT / "docs").glob("*.md")} == set(PAGES) - {"README.md"}


def test_the_readme_is_one_screen_of_text() -> None:
    assert len(README.splitlines()) <= 250
    assert len(README.encode()) <= 12_000


def test_the_pages_build_strictly(tmp_path: Path) -> None:
    for package in ("mkdocs", "material", "mkdocstrings_handlers"):
        pytest.importorskip(package)
    words = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--quiet",
        "-f",
        str(ROOT / "mkdocs.yml"),
        "-d",
        str(tmp_path),
    ]
    done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 0, done.stderr
    assert 'id="objslam.Result.save"' in (tmp_path / "python" / "index.html").read_text("utf-8")
