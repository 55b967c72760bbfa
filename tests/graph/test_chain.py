"""The normal equations of chains of poses against dense matrices, and against the rows of real graphs."""

import numpy as np
import pytest
from drives import ODOMETRY_ALONE, make_drive
from numpy.testing import assert_allclose

from objslam.core.geometry import exp_se3
from objslam.graph.assembly import Measurements
from objslam.graph.least_squares import normal_equations
from objslam.graph.least_squares.chain import ChainEquations, ChainRows, is_chain
from objslam.graph.least_squares.joint_rows import JointGraph
from objslam.graph.least_squares.normal_equations import NormalEquations, elimination_order, factored


def chain(poses: int, landmarks: int, ties: tuple[tuple[int, int], ...] = (), missing: int | None = None) -> ChainRows:
    """Random rows of a chain. missing: the pose after which no motion leads to the next one."""
    rng, rays = np.random.default_rng(poses), 4 * poses
    ranged = np.flatnonzero(rng.random(rays) < 0.5)
    kept = np.delete(np.arange(poses - 1), [] if missing is None else [missing])
    before, after = (np.append(kept + end, [one[end] for one in ties]).astype(np.int64) for end in (0, 1))
    return ChainRows(
        landmarks,
        poses,
        rng.integers(0, landmarks, rays),
        np.repeat(np.arange(poses), 4),
        ranged,
        before,
        after,
        rng.normal(size=(rays, 2, 9)),
        rng.normal(size=(len(ranged), 1, 9)),
        rng.uniform(0.5, 1.0, 3 * landmarks),
        rng.normal(size=(len(before), 6, 12)),
        rng.normal(size=(1, 6, 6)),
    )


def dense(rows: ChainRows) -> np.ndarray:
    """The Jacobian (M, D)."""
    first, found = 3 * rows.landmarks, []

    def put(row: np.ndarray, *parts: tuple[int, int, slice]) -> None:
        whole = np.zeros((len(row), first + 6 * rows.poses))
        for begin, size, columns in parts:
            whole[:, begin : begin + size] = row[:, columns]
        found.append(whole)

    ray = list(zip(rows.landmark, rows.pose, strict=True))
    for (landmark, pose), row in (
        *zip(ray, rows.bearings, strict=True),
        *zip([ray[k] for k in rows.ranged], rows.ranges, strict=True),
    ):
        put(row, (3 * landmark, 3, slice(0, 3)), (first + 6 * pose, 6, slice(3, 9)))
    for before, after, row in zip(rows.before, rows.after, rows.moves, strict=True):
        put(row, (first + 6 * before, 6, slice(0, 6)), (first + 6 * after, 6, slice(6, 12)))
    for pose, row in enumerate(rows.absolute):
        put(row, (first + 6 * pose, 6, slice(0, 6)))
    found.append(np.diag(np.append(rows.weak, np.zeros(6 * rows.poses)))[:first])
    return np.concatenate(found)


TIES = [(), ((2, 4),), ((0, 5), (5, 7), (9, 12))]


@pytest.mark.parametrize("ties", TIES)
@pytest.mark.parametrize("poses", [1, 2, 3, 8, 13, 40])
def test_a_chain_is_solved_as_the_dense_matrix_is(poses, ties):
    """With an even and an odd number of poses, with neighbouring ties, and with a gap in the odometry."""
    ties = tuple(tie for tie in ties if tie[1] < poses)
    for missing in (None, 0, poses // 2) if poses > 2 else (None,):
        rows = chain(poses, 3, ties, missing)
        jacobian, right = dense(rows), np.random.default_rng(0).normal(size=(9 + 6 * poses, 4))
        told, given = np.linalg.solve(jacobian.T @ jacobian, right), right.copy()
        found = ChainEquations.of(rows)
        assert_allclose(found.solve(right), told, rtol=1e-7, atol=1e-7 * np.abs(told).max())
        assert_allclose(found.solve(right[:, 0]), told[:, 0], rtol=1e-7, atol=1e-7 * np.abs(told).max())
        assert_allclose(right, given, atol=0)


def test_what_is_a_chain():
    straight = np.arange(9), np.arange(1, 10)
    with_ties = [np.append(ends, more) for ends, more in zip(straight, ([2, 5], [5, 7]), strict=True)]
    assert is_chain(5, *straight)
    assert is_chain(5, *with_ties)
    assert not is_chain(500, *straight)  # Too many landmarks.
    assert not is_chain(5, *(np.append(ends, more) for ends, more in zip(straight, ([2, 4], [5, 7]), strict=True)))
    assert not is_chain(5, *(np.append(ends, 4 + k) for k, ends in enumerate(straight)))  # A motion that is there twice.
    assert not is_chain(5, straight[1], straight[0])


def test_other_noise_rescales_the_rows():
    rows = chain(8, 3, ((2, 4),))
    rng = np.random.default_rng(1)
    ranges, moves = rng.uniform(1, 2, len(rows.ranged)), rng.normal(size=(len(rows.before), 6, 6))
    scale = np.eye(len(dense(rows)))
    end = 2 * len(rows.pose)
    scale[:end] *= 1.5
    scale[range(end, end + len(ranges)), range(end, end + len(ranges))] = ranges
    for k, one in enumerate(moves):
        at = slice(end + len(ranges) + 6 * k, end + len(ranges) + 6 * (k + 1))
        scale[at, at] = one
    assert_allclose(dense(rows.rescaled(1.5, ranges, moves)), scale @ dense(rows), atol=1e-12)


@pytest.mark.parametrize("tied", [False, True])
def test_the_rows_of_a_drive_are_a_chain(tied):
    """They give the normal equations of the sparse Jacobian, also with ties between poses of slow odometry."""
    drive = make_drive(0, "mode=joint", **ODOMETRY_ALONE)
    ties = np.array([[3, 5], [10, 14], [14, 16]]) if tied else None
    measured = Measurements.of(drive.keyframes, drive.rays, drive.settings, ties=ties)
    graph = JointGraph.of(measured, drive.association, drive.right(), drive.points)
    poses = drive.map_T_base @ drive.keyframes.base_T_camera
    poses = poses @ exp_se3(np.random.default_rng(0).normal(scale=0.01, size=(len(poses), 6)))
    rows = graph.rows(poses, graph.weak + 0.05)
    assert rows.chain is not None
    assert len(rows.chain.before) == len(poses) - 1 + 3 * tied
    general = NormalEquations.of(rows.jacobian, elimination_order(rows.jacobian, graph.blocks))
    right = np.random.default_rng(0).normal(size=(rows.jacobian.shape[1], 3))
    told = general.solve(right)
    size = np.sqrt(np.diagonal(general.solve(np.eye(len(right)))))[:, None]
    assert_allclose(ChainEquations.of(rows.chain).solve(right) / size, told / size, atol=1e-6 * np.abs(told / size).max())


def test_a_chain_that_loses_all_digits_is_factored_as_any_graph(monkeypatch):
    drive = make_drive(0, "mode=joint", **ODOMETRY_ALONE)
    measured = Measurements.of(drive.keyframes, drive.rays, drive.settings)
    graph = JointGraph.of(measured, drive.association, drive.right(), drive.points)
    rows = graph.rows(drive.map_T_base @ drive.keyframes.base_T_camera, graph.weak)
    assert isinstance(factored(rows.jacobian, rows.chain, graph.blocks, None), ChainEquations)
    monkeypatch.setattr(normal_equations.ChainEquations, "of", lambda _: np.linalg.cholesky(-np.eye(2)))
    assert isinstance(factored(rows.jacobian, rows.chain, graph.blocks, None), NormalEquations)
