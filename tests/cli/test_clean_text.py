"""What is shown of names that others chose: no terminal command, markup, formula or script of theirs takes effect."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
import shutil
import sys
import unicodedata
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import mcap.reader
import numpy as np
import pytest
from quick import QUICK
from small_log import small_log
from synthetic_result import synthetic_result

from objslam.cli import console as terminal
from objslam.cli import main
from objslam.config import Output, Settings
from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.output.export.formats import FORMATS
from objslam.output.result_folder import write_result
from objslam.output.viewer.event_log import markdown
from objslam.output.viewer.recording import write_recording
from objslam.ros.bag.records import plain
from objslam.sources.log_folder import write_log_folder

PAYLOADS = (
    "\x1b[31m", "\x1b]0;title\x07", "\x1b[2J", "\x9b2J", "\x07", "\x08\x08", "\r", "\r\n", "\n", "\t", "\x00", "\x7f",
    "\x85", "\u2028", "\u202e", "\u200f", "\u2066", "\ufeff", "\u200b", "[red]", "[/red]", "[/]",
    "[link=http://x.invalid]", ":smile:", "<script>alert(1)</script>", "<img src=x onerror=alert(2)>", '"><b>',
    "</style>", "&lt;b&gt;", "{{ 7 * 7 }}", "{% if %}", "[a](http://x.invalid)", "![a](http://x.invalid)", "|", "`",
    "```mermaid", "click A call alert()", "%%{init: {}}%%", "=1+1", "+1", "-1", "@SUM(1)", "=cmd|' /C calc'!A0",
    "\uff1d1+1", "\t=1", "\r=1", "%s%n", "${HOME}", "$(id)", "; rm -rf ~",
)  # fmt: skip
NASTY = [form.format(payload) for payload in PAYLOADS for form in ("{0}", "cup{0}", "{0}cup", " {0}{0}")]
LABELS = [label if label.strip() else f"{label}." for label in NASTY]
LEAN = Settings(output=Output(recording=False, picture=False))


def unclean(text: str) -> set[str]:
    """The characters of a text that a terminal or a reader does not show as themselves, but for line breaks."""
    return {c for c in text if unicodedata.category(c)[0] == "C" or (unicodedata.category(c) in ("Zl", "Zp"))} - {"\n"}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result with an object for each of the nasty labels, as a file from elsewhere may hold them."""
    folder = tmp_path_factory.mktemp("nasty") / "[red]\x1b[31m=1+1<b>\u202eout"
    positions = np.random.default_rng(0).uniform(0, 10, (len(LABELS), 3))
    plain = [f"thing {i}" for i in range(len(LABELS))]
    result, _ = synthetic_result(positions, plain, keyframes=3, settings=LEAN)
    summary = {**result.summary, "log": LABELS[0], "warnings": LABELS, "dropped": dict.fromkeys(LABELS, 1)}
    write_result(dataclasses.replace(result, summary=summary), folder)
    content = json.loads((folder / "objects.json").read_text())
    for o, label in zip(content["objects"], LABELS, strict=True):
        o["label"] = label
    (folder / "objects.json").write_text(json.dumps(content))
    truth = {**content, "objects": [{key: o[key] for key in ("id", "label", "position")} for o in content["objects"]]}
    (folder / "truth.json").write_text(json.dumps(truth))
    return folder


@pytest.fixture
def objslam(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[str, str]]:
    def call(*arguments: object, code: int = 0) -> tuple[str, str]:
        monkeypatch.setattr(sys, "argv", ["objslam", *map(str, arguments)])
        terminal.console_of.cache_clear()
        capsys.readouterr()
        with pytest.raises(SystemExit) as exit_:
            main()
        terminal.console_of.cache_clear()
        said = capsys.readouterr()
        assert exit_.value.code == code, said.err
        assert "Traceback" not in said.err
        assert "internal error" not in said.err
        assert not unclean(said.out + said.err)
        return said.out, said.err

    return call


@pytest.fixture
def log(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A log in a folder with a nasty name, and in each of its frames boxes with some of the nasty labels."""
    folder = tmp_path / "[red]\x1b[31m:smile:\u202elog"
    number = 80 if "doctor" in request.node.name else 30  # Few boxes are no proof that they spoil a map.
    write_log_folder(small_log(frames=number), folder)
    frames = [json.loads(line) for line in (folder / "detections.jsonl").read_text().splitlines()]
    for number, frame in enumerate(frames):
        some = LABELS[number % 10 :: 10] if frame["boxes"] else []
        for key in set(frame) - {"stamp", "labels"}:
            frame[key] += frame[key][:1] * len(some)
        frame["labels"] += some
    (folder / "detections.jsonl").write_text("".join(json.dumps(frame) + "\n" for frame in frames))
    return folder


def test_there_are_200_of_them() -> None:
    assert len(set(LABELS)) == 200


@pytest.mark.parametrize("command", [("info",), ("info", "--json")])
def test_info(objslam: Callable[..., tuple[str, str]], log: Path, command: tuple[str, ...]) -> None:
    said, _ = objslam(command[0], log, *command[1:])
    assert "[red]" in said
    assert ":smile:" in said


def test_run(objslam: Callable[..., tuple[str, str]], log: Path, tmp_path: Path) -> None:
    folder = tmp_path / "[/red]\x1b[2J=out"
    least = ("--set", "association.min_existence=0", "--set", "association.fuse_labels=false")
    said, warned = objslam("run", log, "-o", folder, *least, *QUICK)
    assert r"wrote " in said
    assert r"[/red]\x1b[2J=out" in said
    assert "label that is no printable text" in warned
    objslam("report", folder)
    objslam("export", folder, "--to", "csv")


COMMANDS = {
    "doctor": ("doctor", "{log}"),
    "explain": ("explain", "{out}"),
    "explain --json": ("explain", "{out}", "--json"),
    "eval --json": ("eval", "{out}", "--truth", "{out}/truth.json", "--json"),
    "register": ("register", "{out}", "{out}"),
    "merge": ("merge", "{out}", "{out}", "-o", "{made}"),
    "diff": ("diff", "{out}", "{out}"),
    "ply": ("export", "{out}", "--to", "ply"),
}
"""The other commands that read a log or a result, by name."""


@pytest.mark.parametrize("name", COMMANDS)
def test_every_other_command(
    objslam: Callable[..., tuple[str, str]], log: Path, out: Path, tmp_path: Path, name: str
) -> None:
    made = tmp_path / "[b]\x1b[2J\u202emade"
    words = [word.format(log=log, out=out, made=made) for word in COMMANDS[name]]
    objslam(*words)


def test_a_log_is_converted_and_a_journal_read(objslam: Callable[..., tuple[str, str]], log: Path, tmp_path: Path) -> None:
    folder = tmp_path / "[/red]\x1b[2Jlive"
    objslam("live", log, "--speed", "0", "-o", folder, *QUICK)
    for words in (("verify", folder), ("repair", folder), ("export", folder, "-o", tmp_path / "\x1b]0;lines")):
        objslam("journal", *words)
    objslam("convert", folder, tmp_path / "[/]\u202eagain")
    objslam("convert", log, tmp_path / "[/]\x1b[31mlog")
    for file in (tmp_path / "\x1b]0;lines", tmp_path / "[/]\x1b[31mlog" / "detections.jsonl"):
        assert not unclean(file.read_text(encoding="utf-8"))


def test_the_terminal_shows_words_as_they_are(objslam: Callable[..., tuple[str, str]], out: Path) -> None:
    said, _ = objslam("eval", out, "--truth", out / "truth.json")
    for word in ("[red]cup", "[/red]cup", "[link=http://x.invalid]", ":smile:", r"cup\x1b[31m", r"\u202ecup"):
        assert word in said


def test_errors_and_warnings() -> None:
    for text in LABELS:
        ledger = Ledger()
        ledger.drop(text, where=text)
        ledger.warn(text)
        for line in (*ledger.lines(), str(LogError(text, where=text, hint=text)), plain(text)):
            assert not unclean(line)
            assert "\n" not in line


def test_csv_has_no_formula(objslam: Callable[..., tuple[str, str]], out: Path) -> None:
    objslam("export", out, "--to", "csv")
    rows = list(csv.DictReader(io.StringIO((out / "objects.csv").read_text(encoding="utf-8"))))
    assert len(rows) == len(LABELS)
    for row, label in zip(rows, LABELS, strict=True):
        assert not re.match(r"\s*[=+\-@\uff1d]", row["label"])
        assert not unclean(row["label"])
        assert label.isprintable() <= (row["label"] in (label, f"'{label}"))
        float(row["x"])  # a negative number stays a number


def test_geojson_is_escaped_json(objslam: Callable[..., tuple[str, str]], out: Path) -> None:
    objslam("export", out, "--to", "geojson")
    text = (out / "objects.geojson").read_text(encoding="utf-8")
    assert not unclean(text)
    found = [f["properties"]["label"] for f in json.loads(text)["features"] if f["properties"]["kind"] == "object"]
    assert len(found) == len(LABELS)


def test_mcap_markers(objslam: Callable[..., tuple[str, str]], out: Path) -> None:
    objslam("export", out, "--to", "mcap")
    with (out / FORMATS["mcap"].file).open("rb") as stream:
        messages = [m.data for _, _, m in mcap.reader.make_reader(stream).iter_messages()]
    for data in messages:
        text = data.decode("utf-8", "ignore")
        for mark in ("\x1b[31m", "\x1b[2J", "\u202e", "\u2066", "\x1b]0;"):
            assert mark not in text


class _Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: set[str] = set()
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes |= {name for name, _ in attrs}
        self.links += [value or "" for name, value in attrs if name in ("href", "src")]


def test_the_report_has_no_tag_of_theirs(objslam: Callable[..., tuple[str, str]], out: Path) -> None:
    objslam("report", out)
    text = (out / "report.html").read_text(encoding="utf-8")
    page = _Tags()
    page.feed(text)
    assert (page.tags.count("script"), page.tags.count("style")) == (2, 1)
    assert not [link for link in page.links if not link.startswith(("#object-", "#map", "data:image/"))]
    assert not [name for name in page.attributes if name.startswith("on")]
    assert not unclean(text)
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text


def test_the_recording(tmp_path: Path) -> None:
    """Labels and the name of the log, in captions, in the log of events and in the summary, which is Markdown."""
    from rerun.chunk import RrdReader

    result, truth = synthetic_result(np.random.default_rng(0).uniform(0, 10, (len(LABELS), 3)), LABELS, keyframes=2)
    write_recording(
        dataclasses.replace(result, summary={**result.summary, "log": "".join(LABELS)}), tmp_path / "a.rrd", truth
    )
    words = []
    for chunk in RrdReader(tmp_path / "a.rrd").stream().to_chunks():
        batch = chunk.to_record_batch()
        for field, column in zip(batch.schema, batch.columns, strict=True):
            if str(field.type) in ("string", "list<item: string>"):
                rows = [[row] if isinstance(row, str) else row or [] for row in column.to_pylist()]
                words += [(chunk.entity_path, word) for row in rows for word in row]
    assert len(words) > len(LABELS)
    assert not [(where, word) for where, word in words if unclean(word)]


def test_markdown_shows_the_text_itself() -> None:
    for text in NASTY:
        assert not re.search(r"(?<!\\)(?:\\\\)*[\[<|`*!]", markdown(text).replace("\\\\", ""))
        assert not unclean(markdown(text))
        assert "\n" not in markdown(text)


def test_a_nasty_argument(objslam: Callable[..., tuple[str, str]], tmp_path: Path) -> None:
    for text in ("no\x1b[31m[red]such", "no\u202e[/]such", "no:smile:\x07such", "no\nsuch"):
        _, err = objslam("info", tmp_path / text, code=1)
        assert len(err.strip().splitlines()) == 1
        _, err = objslam("run", tmp_path, "--set", f"{text}=1", code=2)
        objslam("run", tmp_path, "--mode", text, code=2)
    shutil.rmtree(tmp_path)
