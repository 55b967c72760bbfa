"""Mutated result folders, as somebody else may send them, in every command that reads one."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import altered, as_json, examples, mutated, survives
from synthetic_result import clusters, synthetic_result

from objslam.api.result import Result
from objslam.config import Output, Settings
from objslam.core.result import Doubt
from objslam.evaluation.evaluate_folder import evaluate_folder, write_evaluation
from objslam.io.odometry_parquet import Motions, dump_motions
from objslam.io.rays_parquet import RayFeatures, dump_features, read_features
from objslam.io.results import files
from objslam.io.results.read import load_trajectory
from objslam.output.export import write_export
from objslam.output.export.formats import FORMATS
from objslam.output.report import write_report
from objslam.output.result_folder import write_result

READERS = 3 + len(FORMATS)
"""How many commands `read_everything` gives a folder to."""


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole result with ground truth, evaluation, shared errors, motions and appearance vectors."""
    out = tmp_path_factory.mktemp("result")
    positions, labels = clusters()
    plain = Settings(mode="joint", output=Output(recording=False, picture=False))
    run, truth = synthetic_result(positions[:3], labels[:3], keyframes=12, unresolved=(2,), settings=plain)
    rays = np.arange(5)
    doubt = Doubt("boxes", "apart", "cup", "5 cup boxes.", (1,), np.ones(3), rays, {"miss_m": 0.1, "size_m": np.nan})
    write_result(replace(run, doubts=(doubt,)), out, truth)
    write_evaluation(evaluate_folder(out), out)
    summary = json.loads((out / files.SUMMARY).read_text())
    error = {"value": 0.1, "sigma": 0.01, "prior_sigma": 0.1, "unit": "share", "observable": True}
    summary |= {
        "calibration": {"parameters": {"odometry.scale": error}, "traded_off": [["a", "b"]]},
        "seconds": {"solve": 1.0},
        "assessment": {"level": "check", "reasons": ["half of the boxes are cut"]},
    }
    summary |= {
        "dropped": {"box": 1},
        "dropped_examples": {"box": ["here"]},
        "unexplained_share": {"cup": 0.1},
        "cost_before": 1.0,
    }
    (out / files.SUMMARY).write_text(json.dumps(summary))
    stamps = load_trajectory(out).stamps
    steps = len(stamps) - 1
    motions = Motions(stamps[:-1], stamps[1:], np.tile(np.eye(4), (steps, 1, 1)), np.tile(1e-4 * np.eye(6), (steps, 1, 1)))
    (out / files.MOTIONS).write_bytes(dump_motions(motions))
    (out / files.FEATURES).write_bytes(dump_features(RayFeatures(rays, np.eye(5, 8, dtype=np.float32))))
    assert read_everything(out) == [True] * READERS
    return out


def read_everything(out: Path) -> list[bool]:
    """Read a result folder with every command, and return which commands take it."""
    taken = [survives(lambda: write_report(out, crops=0)), survives(lambda: evaluate_folder(out))]
    taken += [survives(lambda: read_features(out / files.FEATURES))]
    return taken + [survives(lambda name=name: write_export(out, name)) for name in FORMATS]  # type: ignore[misc]


def with_file(result: Path, name: str, data: bytes) -> Path:
    out = result.parent / "mutated"
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(result, out)
    (out / name).write_bytes(data)
    return out


JSON_FILES = (files.SUMMARY, files.EVALUATION, files.OBJECTS, files.TRUTH_OBJECTS, files.DOUBTS)
TABLES = (files.RAYS, files.MOTIONS, files.FEATURES)


@pytest.mark.parametrize("name", JSON_FILES)
@settings(max_examples=examples(10, READERS))
@given(data=st.data())
def test_altered_json(result: Path, name: str, data: st.DataObject) -> None:
    made = data.draw(altered(json.loads((result / name).read_text())))
    read_everything(with_file(result, name, as_json(made)))


def test_optional_keys_that_are_missing(result: Path) -> None:
    summary = json.loads((result / files.SUMMARY).read_text())
    del summary["calibration"]["traded_off"], summary["assessment"]["reasons"]
    out = with_file(result, files.SUMMARY, as_json(summary))
    assert read_everything(out) == read_everything(result)
    assert Result.load(out).assessment.reasons == ()


@pytest.mark.parametrize("name", [*JSON_FILES, files.TRAJECTORY, files.CONFIG, *TABLES])
def test_mutated_bytes(result: Path, name: str) -> None:
    for data in mutated((result / name).read_bytes(), 4, READERS):
        read_everything(with_file(result, name, data))


CELLS = [None, 0.0, -1.0, 1e8, 1e300, float("nan"), float("inf"), "x", b"x", 2**62, True, [], [1.0], [1.0] * 16, [None] * 3]


@pytest.mark.parametrize("name", TABLES)
@settings(max_examples=examples(12, READERS))
@given(data=st.data())
def test_altered_tables(result: Path, name: str, data: st.DataObject) -> None:
    made = pq.read_table(result / name)
    for _ in range(data.draw(st.integers(1, 3))):
        made = with_odd_cells(made, data)
    out = with_file(result, name, b"")
    pq.write_table(made, out / name)
    read_everything(out)


def with_odd_cells(table: pa.Table, data: st.DataObject) -> pa.Table:
    """Return the table with one cell replaced by an odd one, or all cells of a column."""
    at, cell = data.draw(st.integers(0, table.num_columns - 1)), data.draw(st.sampled_from(CELLS))
    values: list[Any] = table[at].to_pylist()
    row = data.draw(st.integers(-1, len(values) - 1))
    values = [cell] * len(values) if row < 0 else [*values[:row], cell, *values[row + 1 :]]
    try:
        return table.set_column(at, table.column_names[at], pa.array(values))
    except (pa.ArrowException, TypeError, OverflowError):  # arrow has no column of such cells
        return table.remove_column(at) if table.num_columns > 1 else table
