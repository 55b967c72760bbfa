"""UTIAS MRCLAM 6: the map of three real robots, poses and landmarks together from wheel odometry and a camera."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from log_parts import part
from mrclam import mapped

from objslam.association.registration.object_maps import register
from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import align
from objslam.core.maps.shared_covariance import jacobian
from objslam.core.object_map import ObjectMap
from objslam.core.trajectory import Trajectory
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.mapping.sites.merge import merge_sessions
from objslam.mapping.sites.session import Session
from objslam.sources import SourceOptions, read

RADIUS = 2.0  # m; labels say who is whom, the error is what is asked


@pytest.mark.long
@pytest.mark.parametrize(
    ("robot", "with_range", "position"),
    [(1, False, 0.25), (3, False, 0.25), (1, True, 0.10), (3, True, 0.10), (5, True, 0.10)],
)
def test_landmarks_and_path(data_dir, robot, with_range, position):
    log, result, ledger = mapped(data_dir, robot, with_range)
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    found = evaluate(
        result.map, log.truth, Trajectory(stamps, result.map_T_base[first]), align="se2", radius=RADIUS
    ).to_dict()
    assert (found["matched"], found["missed"], found["false"], found["unresolved"]) == (15, 0, 0, 0)
    assert found["position_rmse"] <= position
    assert found["ate"] <= 0.35
    assert not any("no single solution" in warning for warning in ledger.warnings)
    assert np.isfinite(result.rays.range).all() == with_range


@pytest.mark.parametrize("robot", [1, 3, 5])
def test_the_start_was_far_off(data_dir, robot):
    """Dead reckoning alone: what the joint solve has to correct, and that the bars above are none that it meets."""
    log = read(data_dir / "mrclam_ds6", Ledger(), SourceOptions(robot=robot, with_range=False))
    found = evaluate(ObjectMap(()), log.truth, log.odometry, align="se2").to_dict()
    assert found["ate"] > 1.0


@pytest.mark.long
def test_a_landmark_that_was_born_metres_off_does_not_bend_the_path(data_dir):
    """Eight minutes, ten landmarks with names, bearings only. Two landmarks entered the first graph 2 m beside their places.

    The path bent to their rays, and the map was `good`, with errors of up to 2 m and sigmas of 0.3 m.
    """
    whole = read(data_dir / "mrclam_ds6", Ledger(), SourceOptions(robot=3, with_range=False))
    log = part(whole, 90.0, 580.0)
    (camera,) = log.cameras
    names = ("6", "7", "9", "12", "13", "14", "15", "16", "18", "20")
    seen = camera.detections.take(
        np.isin(camera.detections.label, [camera.detections.label_names.index(f"landmark_{n}") for n in names])
    )
    log = replace(log, cameras=(replace(camera, detections=seen),))
    result = pipeline.run(log, load_settings(None, ("mode=joint", "output.recording=false")), Ledger())
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    found = evaluate(
        result.map, log.truth, Trajectory(stamps, result.map_T_base[first]), align="se2", radius=RADIUS
    ).to_dict()
    assert found["matched"] == 10
    assert found["false"] == 0
    assert found["position_rmse"] <= 0.2


@pytest.mark.long
def test_landmarks_without_names(data_dir):
    """Fifteen posts, in clusters 17 cm apart, all called the same: loops are closed by how they stand to each other.

    In these 300 s, the robot sees 14 of them at least nine times. `tools/bench_recordings.py --parts unnamed` maps whole
    drives.
    """
    whole = read(data_dir / "mrclam_ds6", Ledger(), SourceOptions(robot=1, anonymous=True))
    log = part(whole, 200.0, 500.0)
    result = pipeline.run(log, load_settings(None, ("mode=joint", "output.recording=false")), Ledger())
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    path = Trajectory(stamps, result.map_T_base[first])
    found = evaluate(result.map, log.truth, path, align="se2", radius=0.3).to_dict()
    assert found["matched"] >= 14
    assert found["false"] <= 1
    assert found["ate"] <= 0.2


def of_truth(objects, truth):
    """The positions of the map, and the true ones moved onto it."""
    known = {o.label: o.position for o in truth.objects}
    at = np.array([known[o.label] for o in objects])
    pose = align(at, objects.positions, "se2")[0]
    return objects.positions, at @ pose[:3, :3].T + pose[:3, 3]


@pytest.mark.long
def test_three_robots_without_a_common_frame_are_one_map(data_dir):
    """Three drives in frames of their own. Their own errors and their shared ones hold the truth of the whole map, as one
    vector: the covariances of objects alone would be too wide for it, those of one graph of all keyframes far too small."""
    sessions = []
    for robot in (1, 3, 5):
        log, result, _ = mapped(data_dir, robot, True)
        sessions.append(Session(f"robot {robot}", result.map))
        found, true = of_truth(result.map, log.truth)
        moves = jacobian(found)
        shared = result.map.shared_covariance
        own = result.map.covariances - moves @ shared @ np.swapaxes(moves, 1, 2)
        count = len(found)
        whole = np.einsum("iak,kl,jbl->iajb", moves, shared, moves)
        whole[np.arange(count), :, np.arange(count), :] += own
        level = np.arange(3 * count).reshape(count, 3)[:, :2].ravel()
        inverse = np.linalg.inv(whole.reshape(3 * count, -1)[np.ix_(level, level)])
        frame = moves[:, :2][:, :, [0, 1, 5]].reshape(2 * count, 3)  # The alignment is a free choice.
        off = (found - true)[:, :2].ravel()
        left = off - frame @ np.linalg.solve(frame.T @ inverse @ frame, frame.T @ inverse @ off)
        assert 0.2 < left @ inverse @ left / (2 * count - 3) < 2.0
    (island,) = merge_sessions(sessions)
    found, true = of_truth(island.objects, log.truth)
    off = found - true
    assert len(island.objects) == 15
    assert all(o.life.sessions_seen == 3 for o in island.objects)
    assert np.sqrt((off**2).sum(axis=1).mean()) <= 0.05
    squared = np.einsum("ni,ni->n", off, np.linalg.solve(island.objects.covariances, off[..., None])[..., 0])
    assert (squared < 7.815).all()


@pytest.mark.long
def test_three_robots_are_one_map_also_without_names(data_dir):
    """The same maps, with one label for all landmarks. They stand in clusters 17 cm apart."""
    sessions = []
    for robot in (1, 3, 5):
        named = mapped(data_dir, robot, True)[1].map
        equal = tuple(replace(o, label="landmark", labels=None) for o in named)
        sessions.append(Session(f"robot {robot}", replace(named, objects=equal)))
    for a, b in permutations(sessions, 2):
        found = register(a.objects, b.objects)
        assert found.accepted
        # The maps have their objects in the order of names.
        np.testing.assert_array_equal(found.matches[:, 0], found.matches[:, 1])
    (island,) = merge_sessions(sessions)
    assert len(island.objects) == 15
    assert all(o.life.sessions_seen == 3 for o in island.objects)
