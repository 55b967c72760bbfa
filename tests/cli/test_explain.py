"""What `objslam explain` prints of the doubts in a result."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from synthetic_result import clusters, synthetic_result

from objslam.cli import main
from objslam.cli.explain import doubts_table
from objslam.config import Output, Settings
from objslam.core.result import Doubt
from objslam.io.results.read import load_doubts
from objslam.output.result_folder import write_result

TEXT = "191 cup boxes near (0.24, -0.07, 1.94): their rays miss a common point by 6 cm, and 3 sigma are 2 cm."
CUPS = Doubt("boxes", "apart", "cup", TEXT, (), np.array([0.24, -0.07, 1.94]), np.arange(191), {"miss_m": 0.0612345678})
PAIR = Doubt("pair", "may be one", "mug", "mug #1 and mug #4 may be one.", (1, 4), None, np.arange(7), {"sigmas": np.nan})


@pytest.fixture
def explain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    result, _ = synthetic_result(*clusters(), keyframes=20, settings=Settings(output=Output(recording=False, picture=False)))
    write_result(replace(result, doubts=(PAIR, CUPS)), tmp_path / "out")
    write_result(result, tmp_path / "sure")

    def call(folder: str, *words: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["objslam", "explain", str(tmp_path / folder), *words])
        with pytest.raises(SystemExit) as ended:
            main()
        told = capsys.readouterr()
        return int(ended.value.code or 0), told.out, told.err

    return call


def test_the_doubts_of_a_result_are_said_in_sentences(explain: Any) -> None:
    code, out, _ = explain("out")
    assert code == 0
    words = " ".join(out.split())
    assert "objects that may be one" in words
    assert "191 cup boxes near (0.24, -0.07, 1.94): their rays miss a common point by 6 cm, and 3 sigma are 2 cm." in words
    _, out, _ = explain("out", "--label", "mug")
    assert "cup" not in out
    assert "mug #1 and mug #4 may be one." in out


def test_no_doubt_is_said_too(explain: Any) -> None:
    assert explain("sure")[:2] == (0, "no doubts\n")
    sure = clusters()[1][0]
    assert explain("sure", "--label", sure)[:2] == (0, f"no doubts about {sure}\n")


def test_the_boxes_that_became_no_object_are_counted(explain: Any, tmp_path: Path) -> None:
    for folder, boxes in (("out", 200), ("sure", 82)):
        file = tmp_path / folder / "summary.json"
        summary = json.loads(file.read_text())
        summary["counts"]["rays_unexplained"] = boxes
        file.write_text(json.dumps(summary))
    assert "200 boxes became no object: 191 in these groups, and 9 scattered" in " ".join(explain("out")[1].split())
    assert explain("sure")[1].endswith("82 boxes became no object: all scattered\n")


def test_a_label_that_the_result_lacks_is_an_error_that_names_those_there(explain: Any) -> None:
    for words in ((), ("--json",)):
        code, out, err = explain("out", "--label", "zebra", *words)
        assert (code, out, len(err.splitlines())) == (2, "", 1)
        assert "zebra" in err
        assert all(label in err for label in (*clusters()[1], "cup", "mug"))


def test_json_is_what_the_file_has(explain: Any, tmp_path: Path) -> None:
    _, out, _ = explain("out", "--json")
    told = json.loads(out)
    assert told == json.loads((tmp_path / "out" / "doubts.json").read_text())["doubts"]
    assert told[1]["text"] == TEXT
    assert told[1]["numbers"] == {"miss_m": 0.061235}
    labels = ("cup", clusters()[1][0])
    assert [len(json.loads(explain("out", "--json", "--label", label)[1])) for label in labels] == [1, 0]


def test_a_file_is_read_back(explain: Any, tmp_path: Path) -> None:
    first, second = load_doubts(tmp_path / "out") or ()
    assert (first.kind, first.objects, first.position) == ("pair", (1, 4), None)
    assert np.isnan(first.numbers["sigmas"])
    assert (second.text, second.numbers["miss_m"]) == (TEXT, 0.061235)
    assert (second.rays == CUPS.rays).all()
    assert (second.position == CUPS.position).all()


def test_a_result_of_an_older_version_or_a_damaged_one_is_an_error(explain: Any, tmp_path: Path) -> None:
    file = tmp_path / "out" / "doubts.json"
    file.write_text('{"doubts": [{"kind": "whim"}]}')
    code, _, err = explain("out")
    assert code == 1
    assert "doubts.json" in err
    assert "kind" in err
    file.unlink()
    code, _, err = explain("out")
    assert code == 1
    assert "run it again" in err
    assert load_doubts(tmp_path / "out") is None


def test_a_table_fits_80_columns_and_loses_no_word() -> None:
    screen = Console(file=io.StringIO(), width=80)
    screen.print(doubts_table([CUPS, replace(CUPS, label="a label of many words")], "boxes"))
    lines = screen.file.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert " ".join(" ".join(line.split("│")[2] for line in lines if line.startswith("│")).split()) == f"{TEXT} {TEXT}"


def test_cut_off_boxes_of_a_label_are_counted_also_if_it_has_no_other_boxes(explain: Any, tmp_path: Path) -> None:
    file = tmp_path / "out" / "summary.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "cut_off": {"sofa": 2, "mug": 9}}))
    assert explain("out", "--label", "sofa")[:2] == (
        0,
        "no doubts about sofa\nthe image's edge cuts off 2 boxes of sofa, so they give no rays (rays.border, "
        "rays.border_share)\n",
    )
    assert "cuts off 9 boxes of mug" in explain("out", "--label", "mug")[1]
    assert "cuts off" not in explain("out")[1]
