"""The proximity field against the formula of Eq. 1 and a plain minimiser."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from objslam.triangulation.proximity_field import main_heading, proximity, proximity_field, supporting_rays


def rays(count: int = 30, noise: float = 0.02, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    point = np.array([203.0, -81.0, 1.2])
    origins = point + np.column_stack([rng.uniform(-3, -1, count), rng.uniform(-2, 2, count), rng.uniform(-1, 0, count)])
    directions = point - origins + rng.normal(scale=noise, size=(count, 3))
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True), point


def eq1(point: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> float:
    return float(np.linalg.norm(np.cross(point - origins, directions), axis=1).mean())


def test_the_cost_is_that_of_eq1_everywhere() -> None:
    origins, directions, point = rays()
    points = point + np.random.default_rng(1).normal(size=(4, 5, 3))
    expected = [[eq1(p, origins, directions) for p in row] for row in points]
    np.testing.assert_allclose(proximity(origins, directions, points), expected, atol=1e-9)


def test_blocks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    origins, directions, point = rays()
    points = point + np.random.default_rng(1).normal(size=(50, 3))
    whole = proximity(origins, directions, points)
    monkeypatch.setattr("objslam.triangulation.proximity_field._AT_ONCE", 100)
    np.testing.assert_allclose(proximity(origins, directions, points), whole, atol=1e-12)


def test_the_minimum_is_where_a_plain_minimiser_puts_it() -> None:
    origins, directions, point = rays()
    f = proximity_field(origins, directions, 51)
    other = minimize(eq1, point, args=(origins, directions), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12})
    np.testing.assert_allclose(f.minimum, other.x, atol=1e-4)
    assert f.cost == pytest.approx(other.fun, abs=1e-9)
    for s in (f.horizontal, f.vertical):
        assert s.points.shape == (51, 51, 3)
        np.testing.assert_allclose(s.points[25, 25], f.minimum)
        assert np.unravel_index(s.cost.argmin(), s.cost.shape) == (25, 25)
        assert s.cost.min() == pytest.approx(f.cost, abs=1e-7)
        assert s.cost.max() > 3 * f.cost
    assert np.ptp(f.horizontal.points[..., 2]) == 0


def test_the_vertical_slice_lies_along_the_rays() -> None:
    origins, directions, _ = rays()
    np.testing.assert_allclose(np.abs(main_heading(directions)[0]), 1.0, atol=0.05)
    assert main_heading(np.array([[0.0, 0.0, 1.0]])).tolist() == [1.0, 0.0, 0.0]
    f = proximity_field(origins, directions, 21, reach=0.4)
    along = f.vertical.points[10, -1] - f.vertical.points[10, 0]
    np.testing.assert_allclose(np.abs(along @ main_heading(directions)), 0.8)


def test_rejected_rays_do_not_pull() -> None:
    mine = np.array([True, True, False, True])
    assert supporting_rays(np.array([1.0, 0.0, 1.0, 0.2]), mine).tolist() == [True, False, False, True]
    assert supporting_rays(np.zeros(4), mine).tolist() == mine.tolist()
