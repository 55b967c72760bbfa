"""TUM fr3_cabinet, hand-held, with true camera poses: where the one object stands."""

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.mapping import pipeline
from objslam.sources import SourceOptions, read

CHI2_95 = 7.815  # chi-squared, 3 degrees of freedom
CABINET = np.array([-1.520, 0.454])
"""m; the centre of the depth images fused with the true poses, seen from above."""

NO_SURFACE = ("reconstruction.use=false", "output.recording=false")
"""The surface is made after the map, and one test looks at it."""


@pytest.mark.parametrize("overrides", [(), ("depth.use=false",), ("fixed.loss=huber",)])
def test_the_cabinet(data_dir, overrides):
    log = read(data_dir / "cube_slam", Ledger(), SourceOptions(label="cabinet"))
    ledger = Ledger()
    result = pipeline.run(log, load_settings(None, ("mode=fixed", *NO_SURFACE, *overrides)), ledger)
    (cabinet,) = result.map.resolved()
    assert not any("miss their objects" in warning for warning in ledger.warnings)
    assert cabinet.label == "cabinet"
    assert np.linalg.norm(cabinet.position[:2] - CABINET) <= 0.04
    assert 0 < cabinet.position[2] < 1.0
    assert cabinet.rays >= 30


def test_the_joint_mode_leaves_good_poses_where_they_are(data_dir):
    log = read(data_dir / "cube_slam", Ledger(), SourceOptions(label="cabinet"))
    result = pipeline.run(log, load_settings(None, ("mode=joint", *NO_SURFACE)), Ledger())
    moved = np.linalg.norm((result.map_T_base - result.keyframes.map_T_base)[:, :3, 3], axis=1)
    assert moved.max() < 0.05
    (cabinet,) = result.map.resolved()
    assert np.linalg.norm(cabinet.position[:2] - CABINET) <= 0.06


def test_the_cabinet_stands_in_its_own_surface(data_dir):
    """The fused surface of the cabinet, the floor left out, holds the object; and its middle is what the poses say."""
    log = read(data_dir / "cube_slam", Ledger(), SourceOptions(label="cabinet"))
    result = pipeline.run(log, load_settings(None, ("mode=fixed",)), Ledger())
    assert result.surface is not None
    vertices = result.surface.vertices
    floor = np.median(vertices[:, 2])
    assert abs(floor) < 0.03
    near = np.linalg.norm(vertices[:, :2] - CABINET, axis=1) < 0.8
    cabinet = vertices[near & (vertices[:, 2] > floor + 0.06)]
    low, high = np.quantile(cabinet, [0.005, 0.995], axis=0)
    (placed,) = result.map.resolved()
    assert (low < placed.position).all()
    assert (placed.position < high).all()
    assert np.linalg.norm((low + high)[:2] / 2 - CABINET) < 0.05
    assert (high - low).max() < 1.0
    # The boxes alone give the body: its centre, its sizes and their sigmas against the surface from the floor to the top.
    top = high[2]
    off = placed.position - np.append((low + high)[:2] / 2, top / 2)
    assert np.linalg.norm(off[:2]) <= 0.03
    assert abs(off[2]) <= 0.05
    assert off @ np.linalg.solve(placed.covariance, off) < CHI2_95
    assert placed.body.shape == "cuboid"
    assert np.abs(placed.body.size / np.append((high - low)[:2], top) - 1).max() < 0.2
