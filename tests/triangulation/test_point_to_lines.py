"""Eq. 1 against an independent convex solution, in the corner cases, and under what must not change it."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq, minimize, root
from scipy.spatial.transform import Rotation

from objslam.core.array_module import array_backend, as_numpy
from objslam.triangulation import point_to_lines, smoothed_newton
from objslam.triangulation.point_to_lines import least_squares
from objslam.triangulation.triangulate import _bundle, solve_eq1


def offsets(o, m, n):
    """Offsets (K, 3) of the point from the lines, and their lengths."""
    q = o - m
    q = q - n * (q * n).sum(axis=1, keepdims=True)
    return q, np.linalg.norm(q, axis=1)


def cost(o, m, n):
    return offsets(o, m, n)[1].sum()


def gradient(o, m, n):
    q, d = offsets(o, m, n)
    return (q / d[:, None]).sum(axis=0)


def hessian(o, m, n):
    q, d = offsets(o, m, n)
    u = q / d[:, None]
    return ((np.eye(3) - n[:, :, None] * n[:, None, :] - u[:, :, None] * u[:, None, :]) / d[:, None, None]).sum(axis=0)


def oracle(m, n, start):
    """Eq. 1's optimum by scipy: BFGS, then the root of the gradient, or of its part along the line that holds the point."""
    rough = minimize(cost, start, args=(m, n), jac=gradient, method="BFGS", options={"gtol": 1e-9}).x
    exact = root(gradient, rough, args=(m, n), jac=hessian, method="hybr", options={"xtol": 1e-14})
    if np.linalg.norm(gradient(exact.x, m, n)) < 1e-10:
        return exact.x, True
    on = offsets(rough, m, n)[1].argmin()
    rest = np.arange(len(m)) != on
    foot = rough - offsets(rough, m, n)[0][on]

    def slope(t):
        return gradient(foot + t * n[on], m[rest], n[rest]) @ n[on]

    point = foot + brentq(slope, -1.0, 1.0, xtol=1e-15, rtol=1e-14) * n[on]
    pull = gradient(point, m[rest], n[rest])
    assert np.linalg.norm(pull) < 1 + 1e-9  # the line holds it: a subgradient is 0
    return point, False


def rays_around(rng, count, sizes, noise=0.01, wrong=0.0, spread=3.0):
    """Rays from around objects, noisy (rad); a share of them points anywhere. Objects at random places of some metres."""
    index = np.repeat(np.arange(count), sizes)
    places = rng.normal(scale=5.0, size=(count, 3))
    m = places[index] + rng.normal(scale=spread, size=(len(index), 3))
    n = places[index] - m
    n = n / np.linalg.norm(n, axis=1, keepdims=True) + noise * rng.normal(size=n.shape)
    anywhere = rng.random(len(index)) < wrong
    n[anywhere] = rng.normal(size=(int(anywhere.sum()), 3))
    return m, n / np.linalg.norm(n, axis=1, keepdims=True), index, places


def closed_form(m, n, index, count):
    """The points from which Eq. 1 is solved, and whether the rays fix them."""
    m, n = np.asarray(m), np.asarray(n) / np.linalg.norm(n, axis=1, keepdims=True)
    with array_backend("cpu", False) as backend:
        _, base, bundle = _bundle(m, n, np.asarray(index), count, np.ones(len(m)), 0.0, backend)
        points, determined = least_squares(bundle)
        return as_numpy(base + points), as_numpy(determined)


def test_equals_a_convex_solution_of_scipy_on_320_objects():
    rng = np.random.default_rng(0)
    batches = [rays_around(rng, 80, rng.integers(3, 30, 80), noise, wrong) for noise in (0.002, 0.05) for wrong in (0, 0.4)]
    smooth = 0
    for m, n, index, _ in batches:
        points, _, norm = solve_eq1(m, n, index, 80)
        start, determined = closed_form(m, n, index, 80)
        assert determined.all()
        assert norm.max() < 1e-9
        for j in range(80):
            expected, interior = oracle(m[index == j], n[index == j], start[j])
            smooth += interior
            np.testing.assert_allclose(points[j], expected, rtol=0, atol=1e-8)
            if interior:
                assert np.linalg.norm(gradient(points[j], m[index == j], n[index == j])) < 1e-9
    assert 160 < smooth < 320  # both kinds of optimum were there


def test_closed_form_is_the_least_squares_solution():
    rng = np.random.default_rng(1)
    m, n, index, _ = rays_around(rng, 20, rng.integers(2, 12, 20), noise=0.05)
    points, determined = closed_form(m, n * 3.0, index, 20)
    assert determined.all()
    for j in range(20):
        mine = index == j
        p = np.eye(3) - n[mine][:, :, None] * n[mine][:, None, :]
        expected = np.linalg.lstsq(p.reshape(-1, 3), np.einsum("rij,rj->ri", p, m[mine]).ravel())[0]
        np.testing.assert_allclose(points[j], expected, atol=1e-9)


def test_exact_rays_meet_in_their_point():
    rng = np.random.default_rng(2)
    m, n, index, places = rays_around(rng, 50, rng.integers(2, 40, 50), noise=0.0)
    points, _, norm = solve_eq1(m, n, index, 50)
    np.testing.assert_allclose(points, places, rtol=0, atol=1e-12)
    assert norm.max() < 1e-9


@pytest.mark.parametrize("noise", [1e-12, 1e-9, 1e-6])
def test_nearly_exact_rays_are_solved_as_precisely(noise):
    """Distances 1e12 times smaller than the scene: rounding of its size must stay out of them."""
    rng = np.random.default_rng(11)
    m, n, index, _ = rays_around(rng, 100, rng.integers(3, 40, 100), noise=noise)
    points, _, norm = solve_eq1(m, n, index, 100)
    start, _ = closed_form(m, n, index, 100)
    assert norm.max() < 1e-9
    assert all(
        cost(points[j], m[index == j], n[index == j]) <= cost(start[j], m[index == j], n[index == j]) for j in range(100)
    )


def test_an_exact_majority_holds_the_point_against_wrong_rays():
    rng = np.random.default_rng(3)
    m, n, _, places = rays_around(rng, 1, [12], noise=0.0)
    wrong = rays_around(rng, 1, [4], noise=1.0)
    m, n = np.vstack([m, wrong[0]]), np.vstack([n, wrong[1]])
    points, _, norm = solve_eq1(m, n, np.zeros(16, dtype=int), 1)
    np.testing.assert_allclose(points, places, rtol=0, atol=1e-12)
    assert norm[0] < 1e-9


def test_two_rays_give_the_middle_of_their_closest_approach():
    points, _, norm = solve_eq1([[0, 0, 0], [0, 5, 1]], [[1, 0, 0], [0, -2, 0]], [0, 0], 1)
    np.testing.assert_allclose(points, [[0, 0, 0.5]], atol=1e-15)
    assert norm[0] < 1e-9


def test_rays_in_one_plane_give_an_optimum_of_the_plane():
    """Bearings of a planar robot: the cost has no curvature in the plane, its optimum is a vertex or an area."""
    rng = np.random.default_rng(4)
    m, n, index, _ = rays_around(rng, 100, rng.integers(3, 30, 100), noise=0.02)
    m[:, 2], n[:, 2] = 0.7, 0.0
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    points, _, norm = solve_eq1(m, n, index, 100)
    assert norm.max() < 1e-9
    np.testing.assert_allclose(points[:, 2], 0.7, atol=1e-12)
    for j in range(100):
        mine = m[index == j], n[index == j]
        # a vertex: the best of all intersections is an optimum of a piecewise linear convex cost
        a, b = np.triu_indices(len(mine[0]), 1)
        normal = np.cross(mine[1], [0, 0, 1])[:, :2]
        level = (normal * mine[0][:, :2]).sum(axis=1)
        vertices = np.linalg.solve(
            np.stack([normal[a], normal[b]], axis=1), np.stack([level[a], level[b]], axis=1)[..., None]
        )
        best = np.abs(vertices[..., 0] @ normal.T - level).sum(axis=1).min()
        assert cost(points[j], *mine) <= best * (1 + 1e-12) + 1e-12


def test_in_a_plane_the_optimum_is_the_best_crossing_and_takes_few_steps():
    """The sum of distances to lines of a plane is linear between them, so it is least at a crossing. There, offsets are
    rounding errors, and must not keep the solver busy to its last step."""
    rng = np.random.default_rng(1)
    count, number = 100, 20
    angle = rng.uniform(-0.1, 0.1, (count, number)) + rng.uniform(-np.pi, np.pi, (count, 1))  # as from a short path
    m, n = np.zeros((count, number, 3)), np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=2)
    m[..., :2] = rng.normal(0, 0.02, (count, number, 2))
    m -= 3 * n
    found, iterations, rest = solve_eq1(m.reshape(-1, 3), n.reshape(-1, 3), np.repeat(np.arange(count), number), count)
    pairs = np.column_stack(np.triu_indices(number, 1))
    for i in range(count):
        across = np.column_stack([-n[i, :, 1], n[i, :, 0]])
        there = (across * m[i, :, :2]).sum(axis=1)
        crossings = np.linalg.solve(across[pairs], there[pairs][..., None])
        costs = [cost(np.append(crossing, 0.0), m[i], n[i]) for crossing in crossings[..., 0]]
        best = np.append(crossings[int(np.argmin(costs)), :, 0], 0.0)
        np.testing.assert_allclose(found[i], best, atol=1e-9)
    assert rest.max() < 1e-10
    assert iterations < 100


def test_repeated_rays_do_not_disturb():
    """A robot that stands still sees the same ray again and again."""
    rng = np.random.default_rng(5)
    m, n, _, _ = rays_around(rng, 1, [6], noise=0.05)
    times = np.array([1, 1, 9, 1, 2, 1])
    m, n = np.repeat(m, times, axis=0), np.repeat(n, times, axis=0)
    points, _, norm = solve_eq1(m, n, np.zeros(15, dtype=int), 1)
    assert norm[0] < 1e-9
    assert offsets(points[0], m, n)[1][2] < 1e-12  # the ray seen 9 of 15 times holds the point
    assert offsets(points[0], m, n)[1].max() > 1e-3


@pytest.mark.parametrize("directions", [[[0, 0, 2.0]], [[0, 0, 1.0], [0, 0, 3.0]], [[0, 0, 1.0], [0, 0, -1.0], [0, 0, 5.0]]])
def test_parallel_rays_fix_no_point(directions):
    origins = np.array([[1.0, 0, 0], [3.0, 0, 0], [2.0, 0, 0]])[: len(directions)]
    index = np.zeros(len(directions), dtype=int)
    points, determined = closed_form(origins, directions, index, 1)
    assert not determined[0]
    np.testing.assert_allclose(points[0], [*origins.mean(axis=0)[:2], 1.0])
    solved, _, norm = solve_eq1(origins, directions, index, 1)
    np.testing.assert_array_equal(solved, points)
    assert np.isnan(norm[0])


def test_an_object_without_rays_has_no_point():
    points, iterations, norm = solve_eq1(np.zeros((0, 3)), np.zeros((0, 3)), [], 2)
    assert np.isnan(points).all()
    assert np.isnan(norm).all()
    assert iterations == 0


@pytest.mark.parametrize("offset", [1e3, 1e5])
def test_map_coordinates_far_from_the_origin_cost_no_precision(offset):
    rng = np.random.default_rng(7)
    m, n, index, _ = rays_around(rng, 100, 20)
    shift = np.array([offset, -offset, 0.1 * offset])
    far = m + shift
    points, _, _ = solve_eq1(far - shift, n, index, 100)
    moved, _, norm = solve_eq1(far, n, index, 100)
    np.testing.assert_allclose(moved - shift, points, rtol=0, atol=4e-16 * offset + 1e-12)
    assert norm.max() < 1e-9


@settings(max_examples=12)
@given(st.integers(0, 2**32 - 1), st.integers(3, 40))
def test_order_motion_and_scale_carry_over(seed, size):
    rng = np.random.default_rng(seed)
    m, n, index, _ = rays_around(rng, 3, size, noise=0.03, wrong=0.2)
    points, _, _ = solve_eq1(m, n, index, 3)
    order = rng.permutation(len(m))
    np.testing.assert_allclose(solve_eq1(m[order], n[order], index[order], 3)[0], points, rtol=0, atol=1e-9)
    rotation, translation, scale = Rotation.random(rng=rng).as_matrix(), rng.normal(scale=10, size=3), np.exp(rng.normal())
    moved, _, _ = solve_eq1(scale * m @ rotation.T + translation, n @ rotation.T * 2.0, index, 3)
    np.testing.assert_allclose(moved, scale * points @ rotation.T + translation, rtol=0, atol=1e-8 * max(1, scale))


@pytest.mark.parametrize("xp", [np, torch])
def test_a_singular_matrix_gives_a_finite_step(xp):
    """Nearly parallel rays of a recorded drive once gave a matrix that rounding made exactly singular."""
    regular, singular = np.diag([2.0, 4.0, 5.0]), np.diag([3.0, 0.0, 6.0])
    matrices, right = xp.asarray(np.stack([regular, singular])), xp.asarray(np.array([[2.0, 4.0, 5.0], [3.0, 0.0, 6.0]]))
    found = np.asarray(smoothed_newton._solved(matrices, right[:, :, None], xp))[..., 0]
    np.testing.assert_allclose(found, [[1.0, 1.0, 1.0], [1.0, 0.0, 1.0]], atol=1e-8)


@pytest.mark.parametrize("few", [0, 1 << 16])
def test_torch_leaves_few_hard_objects_to_numpy_with_the_same_solutions(monkeypatch, few):
    """No round solves lines in one plane, so `smoothed_newton` gets them."""
    rng = np.random.default_rng(5)
    m, n, index, places = rays_around(rng, 6, 7, noise=0.1)
    m[:, 2], n[:, 2] = places[index, 2], 0.0
    expected = solve_eq1(m, n, index, 6)[0]
    libraries = []
    monkeypatch.setattr(point_to_lines, "_FEW", few)
    monkeypatch.setattr(point_to_lines, "finish", lambda lines: libraries.append(lines.xp) or smoothed_newton.finish(lines))
    monkeypatch.setattr("objslam.core.array_module.chosen_backend", lambda *_: "cpu")
    found, _, gradient = solve_eq1(m, n, index, 6)
    assert set(libraries) == {np if few else torch}
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    assert gradient.max() < 1e-9
