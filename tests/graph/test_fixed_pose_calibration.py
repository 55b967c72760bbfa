"""Shared errors at known poses: against what was put in, differences of whole fits, and a drive that tells no clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from added_errors import add_shared_errors
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from objslam.association.nearest_neighbour import associate_by_label
from objslam.config import load_settings
from objslam.core.calibration import Calibration
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.core.rotation import rotation_from_vector
from objslam.core.trajectory import Trajectory
from objslam.core.types import Association, CameraLog, Detections, Log
from objslam.errors import SolveError
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors
from objslam.frontend.shared_errors import SharedErrors
from objslam.graph.calibration.fixed_pose_calibration import (
    calibrate_at_poses,
    linearise_points,
    noise_beside_objects,
    noise_of_errors,
)
from objslam.graph.fixed_pose_triangulation import noise_of_poses, triangulate_at
from objslam.simulation import PoseNoise, make_camera, preset, simulate

HELD = ("calibration.translation=0", "calibration.focal=0", "calibration.centre=0")
ERRORS = {"front.clock": 0.12, "front.roll": 0.015, "front.tilt": -0.02, "front.yaw": 0.03}


def parts(log: Log, *overrides: str) -> tuple[SharedErrors, Association, np.ndarray]:
    """The shared errors of a log where every label is one object, the association, and the objects at the poses."""
    settings = load_settings(None, ("mode=fixed", "calibration.use=true", *overrides))
    keyframes = build_keyframes(log, settings, Ledger())
    rays = build_rays(log, keyframes, settings, Ledger())
    seen = np.unique(rays.keyframe)
    keyframes, rays = keyframes.take(seen), replace(rays, keyframe=np.searchsorted(seen, rays.keyframe))
    association = associate_by_label(rays)
    placed = triangulate_at(keyframes.map_T_camera, keyframes, rays, association, settings)
    errors = shared_errors(log, keyframes, rays, settings)
    assert errors is not None
    return errors, association, np.where(placed.ok[:, None], placed.positions, np.nan)


def noise(errors: SharedErrors) -> tuple[float, float]:
    return noise_of_poses(errors.keyframes, errors.settings)


def exact(**changes: object) -> Log:
    """A drive without any noise, whose localisation is as dense as its path bends."""
    free = {"pixel_sigma": 0.0, "missed": 0.0, "false": 0.0, "localization": PoseNoise(), "localization_rate": 50.0}
    return simulate(preset("demo", odometry=None, objects=8, classes=8, frames=150, **free, **changes), 1)


def test_without_noise_the_errors_are_exact():
    errors, association, start = parts(add_shared_errors(exact(), ERRORS), *HELD)
    found = calibrate_at_poses(errors, association, start, errors.mean, noise(errors)).calibration
    assert found.names == tuple(ERRORS)
    assert_allclose(found.values, list(ERRORS.values()), atol=5e-4)  # what is left is the pull of the prior towards 0


def test_the_lens_and_the_place_of_a_camera_are_found_where_the_drive_shows_them():
    """A common height of camera and objects shows nowhere. A tilt looks nearly like a centre that is too high."""
    lens = {"front.focal": 0.03, "front.cx": -0.02, "front.x": -0.05, "front.y": 0.06}
    errors, association, start = parts(add_shared_errors(exact(), {**ERRORS, **lens, "front.z": 0.04}))
    found = calibrate_at_poses(errors, association, start, errors.mean, noise(errors)).calibration
    for name, value, sigma, prior in zip(found.names, found.values, found.sigma, found.prior, strict=True):
        assert abs(value - {**ERRORS, **lens}.get(name, 0.0)) < sigma, name
        assert sigma < 0.6 * prior or name in ("front.z", "front.tilt", "front.cy"), name
    height = found.names.index("front.z")
    assert found.values[height] == pytest.approx(0.0, abs=1e-3)
    assert found.sigma[height] == pytest.approx(0.05, rel=1e-2)


def test_noise_shifts_no_error_of_the_lens_and_no_place():
    """The mean over drives. Noise makes angles larger, and a longer lens or another place would hide it."""
    found = []
    for seed in range(8):
        noisy = {"objects": 8, "classes": 8, "frames": 150, "false": 0.0, "pixel_sigma": 4.0}
        errors, association, start = parts(simulate(preset("demo", odometry=None, **noisy), seed), "rays.pixel_sigma=4")
        calibration = calibrate_at_poses(errors, association, start, errors.mean, noise(errors)).calibration
        found.append(calibration.values / calibration.sigma)
    mean = dict(zip(calibration.names, np.mean(found, axis=0).tolist(), strict=True))
    assert all(abs(mean[f"front.{kind}"]) < 0.6 for kind in ("focal", "x", "y")), mean
    assert abs(mean["front.z"]) < 0.02


def test_noise_along_one_axis_of_the_image_shifts_no_error_of_the_camera():
    """The mean over drives, of rays in one half of the image. Derivatives by a lens or a rotation at the measured rays have
    the noise of these rays, which no noise along the other axis balances here: yaw and centre were 1.3 sigmas off."""
    found, none, noise_of_rays = [], PoseNoise(), np.radians(0.6)
    for seed in range(6):
        free = {"pixel_sigma": 0.0, "missed": 0.0, "false": 0.0, "localization": none, "localization_rate": 50.0}
        log = simulate(preset("demo", odometry=None, objects=8, classes=8, frames=2400, **free), seed)
        errors, association, start = parts(log)
        rays = errors.rays
        turned = np.zeros((len(rays), 3))
        turned[:, 1] = np.random.default_rng(seed).normal(scale=noise_of_rays, size=len(rays))
        direction = np.einsum("rij,rj->ri", rotation_from_vector(turned), rays.direction)
        noisy = replace(rays, direction=direction, sigma=np.full(len(rays), noise_of_rays))
        half = replace(association, object=np.where(rays.direction[:, 0] > 0, association.object, -1))
        errors = errors.take(errors.keyframes, noisy)
        calibration = calibrate_at_poses(errors, half, start, errors.mean, (0.0, 0.0)).calibration
        found.append(calibration.values / calibration.sigma)
    mean = dict(zip(calibration.names, np.mean(found, axis=0).tolist(), strict=True))
    assert all(abs(value) < 0.6 for value in mean.values()), mean


def test_the_points_follow_the_errors_as_a_whole_fit_does():
    """The sensitivity of the points, against points that scipy fits to the rays at a slightly smaller and a larger error."""
    errors, association, start = parts(exact())
    theta = np.zeros(len(errors.names))
    found = calibrate_at_poses(errors, association, start, theta, noise(errors))
    told = np.flatnonzero(np.isfinite(start[:, 0]))

    def fitted(j: int, values: np.ndarray) -> np.ndarray:
        keyframes, rays, _ = errors.at(values)
        mine = association.object == j
        origins, directions = (a[mine] for a in rays.in_map(keyframes.map_T_camera))
        sigma, place = (np.hypot(errors.rays.sigma, errors.settings.localization.yaw)[mine], errors.settings.localization.xy)

        def off(point: np.ndarray) -> np.ndarray:
            to = point - origins
            distance = np.linalg.norm(to, axis=1, keepdims=True)
            return (np.cross(to / distance, directions) / np.hypot(sigma[:, None], place / distance)).ravel()

        return np.asarray(least_squares(off, start[j], xtol=1e-14, ftol=1e-14).x)

    for k, step in enumerate(1e-3 * np.eye(len(theta))):
        for j in told[:3]:
            moved = (fitted(j, theta + step) - fitted(j, theta - step)) / 2e-3
            mine = found.sensitivity[j, :, k]
            assert_allclose(mine, moved, atol=0.05 * np.linalg.norm(moved) + 0.01, err_msg=f"{errors.names[k]} {j}")


def straight(clock: float) -> Log:
    """A robot that drives straight on at 0.5 m/s, and looks to its left at six things. Its camera's clock is off."""
    camera = make_camera("left", yaw=np.pi / 2, position=(0.0, 0.0, 0.3))
    places = np.array(
        [[x, y, z] for x, y, z in ((1, 2, 0.5), (2, 3, 1), (3, 1.5, 0.2), (4, 4, 0.8), (5, 2, 0.4), (5.5, 3, 1))]
    )
    stamps = np.arange(0.0, 16.0, 0.1)
    path = lift_se2(np.stack([0.5 * stamps, np.zeros_like(stamps), np.zeros_like(stamps)], axis=1))
    taken = np.arange(2.0, 14.0, 0.2)
    frames, boxes, labels = [], [], []
    for number, true in enumerate(taken + clock):
        for label, place in enumerate(places):
            at = camera.base_T_camera[:3, :3].T @ (place - [0.5 * true, 0, 0] - camera.base_T_camera[:3, 3])
            x, y = camera.matrix[0, 0] * at[:2] / at[2] + camera.matrix[:2, 2]
            if at[2] > 0 and 20 < x < 620 and 20 < y < 460:
                frames.append(number)
                boxes.append([x - 8, y - 8, x + 8, y + 8])
                labels.append(label)
    count = len(frames)
    names = tuple("abcdef")
    found = Detections(
        taken, np.array(frames), np.array(boxes), np.array(labels), np.ones(count), np.full(count, np.nan),
        np.full(count, -1), names,
    )  # fmt: skip
    return Log("straight", (CameraLog(camera, found),), localization=Trajectory(stamps, path))


def test_what_a_drive_cannot_tell_stays_at_its_prior_and_widens_the_objects():
    """On a straight drive at one speed, a clock that is off moves the whole map along the drive, and no ray misses."""
    errors, association, start = parts(straight(0.1))
    found = calibrate_at_poses(errors, association, start, errors.mean, noise(errors))
    k = found.calibration.names.index("left.clock")
    assert abs(found.calibration.values[k]) < 0.02
    assert found.calibration.sigma[k] > 0.95 * 0.1
    assert not found.calibration.to_dict()["parameters"]["left.clock"]["observable"]
    assert_allclose(found.sensitivity[..., k], np.tile([0.5, 0.0, 0.0], (6, 1)), atol=0.01)
    spread = found.sensitivity @ found.calibration.covariance @ np.swapaxes(found.sensitivity, 1, 2)
    assert (np.sqrt(spread[:, 0, 0]) > 0.95 * 0.5 * 0.1).all()


def test_the_rays_vary_as_the_errors_do():
    errors, _, _ = parts(exact(), *HELD)
    covariance = np.diag([0.0, 0.0, 0.0, 0.02**2])
    names = errors.names
    assert names[-1] == "front.yaw"
    found = noise_of_errors(errors, Calibration(names, np.zeros(4), covariance, np.ones(4)))
    directions = errors.rays.in_map(errors.keyframes.map_T_camera)[1]
    assert_allclose(found, 0.02 * np.linalg.norm(directions[:, :2], axis=1), rtol=1e-3)  # about the vertical axis


def test_an_error_that_only_moves_the_map_lets_no_ray_miss_its_object():
    """On a straight drive, a clock that is off turns rays in the map, but all objects move with them."""
    errors, association, start = parts(straight(0.1))
    found = calibrate_at_poses(errors, association, start, errors.mean, noise(errors))
    positions = start + found.sensitivity @ (found.calibration.values - errors.mean)
    beside, turned = noise_beside_objects(errors, found, association, positions), noise_of_errors(errors, found.calibration)
    assert np.median(beside) < 0.25 * np.median(turned)
    alone = replace(association, object=np.where(np.arange(len(errors.rays)) % 2, association.object, -1))
    half = noise_beside_objects(errors, found, alone, positions)
    assert_allclose(half[1::2], beside[1::2])
    assert_allclose(half[::2], np.sqrt(np.median(beside[1::2] ** 2)))


def test_what_is_left_scatters_rays_beside_their_objects_as_it_says():
    """The misses of the rays, if the errors are drawn from their covariance, and the objects follow."""
    errors, association, start = parts(straight(0.0))
    found = calibrate_at_poses(errors, association, start, errors.mean, noise(errors))
    values, rng = found.calibration.values, np.random.default_rng(0)
    positions = start + found.sensitivity @ (values - errors.mean)
    told, squares = noise_beside_objects(errors, found, association, positions), np.zeros(len(errors.rays))

    def misses(step):
        keyframes, rays, _ = errors.at(values + step, drift=False)
        origins, directions = rays.in_map(keyframes.map_T_camera)
        to = (positions + found.sensitivity @ step)[association.object] - origins
        return directions - to / np.linalg.norm(to, axis=1, keepdims=True)

    for step in rng.multivariate_normal(np.zeros(len(values)), found.calibration.covariance, 400):
        squares += ((misses(step) - misses(0 * step)) ** 2).sum(axis=1) / 400
    assert_allclose(np.median(told), np.median(np.sqrt(squares)), rtol=0.15)


def test_rays_that_err_together_count_less():
    """If all rays of a frame err alike, a frame tells as much as one ray. Ten equal rays must not shrink the sigma."""
    log = simulate(preset("demo", odometry=None, objects=6, classes=6, frames=200, false=0.0), 2)
    errors, association, start = parts(log)
    found = calibrate_at_poses(errors, association, start, errors.mean, noise(errors)).calibration
    ten = np.repeat(np.arange(len(errors.rays)), 10)
    copied = replace(errors, rays=errors.rays.take(ten))
    ten_of = replace(association, object=association.object[ten])
    again = calibrate_at_poses(copied, ten_of, start, errors.mean, noise(copied)).calibration
    assert (again.sigma > 0.7 * found.sigma).all()  # without that it would be a third


def test_no_object_is_no_calibration():
    errors, association, start = parts(exact())
    with pytest.raises(SolveError, match="no object"):
        calibrate_at_poses(errors, association, np.full_like(start, np.nan), errors.mean, noise(errors))


@pytest.mark.parametrize("yaws", [(0.0,), (0.0, 2.0)])
def test_the_vector_is_the_gradient_of_the_cost(yaws):
    """Also if the errors of two cameras move at once: an error of one moves no ray of the other."""
    cameras = tuple(make_camera(name, yaw=yaw) for name, yaw in zip(("front", "left"), yaws, strict=False))
    errors, association, start = parts(add_shared_errors(exact(cameras=cameras), {"front.yaw": 0.003}))
    theta = np.zeros(len(errors.names))
    held = association.object >= 0

    def system(values: np.ndarray, points: np.ndarray):
        return linearise_points(errors, values, points, association.object, held, noise(errors))

    points = start
    for _ in range(8):
        points = points + system(theta, points).own
    here = system(theta, points)
    for k, step in enumerate(1e-5 * np.eye(len(theta))):
        ahead, behind = (system(theta + s * step, points + s * here.back @ step).cost for s in (1, -1))
        assert (ahead - behind) / 2e-5 == pytest.approx(2 * here.vector[k], rel=0.05, abs=0.02 * np.abs(here.vector).max())
