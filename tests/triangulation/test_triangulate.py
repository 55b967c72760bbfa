"""Positions with their covariance, what is called ok, and ranges: by simulation and in cases with a known answer."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from objslam import config
from objslam.core.array_module import chosen_backend
from objslam.core.geometry import widest_angle
from objslam.errors import ConfigError
from objslam.triangulation.triangulate import solve_eq1, triangulate

SETTINGS = config.Triangulation()
CHI2_95 = 7.8147  # 3 degrees of freedom


def passing(rng, count, size, sigma, arc=120.0, position_sigma=0.0):
    """Rays to objects at the origin from 1.5 to 4 m away within an arc (deg), with noise of angles (rad) and origins (m)."""
    azimuth = np.radians(arc) * (rng.random(count * size) - 0.5)
    reach = rng.uniform(1.5, 4.0, count * size)
    height = rng.uniform(-0.5, 0.5, count * size)
    m = np.column_stack([reach * np.cos(azimuth), reach * np.sin(azimuth), height])
    n = -m / np.linalg.norm(m, axis=1, keepdims=True) + sigma * rng.normal(size=m.shape)
    return m + position_sigma * rng.normal(size=m.shape), n, np.repeat(np.arange(count), size)


def approaching(rng, count, size, sigma, width=0.05, reach=4.0):
    """Rays to objects reach ahead (z) from a path of 1 m towards them that is width wide: hardly any parallax."""
    m = rng.uniform(-0.5, 0.5, (count * size, 3)) * [width, width, 1.0]
    n = [0, 0, reach] - m
    n = n / np.linalg.norm(n, axis=1, keepdims=True) + sigma * rng.normal(size=m.shape)
    return m, n, np.repeat(np.arange(count), size), np.array([0, 0, reach])


def covered(error, covariance):
    """The share of errors (N, 3) inside the 95 % ellipsoid of their covariance (N, 3, 3)."""
    return float(((error[:, None] @ np.linalg.inv(covariance) @ error[:, :, None])[:, 0, 0] < CHI2_95).mean())


@pytest.mark.parametrize("size", [4, 20, 300])
@pytest.mark.parametrize(
    ("case", "truth", "position_sigma"),
    [
        ({"arc": 120.0}, 1.0, 0.0),
        ({"arc": 20.0}, 1.0, 0.0),  # Eq. 1's bias towards the cameras shows
        ({"arc": 120.0}, 5.0, 0.0),  # the noise is 5 times what the rays claim
        ({"arc": 120.0, "position_sigma": 0.03}, 1.0, 0.03),
    ],
)
def test_the_covariance_is_honest(size, case, truth, position_sigma):
    sigma, count = 0.006, 100 if size == 300 else 300
    rays = passing(np.random.default_rng(size), count, size, truth * sigma, **case)
    settings = config.Triangulation(hypotheses=50)  # enough without wrong rays
    result = triangulate(*rays, count, sigma, settings, position_sigma=position_sigma)
    assert result.ok.mean() > 0.95
    assert 0.88 <= covered(result.positions[result.ok], result.covariance[result.ok]) <= 0.99


def test_the_covariance_has_the_size_of_the_errors():
    """Not only the coverage: with noise as claimed the mean covariance is that of the errors, entry by entry."""
    count = 1000
    rays = passing(np.random.default_rng(1), count, 25, 0.004)
    result = triangulate(*rays, count, 0.004, config.Triangulation(consensus=False))
    actual = result.positions.T @ result.positions / count
    np.testing.assert_allclose(result.covariance.mean(axis=0), actual, atol=0.15 * np.trace(actual) / 3)


def test_the_fields_describe_the_inliers():
    rng = np.random.default_rng(2)
    m, n, index = passing(rng, 5, 30, 0.004)
    wrong = np.arange(150) % 6 == 0
    n[wrong] += 0.5 * rng.normal(size=(25, 3))
    index[7] = -1
    result = triangulate(m, n * 2.0, index, 5, 0.004, SETTINGS)
    unit = n / np.linalg.norm(n, axis=1, keepdims=True)
    inlier = result.weight == 1
    assert set(result.weight) == {0.0, 1.0}
    assert result.weight[7] == 0
    assert np.isnan(result.distance[7])
    assert 0 < result.iterations < 1000
    for j in range(5):
        mine, used = index == j, inlier & (index == j)
        assert result.counts[j] == used.sum()
        position, _, gradient = solve_eq1(m[used], n[used], np.zeros(used.sum(), dtype=int), 1)
        np.testing.assert_allclose(result.positions[j], position[0], atol=1e-10)
        assert max(result.gradient[j], gradient[0]) < 1e-9
        assert result.parallax[j] == pytest.approx(widest_angle(unit[used]), abs=1e-7)
        to_object = result.positions[j] - m
        distance = np.linalg.norm(np.cross(to_object, unit), axis=1)
        np.testing.assert_allclose(result.distance[mine], distance[mine], atol=1e-12)
        angle = np.arcsin(distance / np.linalg.norm(to_object, axis=1))[used]
        assert result.rms[j] == pytest.approx(np.sqrt((angle**2).mean()), rel=1e-9)


def test_the_widest_angle_of_many_rays():
    m, n, index = passing(np.random.default_rng(3), 1, 4000, 0.002, arc=50.0)
    result = triangulate(m, n, index, 1, 0.002, config.Triangulation(consensus=False))
    unit = n / np.linalg.norm(n, axis=1, keepdims=True)
    assert result.parallax[0] == pytest.approx(np.arccos(np.abs(unit @ unit.T).min()), rel=0.01)


def test_too_little_parallax_is_not_ok():
    m, n, index, _ = approaching(np.random.default_rng(4), 20, 15, 0.001)
    result = triangulate(m, n, index, 20, 0.001, SETTINGS)
    assert (result.parallax < np.radians(3)).all()
    assert not result.ok.any()
    assert np.isfinite(result.positions).all()
    loose = triangulate(m, n, index, 20, 0.001, config.Triangulation(min_parallax_deg=0.0, max_rel_sigma=10.0))
    assert loose.ok.all()


def test_too_little_precision_is_not_ok():
    m, n, index, _ = approaching(np.random.default_rng(5), 20, 6, 0.03, width=0.4)
    result = triangulate(m, n, index, 20, 0.03, SETTINGS)
    sigma = np.sqrt(np.linalg.eigvalsh(result.covariance)[:, -1])
    reach = np.array([np.median(np.linalg.norm(result.positions[j] - m[index == j], axis=1)) for j in range(20)])
    assert (sigma > 0.5 * reach).any()
    assert not result.ok[sigma > 0.5 * reach].any()


@pytest.mark.parametrize("agreeing", [True, False])
def test_an_object_behind_its_cameras_is_not_ok(agreeing):
    m, n, index = passing(np.random.default_rng(6), 1, 10, 0.001)
    result = triangulate(m, -n, index, 1, 0.001, config.Triangulation(consensus=agreeing))
    assert not result.ok[0]
    assert np.isfinite(result.positions).all()


@pytest.mark.parametrize("directions", [[[0, 0, 2.0]], [[0, 0, 1.0], [0, 0, 1.0]]])
def test_rays_that_fix_no_point(directions):
    origins = np.array([[1.0, 0, 0], [1.2, 0, 0]])[: len(directions)]
    result = triangulate(origins, directions, np.zeros(len(directions), dtype=int), 2, 0.01, SETTINGS)
    np.testing.assert_allclose(result.positions[0], [*origins.mean(axis=0)[:2], 1.0])
    assert not result.ok.any()
    assert np.isnan(result.covariance).all()
    assert np.isnan(result.gradient).all()
    assert np.isnan(result.positions[1]).all()
    assert result.counts.tolist() == [len(directions), 0]


def test_ranges_carry_objects_without_parallax():
    """Hardly any parallax, a third of the ranges missing, every sixth on the wall behind."""
    rng = np.random.default_rng(7)
    count, size, sigma = 200, 30, 0.004
    m, n, index, truth = approaching(rng, count, size, sigma)
    ranges = np.linalg.norm(truth - m, axis=1) + 0.08 * rng.normal(size=len(m))
    ranges[rng.random(len(m)) < 1 / 6] += 1.5
    ranges[rng.random(len(m)) < 1 / 3] = np.nan
    range_sigma = np.where(np.isfinite(ranges), 0.08, np.nan)
    result = triangulate(m, n, index, count, sigma, SETTINGS, ranges=ranges, range_sigma=range_sigma)
    error = result.positions - truth
    assert result.ok.all()
    assert np.median(np.linalg.norm(error, axis=1)) < 0.03
    assert np.linalg.norm(error, axis=1).max() < 0.15
    assert 0.88 <= covered(error, result.covariance) <= 0.99
    assert np.isnan(result.gradient).all()  # not Eq. 1's positions


def test_ranges_that_scatter_more_than_they_claim_widen_the_covariance():
    rng = np.random.default_rng(8)
    m, n, index, truth = approaching(rng, 200, 20, 0.004)
    ranges = np.linalg.norm(truth - m, axis=1) + 0.3 * rng.normal(size=len(m))
    result = triangulate(m, n, index, 200, 0.004, SETTINGS, ranges=ranges, range_sigma=0.05)
    assert covered(result.positions - truth, result.covariance) > 0.85


@pytest.mark.parametrize("told", [True, False])
def test_the_bias_that_all_ranges_of_an_object_share_is_in_its_covariance(told):
    """A surface that is nearer than the centre does not average out over 30 images."""
    count, bias = 400, 0.05
    rng = np.random.default_rng(7)
    m, n, index, truth = approaching(rng, count, 30, 0.004)
    ranges = np.linalg.norm(truth - m, axis=1) + 0.03 * rng.normal(size=len(m)) + bias * rng.normal(size=count)[index]
    result = triangulate(
        m, n, index, count, 0.004, SETTINGS, ranges=ranges, range_sigma=0.03, range_bias=bias if told else 0.0
    )
    inside = covered(result.positions - truth, result.covariance)
    assert 0.92 < inside < 0.98 if told else inside < 0.5


def test_ranges_leave_a_position_that_the_rays_carry():
    rng = np.random.default_rng(9)
    m, n, index = passing(rng, 20, 20, 0.003)
    plain = triangulate(m, n, index, 20, 0.003, SETTINGS)
    ranges = np.linalg.norm(m, axis=1) - 0.3  # a large object: its surface is nearer than its centre
    ranged = triangulate(m, n, index, 20, 0.003, SETTINGS, ranges=ranges, range_sigma=0.1)
    np.testing.assert_array_equal(ranged.positions, plain.positions)
    np.testing.assert_array_equal(ranged.covariance, plain.covariance)


def test_ranges_help_where_one_says_more_than_all_rays():
    """Enough parallax to be ok, but Eq. 1's bias towards the cameras is larger than a range's error."""
    rng = np.random.default_rng(10)
    m, n, index, truth = approaching(rng, 50, 40, 0.006, width=0.4)
    assert triangulate(m, n, index, 50, 0.006, SETTINGS).ok.mean() > 0.9
    ranges = np.linalg.norm(truth - m, axis=1) + 0.08 * rng.normal(size=len(m))
    result = triangulate(m, n, index, 50, 0.006, SETTINGS, ranges=ranges, range_sigma=0.08)
    assert result.ok.all()
    assert np.linalg.norm(result.positions - truth, axis=1).max() < 0.08


@pytest.mark.parametrize("agreeing", [True, False])
def test_one_ray_with_a_range_stands_there_but_is_not_ok(agreeing):
    settings = config.Triangulation(consensus=agreeing)
    result = triangulate([[1.0, 2, 3]], [[0, 2.0, 0]], [0], 1, 0.01, settings, ranges=[3.0], range_sigma=0.1)
    np.testing.assert_allclose(result.positions, [[1, 5, 3]], atol=1e-12)
    np.testing.assert_allclose(result.covariance[0], np.diag([0.03**2, 0.1**2, 0.03**2]), atol=1e-9)
    assert not result.ok[0]


def test_map_coordinates_far_from_the_origin_change_nothing():
    """Coordinates as of a UTM grid: the square of their size has no room for a millimetre."""
    rng = np.random.default_rng(11)
    m, n, index = passing(rng, 20, 20, 0.001)
    n[::4] += 0.5 * rng.normal(size=(100, 3))
    shift = np.array([4e5, 5e6, 100.0])
    far = m + shift
    near = triangulate(far - shift, n, index, 20, 0.001, SETTINGS)
    result = triangulate(far, n, index, 20, 0.001, SETTINGS)
    np.testing.assert_array_equal(result.weight, near.weight)
    np.testing.assert_allclose(result.positions - shift, near.positions, rtol=0, atol=2e-9)
    np.testing.assert_allclose(result.covariance, near.covariance, rtol=1e-6, atol=1e-15)


def test_nothing_to_do():
    result = triangulate(np.zeros((0, 3)), np.zeros((0, 3)), [], 0, 0.01, SETTINGS)
    assert result.positions.shape == (0, 3)
    assert result.iterations == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"origins": [[0, 0]]}, "origins"),
        ({"origins": [[0, 0, np.nan]]}, "finite"),
        ({"directions": [[0, 0, 0]]}, "above 0"),
        ({"object_index": [1]}, "from -1 to 0"),
        ({"object_index": [0.5]}, "integers"),
        ({"sigma": [0.0]}, "sigma"),
        ({"sigma": [0.1, 0.1]}, "sigma"),
        ({"ranges": [1.0]}, "range_sigma"),
        ({"ranges": [1.0], "range_sigma": [np.nan]}, "range_sigma"),
    ],
)
def test_bad_arrays_are_refused(change, message):
    good = {"origins": [[0, 0, 0]], "directions": [[0, 0, 1]], "object_index": [0], "sigma": [0.1]}
    with pytest.raises(ValueError, match=message):
        triangulate(**(good | change), count=1, settings=SETTINGS)


def test_a_device_that_is_not_there_is_refused(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ConfigError, match="CUDA"):
        triangulate([[0, 0, 0]], [[0, 0, 1]], [0], 1, 0.1, config.Triangulation(device="cuda"))


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("ranged", [False, True])
def test_numpy_and_torch_agree(monkeypatch, ranged, device):
    """CUDA runs the code of torch, which a CPU can run too. The results are those of numpy up to rounding."""
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("torch sees no CUDA device")
    rng = np.random.default_rng(12)
    m, n, index, truth = approaching(rng, 30, 25, 0.004)
    n[::5] += 0.5 * rng.normal(size=(150, 3))
    index[::7] = -1
    ranges = np.linalg.norm(truth - m, axis=1) + 0.05 * rng.normal(size=len(m)) if ranged else None

    def results():
        whole = triangulate(m, n, index, 31, 0.004, SETTINGS, ranges=ranges, range_sigma=0.05, position_sigma=0.01)
        return whole, solve_eq1(m, n, index, 31)

    small, eq1 = results()
    monkeypatch.setattr("objslam.core.array_module.chosen_backend", lambda *_: device)
    large, eq1_large = results()
    for name in ("ok", "weight", "counts"):
        np.testing.assert_array_equal(getattr(large, name), getattr(small, name))
    for name in ("positions", "parallax", "rms", "distance"):
        np.testing.assert_allclose(getattr(large, name), getattr(small, name), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(large.covariance, small.covariance, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(eq1_large[0], eq1[0], rtol=0, atol=1e-10)
    assert np.nanmax(eq1_large[2]) < 1e-9


@pytest.mark.parametrize("limit", ["", "module._LARGE = 0; array_module._has_driver = lambda: False"])
def test_neither_a_small_batch_nor_one_without_a_card_imports_torch(limit):
    code = f"""
import sys
from objslam import config
from objslam.core import array_module
from objslam.triangulation import triangulate as module
{limit}
rays = [[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[1, 0, 3], [0, 0, 3], [-1, 0, 3.0]]
assert module.triangulate(*rays, [0, 0, 0], 1, 0.01, config.Triangulation()).ok.all()
sys.exit("torch" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(("card", "chosen"), [(True, "cuda"), (False, "numpy")])
def test_a_large_batch_runs_on_a_card_or_in_numpy(monkeypatch, card, chosen):
    monkeypatch.setattr("objslam.core.array_module._has_driver", lambda: True)
    monkeypatch.setattr("torch.cuda.is_available", lambda: card)
    assert chosen_backend("auto", large=True) == chosen
    assert chosen_backend("auto", large=False) == chosen_backend("cpu", large=True) == "numpy"
