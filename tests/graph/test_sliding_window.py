"""A graph that is solved over a window of its last keyframes."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from drives import ODOMETRY_ALONE, Drive, make_drive

from objslam.graph import sliding_window
from objslam.graph.assembly import Measurements
from objslam.graph.optimizers import build_graph, levenberg_marquardt
from objslam.graph.sliding_window import SlidingWindow
from objslam.graph.variables import make_values, read_poses

STEP = 10


def at_truth(seed: int = 0, **changes) -> tuple[Drive, SlidingWindow]:
    """A drive in the frame of the truth, and its window, which begins with the true poses and points."""
    drive = make_drive(seed, "mode=joint", false=0.0, missed=0.0, **{**ODOMETRY_ALONE, **changes})
    keyframes = replace(drive.keyframes, map_T_base=drive.map_T_base)
    drive = replace(drive, keyframes=keyframes)
    measured = Measurements.of(keyframes, drive.rays, drive.settings)
    return drive, SlidingWindow(measured, drive.association.object, drive.association.count)


def extended(drive: Drive, window: SlidingWindow, end: int) -> None:
    """Add the keyframes before `end` with all their rays, and the landmarks that they see first, at the truth."""
    begin = window.end
    rays = np.flatnonzero((drive.rays.keyframe >= begin) & (drive.rays.keyframe < end))
    seen = np.unique(drive.association.object[rays])
    born = seen[np.isnan(window.positions[seen, 0])]
    window.positions[born] = drive.points[born]
    window.extend(end, rays, born, np.tile(np.eye(3), (len(born), 1, 1)))


def whole_solution(drive: Drive, end: int) -> np.ndarray:
    """The camera poses (end, 4, 4) of a batch solve of the first keyframes, from the truth."""
    measured = Measurements.of(drive.keyframes, drive.rays, drive.settings)
    rays = np.flatnonzero((drive.rays.keyframe > 0) & (drive.rays.keyframe < end))
    landmarks = np.unique(drive.association.object[rays])
    graph = build_graph(measured.factors(drive.association.object, rays, landmarks, drive.points, end=end))
    values = make_values(drive.keyframes.map_T_camera[:end], drive.points, landmarks)
    return read_poses(levenberg_marquardt(graph, values, 100).values)


def grow(drive: Drive, window: SlidingWindow) -> list[np.ndarray]:
    """Grow to the end. Return the poses after each step."""
    paths = []
    for end in [*range(1 + STEP, len(drive.keyframes), STEP), len(drive.keyframes)]:
        extended(drive, window, end)
        window.solve(20)
        paths.append(window.map_T_camera[:end].copy())
    return paths


def apart(one: np.ndarray, other: np.ndarray) -> float:
    """The largest distance (m) between the places of two paths."""
    return float(np.linalg.norm(one[:, :3, 3] - other[:, :3, 3], axis=1).max())


def test_the_complete_graph_is_solved_as_a_whole():
    drive, window = at_truth()
    paths = grow(drive, window)
    assert apart(paths[-1], whole_solution(drive, len(drive.keyframes))) < 1e-3


def test_a_window_is_near_the_solution_of_the_whole_graph(monkeypatch):
    """What left the window keeps its poses, and as a prior it tells about as much as its measurements."""
    monkeypatch.setattr(sliding_window, "_GROWTH", np.inf)  # no whole solve but the last
    monkeypatch.setattr(sliding_window, "_WINDOW", 30)
    drive, window = at_truth()
    paths = grow(drive, window)
    for path in paths[6:-1:3]:
        reference = whole_solution(drive, len(path))
        moved = apart(reference, drive.keyframes.map_T_camera[: len(path)])
        assert apart(path[-STEP:], reference[-STEP:]) < 0.5 * moved


def test_keyframes_before_the_window_stay(monkeypatch):
    monkeypatch.setattr(sliding_window, "_GROWTH", np.inf)
    monkeypatch.setattr(sliding_window, "_WINDOW", 30)
    drive, window = at_truth()
    paths = grow(drive, window)[:-1]
    for before, after in pairwise(paths[5:]):
        begin = len(before) - 30
        np.testing.assert_array_equal(after[: begin - 1], before[: begin - 1])
        assert apart(after[begin:-STEP], before[begin:]) > 0


@pytest.mark.parametrize("growth", [2.0, np.inf])
def test_the_graph_of_a_step_does_not_grow_with_the_path(monkeypatch, growth):
    monkeypatch.setattr(sliding_window, "_GROWTH", growth)
    monkeypatch.setattr(sliding_window, "_WINDOW", 30)
    sizes: list[int] = []

    def counted(graph, *rest):
        sizes.append(len([key for key in graph.keyVector() if key >= sliding_window.X0]))
        return levenberg_marquardt(graph, *rest)

    monkeypatch.setattr(sliding_window, "levenberg_marquardt", counted)
    drive, window = at_truth()
    grow(drive, window)
    whole = [size for size in sizes if size > 30 + STEP + 1]
    assert len(whole) <= 1 + np.log2(len(drive.keyframes) / (30 + STEP)) if growth == 2.0 else len(whole) == 1
    assert sizes[-1] == len(drive.keyframes)


def test_a_landmark_that_ends_at_a_camera_leaves_the_graph(monkeypatch):
    """Nearer and nearer to a camera, its bearings would outweigh everything, and make the linear system singular."""
    monkeypatch.setattr(sliding_window, "_WINDOW", 30)
    drive, window = at_truth()
    end = 1 + 4 * STEP
    extended(drive, window, end)
    window.solve(20)
    bad = int(np.flatnonzero(np.isfinite(window.positions[:, 0]))[0])
    taken = []

    def collapsing(graph, values, *rest):
        optimum = levenberg_marquardt(graph, values, *rest)
        if not taken:
            taken.append(True)
            optimum.values.update(sliding_window.L0 + bad, read_poses(optimum.values)[5, :3, 3] + 1e-9)
        return optimum

    monkeypatch.setattr(sliding_window, "levenberg_marquardt", collapsing)
    extended(drive, window, end + STEP)
    window.solve(20)
    assert np.isnan(window.positions[bad]).all()
    rays = np.flatnonzero((drive.association.object != bad) & (drive.rays.keyframe > 0))
    for last in [*range(end + 2 * STEP, len(drive.keyframes), STEP), len(drive.keyframes)]:
        some = rays[(drive.rays.keyframe[rays] >= window.end) & (drive.rays.keyframe[rays] < last)]
        born = np.setdiff1d(np.unique(drive.association.object[some]), np.flatnonzero(np.isfinite(window.positions[:, 0])))
        window.positions[born] = drive.points[born]
        window.extend(last, some, born, np.tile(np.eye(3), (len(born), 1, 1)))
        window.solve(20)
    measured = Measurements.of(drive.keyframes, drive.rays, drive.settings)
    landmarks = np.unique(drive.association.object[rays])
    graph = build_graph(measured.factors(drive.association.object, rays, landmarks, drive.points))
    values = make_values(drive.keyframes.map_T_camera, drive.points, landmarks)
    assert apart(window.map_T_camera, read_poses(levenberg_marquardt(graph, values, 100).values)) < 1e-3


def test_a_point_is_at_a_camera_if_any_camera_is_near_enough():
    """Among many cameras, against all distances; some stand in a line across the path, and some in the same place."""
    rng = np.random.default_rng(0)
    points = np.column_stack([np.round(np.linspace(0, 20, 300), 1), rng.uniform(-1, 1, 300), np.zeros(300)])
    positions = np.concatenate([points[::7] + 4e-4 * rng.normal(size=(43, 3)), rng.uniform(-1, 21, (50, 3)), points[:1]])
    nearest = np.linalg.norm(positions[:, None] - points, axis=2).min(axis=1)
    found = sliding_window._at_a_point(positions, points)
    assert 20 < found.sum() < 44
    np.testing.assert_array_equal(found, nearest < sliding_window._AT_CAMERA)


def test_a_window_with_other_landmarks_is_solved_as_a_whole():
    """Two landmarks that were one thing become one. The graph is then that of all rays, as if it had grown so."""
    drive, window = at_truth()
    one = np.where(drive.rays.keyframe > 0, drive.association.object, -1)
    owner = one.copy()
    first = np.flatnonzero(owner == 0)
    owner[first[len(first) // 2 :]] = drive.association.count
    points = np.concatenate([drive.points, drive.points[:1]])
    split = SlidingWindow(window._measured, owner, len(points))
    end = len(drive.keyframes)
    split.positions[:] = points
    split.extend(end, np.flatnonzero(owner >= 0), np.arange(len(points)), np.zeros((len(points), 3, 3)))
    joined = split.regrown(one, drive.points.copy(), split.map_T_camera)
    joined.solve(100)
    assert joined.solved == end
    assert apart(joined.map_T_camera, whole_solution(drive, end)) < 1e-3
