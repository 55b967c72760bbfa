"""UTIAS MRCLAM 6: the map of three real robots, poses and landmarks together from wheel odometry and a camera."""

import numpy as np
import pytest
from mrclam import mapped

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.object_map import ObjectMap
from objslam.core.types import Trajectory
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.sources import SourceOptions, read

RADIUS = 2.0  # m; labels say who is whom, the error is what is asked


@pytest.mark.parametrize("robot", [1, 3, 5])
@pytest.mark.parametrize(("with_range", "position", "path"), [(False, 0.25, 0.35), (True, 0.10, 0.35)])
def test_landmarks_and_path(data_dir, robot, with_range, position, path):
    log, result, ledger = mapped(data_dir, robot, with_range)
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    found = evaluate(
        result.map, log.truth, Trajectory(stamps, result.map_T_base[first]), align="se2", radius=RADIUS
    ).to_dict()
    assert (found["matched"], found["missed"], found["false"], found["unresolved"]) == (15, 0, 0, 0)
    assert found["position_rmse"] <= position
    assert found["ate"] <= path
    assert not any("no single solution" in warning for warning in ledger.warnings)
    assert np.isfinite(result.rays.range).all() == with_range


@pytest.mark.parametrize("robot", [1, 3, 5])
def test_the_start_was_far_off(data_dir, robot):
    """Dead reckoning alone: what the joint solve has to correct, and that the bars above are none that it meets."""
    log = read(data_dir / "mrclam_ds6", Ledger(), SourceOptions(robot=robot, with_range=False))
    found = evaluate(ObjectMap(()), log.truth, log.odometry, align="se2").to_dict()
    assert found["ate"] > 1.0


@pytest.mark.long
def test_landmarks_without_names(data_dir):
    """Fifteen posts, in clusters 17 cm apart, all called the same: loops are closed by how they stand to each other."""
    log = read(data_dir / "mrclam_ds6", Ledger(), SourceOptions(robot=1, anonymous=True))
    result = pipeline.run(log, load_settings(None, ("mode=joint", "output.recording=false")), Ledger())
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    path = Trajectory(stamps, result.map_T_base[first])
    found = evaluate(result.map, log.truth, path, align="se2", radius=0.3).to_dict()
    assert found["matched"] >= 12
    assert found["false"] <= 2
    assert found["ate"] <= 0.35
