"""The settings in configs/: each is read and maps the simulated drive, and each does what its header promises."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quick import HELD
from scipy.optimize import minimize

from objslam.config import Settings, load_settings
from objslam.config.presets import find_config, presets
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import exp_se3
from objslam.core.result import RunResult
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log, Truth
from objslam.errors import ConfigError
from objslam.evaluation.alignment import Alignment
from objslam.evaluation.evaluate import ObjectScores, evaluate
from objslam.mapping.pipeline import run
from objslam.simulation import preset, simulate
from objslam.simulation.settings import DepthNoise

pytestmark = pytest.mark.usefixtures("one_start")
CONFIGS = Path(__file__).resolve().parent.parent / "configs"
NAMES = sorted(file.name for file in CONFIGS.glob("*.yaml"))


def test_each_comes_with_the_package_and_is_taken_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The package has the same files. A file of that name in the working folder counts before them, a folder does not."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "paper").mkdir()
    (tmp_path / "tags").write_text("mode: joint")
    for name in NAMES:
        word = name.removesuffix(".yaml")
        found = find_config(Path(word))
        assert found == Path("tags") if word == "tags" else found.read_bytes() == (CONFIGS / name).read_bytes()
    with pytest.raises(ConfigError, match=f"no such file .ready settings: {', '.join(sorted(presets()))}"):
        find_config(Path("nosuch"))


@pytest.fixture(scope="module")
def drive() -> Log:
    return simulate(preset("demo", frames=200), 0)


@pytest.fixture(scope="module")
def drive_with_depth() -> Log:
    return simulate(preset("demo", frames=200, depth=DepthNoise()), 0)


@pytest.fixture(scope="module")
def by_paper(drive: Log) -> RunResult:
    """The map of the drive with the settings of the paper."""
    return run(drive, settings("paper.yaml"), Ledger())


def settings(name: str, *overrides: str) -> Settings:
    return load_settings(CONFIGS / name, overrides)


def scores(result: RunResult, log: Log, align: Alignment = "none") -> ObjectScores:
    objects = evaluate(result.map, log.truth, result.path_after, align=align).objects
    assert objects is not None
    return objects


def rmse(result: RunResult, log: Log, align: Alignment = "none") -> float:
    return float(np.sqrt((scores(result, log, align).errors ** 2).mean()))


def sum_of_distances(point: Floats, m: Floats, n: Floats) -> float:
    """Eq. 1, as it is written."""
    return float(np.linalg.norm(np.cross(point - m, n), axis=1).sum())


def first_frames(log: Log, number: int) -> Log:
    (camera,) = log.cameras
    boxes = camera.detections
    assert boxes is not None
    few = replace(boxes.take(boxes.frame < number), frame_stamps=boxes.frame_stamps[:number])
    return replace(log, cameras=(replace(camera, detections=few),))


def test_the_settings_that_the_readme_names_are_there() -> None:
    assert {"paper.yaml", "odometry.yaml", "handheld.yaml", "rgbd.yaml"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_each_says_what_it_is_for_and_how_it_is_run(name: str) -> None:
    lines = (CONFIGS / name).read_text(encoding="utf-8").splitlines()
    header = lines[: next(i for i, line in enumerate(lines) if not line.startswith("#"))]
    assert header
    word = re.escape(name.removesuffix(".yaml"))
    assert any(re.match(rf"# +objslam run .*--config {word}(?= |$)", line) for line in header)


def test_no_page_takes_ready_settings_by_a_path_that_only_a_checkout_has() -> None:
    for page in (*CONFIGS.parent.glob("docs/*.md"), CONFIGS.parent / "README.md"):
        assert "--config configs/" not in page.read_text(encoding="utf-8"), page.name


@pytest.fixture(scope="module")
def drive_among_tags() -> Log:
    """Every object has a label of its own."""
    return simulate(preset("demo", frames=200, classes=12), 0)


@pytest.mark.parametrize("name", NAMES)
def test_each_maps_the_simulated_drive(name: str, drive: Log, drive_among_tags: Log, by_paper: RunResult) -> None:
    drive = drive_among_tags if settings(name).association.method == "by_label" else drive
    result = by_paper if name == "paper.yaml" else run(drive, settings(name), Ledger())
    found = scores(result, drive)
    assert len(found.matches) == 12
    assert not found.false
    assert found.errors.max() < 0.05
    assert settings(name).mode in (result.summary["mode"], "auto")


def test_paper_finds_the_least_sum_of_distances(by_paper: RunResult) -> None:
    for j, o in enumerate(by_paper.map.objects):
        mine = by_paper.association.object == j
        m, n = by_paper.origins[mine], by_paper.directions[mine]
        best = minimize(
            sum_of_distances,
            m.mean(axis=0) + 2 * n.mean(axis=0),
            args=(m, n),
            method="Nelder-Mead",
            options={"xatol": 1e-8, "fatol": 1e-12, "maxiter": 4000, "maxfev": 4000},
        )
        np.testing.assert_allclose(o.position, best.x, atol=1e-5)


def test_paper_uses_no_depth(drive_with_depth: Log, by_paper: RunResult) -> None:
    """Both drives are the same but for the depths."""
    with_depth = run(drive_with_depth, settings("paper.yaml"), Ledger())
    np.testing.assert_array_equal([o.position for o in with_depth.map.objects], [o.position for o in by_paper.map.objects])


def test_odometry_needs_no_localisation(drive: Log) -> None:
    log = replace(drive, localization=None)
    result = run(log, settings("odometry.yaml"), Ledger())
    found = scores(result, log, "se2")
    assert len(found.matches) == 12
    assert not found.false
    assert rmse(result, log, "se2") < 0.05
    # the same path as it is, uncorrected
    assert rmse(run(log, settings("odometry.yaml", "mode=fixed", *HELD), Ledger()), log, "se2") > 0.1


def test_handheld_takes_paths_that_leave_the_plane(drive: Log) -> None:
    """Seen from a map that is tilted, the same drive climbs, rolls and pitches, and its objects stand elsewhere."""
    turn = exp_se3(np.array([[0.5, -0.4, 1.0, 1.0, 2.0, 3.0]]))[0]
    path, truth = drive.localization, drive.truth
    assert path is not None
    assert truth is not None
    moved = tuple(replace(o, position=turn[:3, :3] @ o.position + turn[:3, 3]) for o in truth.objects)
    log = replace(drive, localization=Trajectory(path.stamps, turn @ path.poses), odometry=None, truth=Truth(objects=moved))
    found = scores(run(log, settings("handheld.yaml"), Ledger()), log)
    assert len(found.matches) == 12
    assert found.errors.max() < 0.05


def test_rgbd_places_what_was_seen_from_one_side_only(drive_with_depth: Log) -> None:
    log = first_frames(drive_with_depth, 8)
    with_depth = run(log, settings("rgbd.yaml"), Ledger())
    without = run(log, settings("rgbd.yaml", "depth.use=false"), Ledger())
    assert len(scores(with_depth, log).matches) > len(scores(without, log).matches)
    assert scores(with_depth, log).errors.max() < 0.3


def test_rgbd_uses_depth_with_fixed_poses_too(drive_with_depth: Log) -> None:
    result = run(drive_with_depth, settings("rgbd.yaml", "mode=fixed"), Ledger())
    plain = run(drive_with_depth, settings("rgbd.yaml", "mode=fixed", "depth.use=false"), Ledger())
    assert rmse(result, drive_with_depth) < rmse(plain, drive_with_depth)


def test_the_models_that_headers_name_are_there():
    """A header shows a command to type in a checkout."""
    named = {path for file in CONFIGS.glob("*.yaml") for path in re.findall(r"--detector (objslam/\S+)", file.read_text())}
    assert named
    assert all((CONFIGS.parent / path).is_file() for path in named)
