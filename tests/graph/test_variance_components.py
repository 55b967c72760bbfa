"""The noise that is estimated from the residuals: against the noise that was put in, and against GTSAM's own basis."""

from functools import cache

import gtsam
import numpy as np
import pytest
from drives import drive_of
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import align
from objslam.frontend.known_errors import shared_errors
from objslam.graph.batch_solver import solve_joint
from objslam.graph.calibration.variance_components import _azimuth_elevation, correlation_time
from objslam.simulation import DepthNoise, preset, simulate

HELD = tuple(
    f"calibration.{name}=0"
    for name in ("scale", "turn_scale", "turn_bias", "turn_per_m", "turn_slip", "clock", "range_scale")
)


@cache
def solved(drift, pixels=3.0, ranges=None, seed=1, overrides=(), frames=400):
    """A drive with odometry noise `drift` times the default, solved with the default settings; and the drive.

    Several tests look at the same one.
    """
    settings = load_settings(None, ("mode=joint", *HELD, *overrides))
    of = Odometry()
    noise = of.model_copy(update={n: drift * getattr(of, n) for n in type(of).model_fields if not n.startswith("floor")})
    depth = None if ranges is None else DepthNoise(sigma=0.03 * ranges, sigma_per_m=0.02 * ranges)
    changes = {"localization": None, "odometry": noise, "depth": depth, "pixel_sigma": pixels}
    log = simulate(preset("demo", objects=12, classes=12, frames=frames, **changes), seed)
    made = drive_of(log, settings)
    errors = shared_errors(log, made.keyframes, made.rays, settings)
    return solve_joint(made.keyframes, made.rays, made.association, settings, Ledger(), errors=errors), made


def scale_of(found, made):
    there = np.isfinite(found.positions[:, 0])
    return align(found.positions[there], made.points[there], "sim2")[1]


@pytest.mark.parametrize(("drift", "pixels"), [(1.0, 3.0), (3.0, 3.0), (0.5, 6.0)])
def test_the_noise_of_a_drive_is_found(drift, pixels):
    """Simulated boxes err by pixel_sigma alone: with the share of the box size, their nominal noise is larger than 3 px."""
    factors = [solved(drift, pixels, ranges=2.0, seed=seed)[0].noise for seed in (1, 2)]
    turning, rays = (np.mean([getattr(f, name) for f in factors]) for name in ("turning", "rays"))
    assert abs(np.log(turning / drift)) < np.log(1.5)  # the nominal noise counts for ten residuals of a short drive
    assert 0.5 * pixels / 3 < rays < 1.25 * pixels / 3


def test_the_noise_of_ranges_is_found():
    """The simulated sigma is a root of squares, and that of the settings a sum. So the ratio of two drives is compared."""
    more, usual = (solved(1.0, ranges=of)[0].noise.ranges for of in (3.0, 1.0))
    assert more / usual == pytest.approx(3.0, rel=0.2)


@pytest.mark.parametrize("said", [0.5, 2.0])
def test_the_drift_in_the_settings_is_only_a_start(said):
    """The estimated noise hardly depends on the noise from which the search begins."""
    usual = solved(1.0, overrides=("calibration.centre=0",))[0]
    of = Odometry()
    names = ("x_per_m", "y_per_m", "xy_per_rad", "yaw_per_m", "yaw_per_rad")
    overrides = (*(f"odometry.{n}={said * getattr(of, n)}" for n in names), "noise.odometry=true", "calibration.centre=0")
    other = solved(1.0, overrides=overrides)[0]
    assert other.noise.turning * said == pytest.approx(usual.noise.turning, rel=0.35)
    assert_allclose(other.positions, usual.positions, atol=0.05)


def test_noise_that_the_user_gives_is_taken_as_it_is():
    found = solved(1.0, overrides=("rays.pixel_sigma=2", "odometry.x_per_m=0.03", "depth.sigma=0.05"), ranges=1.0)[0]
    assert found.noise is None or (found.noise.rays, found.noise.along, found.noise.turning, found.noise.ranges) == (
        1,
        1,
        1,
        1,
    )


def test_the_map_has_the_size_of_the_odometry():
    """Bearings alone, odometry three times as noisy as the default: joint solves shrink without the correction."""
    scales = np.array([scale_of(*solved(3.0, seed=seed, frames=300)) for seed in range(6)])
    assert abs(scales.mean() - 1) < 3 * scales.std() / np.sqrt(len(scales)) + 0.01


@pytest.mark.parametrize(("duration", "told"), [(0.0, 3.0), (40.0, 3.0), (150.0, 5.0), (900.0, 6.0)])
def test_a_longer_log_finds_slower_errors(duration, told):
    stamps = 1.7e9 + np.array([0.0, duration / 3, duration])
    assert correlation_time(stamps) == pytest.approx(told)
    assert correlation_time(stamps[::-1]) == pytest.approx(told)  # clocks can change the order of images
    assert correlation_time(np.zeros(0)) == 3.0


def test_bearings_are_split_into_azimuth_and_elevation():
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    base_T_camera = np.tile(np.eye(4), (200, 1, 1))
    base_T_camera[:, :3, :3] = Rotation.random(200, random_state=1).as_matrix()
    axes = _azimuth_elevation(directions, base_T_camera)
    small = 1e-6 * rng.standard_normal((200, 2))
    for direction, pose, turn, off in zip(directions, base_T_camera, axes, small, strict=True):
        unit = gtsam.Unit3(direction)
        moved = unit.retract(off).point3() - unit.point3()
        azimuth, elevation = turn @ off
        up = pose[:3, :3].T @ [0, 0, 1]
        assert abs(elevation) == pytest.approx(
            abs(moved @ (up - (up @ direction) * direction)) / np.sqrt(1 - (up @ direction) ** 2), abs=1e-10
        )
        assert azimuth**2 + elevation**2 == pytest.approx(off @ off)
