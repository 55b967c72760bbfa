"""The evaluation of a result folder: its truth, and the alignment that the frame of its map needs."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from quick import HELD, NOTHING_DRAWN
from rich.console import Console
from scenes import show
from scipy.spatial.transform import Rotation
from synthetic_result import clusters, synthetic_result

from objslam.config import Output, Settings, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import make_pose
from objslam.core.trajectory import Trajectory
from objslam.errors import LogError
from objslam.evaluation.evaluate_folder import choose_alignment, evaluate_folder, write_evaluation
from objslam.evaluation.table import evaluation_table
from objslam.io.objects_json import dump_truth_objects
from objslam.mapping import pipeline
from objslam.output.result_folder import write_result
from objslam.simulation import preset, simulate

pytestmark = pytest.mark.usefixtures("one_start")


def test_what_was_compared_with_is_named(tmp_path: Path) -> None:
    result, truth = synthetic_result(
        *clusters(), keyframes=5, settings=Settings(output=Output(recording=False, picture=False))
    )
    out, other = tmp_path / "mine", tmp_path / "other"
    write_result(result, out, truth)
    write_result(result, other)
    for path, kept, title in ((None, None, "against the ground truth"), (other / "objects.json",) * 3):
        write_evaluation(evaluation := evaluate_folder(out, path), out)
        assert json.loads((out / "evaluation.json").read_text())["truth"] == (kept and str(kept))
        console = Console(width=500, markup=False, record=True, quiet=False)
        console.print(evaluation_table(evaluation))
        assert str(title) in console.export_text()


def test_where_no_truth_was_found_is_named(tmp_path: Path) -> None:
    settings = Settings(output=Output(recording=False, picture=False))
    write_result(synthetic_result(*clusters(), keyframes=5, settings=settings)[0], tmp_path / "out")
    (tmp_path / "log").mkdir()
    with pytest.raises(LogError, match=r"looked for groundtruth/objects\.json or groundtruth/trajectory\.txt") as caught:
        evaluate_folder(tmp_path / "out", tmp_path / "log")
    assert caught.value.where == str(tmp_path / "log")
    with pytest.raises(LogError, match="has no ground truth") as caught:
        evaluate_folder(tmp_path / "out")
    assert caught.value.where == str(tmp_path / "out")
    (tmp_path / "empty.json").write_text(dump_truth_objects(()))
    with pytest.raises(LogError, match=r"empty\.json: the ground truth is empty"):
        evaluate_folder(tmp_path / "out", tmp_path / "empty.json")


@pytest.mark.parametrize(
    ("said", "kind", "why"),
    [
        ({"map_frame": "localization", "planar": True}, "none", "localisation"),
        ({"map_frame": "odometry", "planar": True}, "se2", "odometry"),
        ({"map_frame": "odometry", "planar": False}, "se3", "not planar"),
        ({}, "none", "does not say"),
    ],
)
def test_auto_aligns_what_has_a_frame_of_its_own(tmp_path: Path, said: dict[str, object], kind: str, why: str) -> None:
    result, truth = synthetic_result(
        *clusters(), keyframes=5, settings=Settings(output=Output(recording=False, picture=False))
    )
    write_result(dataclasses.replace(result, summary={**result.summary, **said}), tmp_path, truth)
    evaluation = evaluate_folder(tmp_path)
    assert evaluation.align == kind
    assert why in evaluation.why
    assert json.loads(json.dumps(evaluation.to_dict()))["align_reason"] == evaluation.why
    assert why in " ".join(show(evaluation).split())
    asked = evaluate_folder(tmp_path, align="sim2")
    assert (asked.align, asked.why) == ("sim2", "as asked")


@pytest.mark.parametrize(
    ("poses", "tilted", "kind"), [("localization", 0, "none"), ("odometry", 0, "se2"), ("odometry", 1, "se3")]
)
def test_a_run_says_in_which_frame_its_map_is(tmp_path: Path, poses: str, tilted: int, kind: str) -> None:
    log = simulate(preset("demo", frames=100, objects=6, classes=6), 0)
    assert log.odometry is not None
    angles = 0.01 * tilted * np.sin(log.odometry.stamps)
    rocking = make_pose(Rotation.from_euler("y", angles[:, None]).as_matrix(), np.zeros((1, 3)))
    log = dataclasses.replace(log, odometry=Trajectory(log.odometry.stamps, log.odometry.poses @ rocking))
    quick = load_settings(None, (f"poses.use={poses}", *HELD, *NOTHING_DRAWN))
    write_result(pipeline.run(log, quick, Ledger()), tmp_path, log.truth)
    assert choose_alignment(tmp_path)[0] == kind
