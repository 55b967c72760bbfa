"""The compiled bearing-ray factors against the formula itself."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from custom_factor import eq1_factor, eq1_fixed_factor
from gtsam.utils.numerical_derivative import numericalDerivative21, numericalDerivative22

from objslam.config import Settings
from objslam.core.geometry import adjoint, exp_se3, inverse, lift_se2, make_pose
from objslam.core.statistics import CAUCHY_K, HUBER_K
from objslam.core.types import Keyframes
from objslam.graph.factors.bearing import bearings, point_to_line, point_to_line_fixed
from objslam.graph.factors.localization import localizations
from objslam.graph.factors.noise import robust
from objslam.graph.factors.odometry import betweens, motions
from objslam.graph.factors.range import along_ray, ranges
from objslam.graph.variables import L0, X0

X, L = (X0 + 0), (L0 + 0)


def scene(seed: int):
    """A random camera pose (4, 4), a unit ray in its frame and a point 0.5 to 20 m away, up to 60 degrees off the ray."""
    rng = np.random.default_rng(seed)
    pose = exp_se3(np.concatenate([rng.normal(size=3), rng.normal(scale=20, size=3)])[None])[0]
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    off = np.cross(direction, rng.normal(size=3))
    off /= np.linalg.norm(off)
    angle, distance = rng.uniform(0.01, np.pi / 3), rng.uniform(0.5, 20)
    point = pose[:3, 3] + pose[:3, :3] @ (distance * (np.cos(angle) * direction + np.sin(angle) * off))
    return pose, direction, point, angle, distance


def values_of(pose, point):
    values = gtsam.Values()
    values.insert(X, gtsam.Pose3(pose))
    values.insert(L, point)
    return values


def information(factor, values, keys):
    """J^T J of the whitened linearised factor, in the order of the keys."""
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(factor)
    return graph.linearize(values).hessian(ordering)[0]


@pytest.mark.parametrize("seed", range(25))
@pytest.mark.parametrize("behind", [False, True])
def test_point_to_line_is_eq1(seed, behind):
    pose, direction, point, angle, distance = scene(seed)
    if behind:  # Eq. 1 is about lines: a point behind the camera has a distance like any other, and nothing throws
        point = 2 * pose[:3, 3] - point
    values = values_of(pose, point)
    unit2, unit3 = gtsam.noiseModel.Unit.Create(2), gtsam.noiseModel.Unit.Create(3)
    compiled = point_to_line(np.array([0]), direction[None], np.array([0]), [unit2])[0]
    oracle = eq1_factor(X, L, direction, unit3)
    truth = distance * np.sin(angle)
    assert np.linalg.norm(oracle.unwhitenedError(values)) == pytest.approx(truth, rel=1e-9)
    assert np.linalg.norm(compiled.unwhitenedError(values)) == pytest.approx(truth, rel=1e-5)
    # the oracle's third row is along the ray: it carries an information of its own only off the ray (second order)
    a, b = information(compiled, values, [X, L]), information(oracle, values, [X, L])
    n = pose[:3, :3] @ direction
    np.testing.assert_allclose(a[6:, 6:], np.eye(3) - np.outer(n, n), atol=1e-5)
    np.testing.assert_allclose(a[6:, 6:], b[6:, 6:], atol=1e-5)
    np.testing.assert_allclose(a[3:6, 3:], b[3:6, 3:], atol=2e-5 * distance)


@pytest.mark.parametrize("seed", range(10))
def test_point_to_line_has_the_whole_information_on_the_ray(seed):
    pose, direction, _, _, distance = scene(seed)
    values = values_of(pose, pose[:3, 3] + distance * pose[:3, :3] @ direction)
    noise = gtsam.noiseModel.Isotropic.Sigma
    compiled = point_to_line(np.array([0]), direction[None], np.array([0]), [noise(2, 0.1)])[0]
    a = information(compiled, values, [X, L])
    b = information(eq1_factor(X, L, direction, noise(3, 0.1)), values, [X, L])
    np.testing.assert_allclose(a, b, atol=1e-5 * np.abs(b).max())


def numerical(factor, pose, point, step):
    def error(x, p):
        return factor.unwhitenedError(values_of(x.matrix(), p))

    x = gtsam.Pose3(pose)
    return numericalDerivative21(error, x, point, step), numericalDerivative22(error, x, point, step)


@pytest.mark.parametrize("seed", range(10))
def test_point_to_line_jacobians_are_numerical_derivatives(seed):
    pose, direction, point, _, _ = scene(seed)
    factor = point_to_line(np.array([0]), direction[None], np.array([0]), [gtsam.noiseModel.Unit.Create(2)])[0]
    # at 1e7 m the differences of rounded coordinates limit the numerical side: hence the long step
    by_pose, by_point = numerical(factor, pose, point, 1e-3)
    jacobian = factor.linearize(values_of(pose, point)).jacobian()[0]
    np.testing.assert_allclose(columns(factor, jacobian, X), by_pose, atol=2e-3)
    np.testing.assert_allclose(columns(factor, jacobian, L), by_point, atol=1e-4)


@pytest.mark.parametrize("seed", range(10))
def test_bearing_residual_is_the_angle_and_its_jacobians_the_derivatives_near_the_ray(seed):
    pose, direction, _, _, distance = scene(seed)
    off = np.cross(direction, [0.3, -0.5, 0.8])
    off /= np.linalg.norm(off)
    angle = np.radians(0.5)
    point = pose[:3, 3] + pose[:3, :3] @ (distance * (np.cos(angle) * direction + np.sin(angle) * off))
    factor = bearings(np.array([0]), direction[None], np.array([0]), [gtsam.noiseModel.Unit.Create(2)])[0]
    values = values_of(pose, point)
    assert np.linalg.norm(factor.unwhitenedError(values)) == pytest.approx(angle, rel=1e-4)
    # GTSAM takes the chart's derivative at the measured direction: exact on the ray, off like the angle beside it
    by_pose, by_point = numerical(factor, pose, point, 1e-5)
    jacobian = factor.linearize(values).jacobian()[0]
    np.testing.assert_allclose(columns(factor, jacobian, X), by_pose, atol=angle)
    np.testing.assert_allclose(columns(factor, jacobian, L), by_point, atol=angle)


def columns(factor, jacobian, key):
    start = 0
    for k in list(factor.keys()):
        width = 6 if k == X else 3
        if k == key:
            return jacobian[:, start : start + width]
        start += width
    raise KeyError(key)


def test_fixed_point_to_line_has_the_optimum_of_the_oracle():
    rng = np.random.default_rng(3)
    truth = np.array([2.0, -1.0, 0.7])
    origins = rng.uniform(-4, 4, (12, 3))
    directions = truth - origins + rng.normal(scale=0.05, size=(12, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    start = gtsam.Values()
    start.insert(L, truth + 0.5)
    optima = []
    for dimension in (2, 3):
        # a kink well above rounding: both graphs then have a smooth cost with one minimum
        noise = robust("l1", np.ones(12), dimension, 1e-2)
        graph = gtsam.NonlinearFactorGraph()
        if dimension == 2:
            made = point_to_line_fixed(origins, directions, np.zeros(12, dtype=int), noise)
        else:
            made = [eq1_fixed_factor(L, m, n, model) for m, n, model in zip(origins, directions, noise, strict=True)]
        for factor in made:
            graph.push_back(factor)
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setRelativeErrorTol(1e-14)
        parameters.setAbsoluteErrorTol(1e-14)
        parameters.setMaxIterations(500)
        optima.append(gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize().atPoint3(L))
    assert np.linalg.norm(optima[0] - optima[1]) < 1e-5
    assert np.linalg.norm(optima[0] - truth) < 0.1


def planar_keyframes(xy_yaw, drift):
    """Keyframes of a planar odometry with a camera that looks forward and down a little."""
    base_T_camera = make_pose(np.array([[0.0, 0.1, 0.99], [-1, 0, 0], [0, -0.99, 0.1]]), np.array([0.2, 0.05, 0.4]))
    u, _, vt = np.linalg.svd(base_T_camera[:3, :3])
    base_T_camera[:3, :3] = u @ vt
    odom_T_base = lift_se2(np.asarray(xy_yaw, dtype=float))
    n = len(odom_T_base)
    return Keyframes(
        stamps=np.arange(n, dtype=float),
        camera=np.zeros(n, dtype=np.int64),
        frame=np.arange(n),
        base_T_camera=np.tile(base_T_camera, (n, 1, 1)),
        map_T_base=odom_T_base,
        odom_T_base=odom_T_base,
        drift=drift,
    )


def test_motion_is_the_odometry_moved_to_the_camera():
    keyframes = planar_keyframes([[0, 0, 0.3], [1.0, 0.5, 0.9]], np.zeros((2, 6, 6)))
    settings = Settings()
    motion, covariance = motions(keyframes, settings)
    extrinsics = keyframes.base_T_camera[0]
    odo = inverse(keyframes.odom_T_base[0]) @ keyframes.odom_T_base[1]
    np.testing.assert_allclose(motion[0], inverse(extrinsics) @ odo @ extrinsics, atol=1e-12)
    o, p = settings.odometry, settings.planar
    s = np.diag([p.tilt, p.tilt, o.floor_yaw, o.floor_xy, o.floor_xy, p.z]) ** 2
    ad = adjoint(inverse(extrinsics))
    np.testing.assert_allclose(covariance[0], ad @ s @ ad.T, atol=1e-15)


@pytest.mark.parametrize("sigma", [0.002, 0.05, 3.0])
def test_losses_cost_what_their_formulas_say(sigma):
    distance = np.array([0.01, 0.5, 1.5, 4, 30]) * sigma  # on both sides of every kink
    kink = 1e-3 * sigma
    r, k, c = distance / sigma, HUBER_K, CAUCHY_K
    expected = {
        "l1": r - 0.5e-3,
        "huber": np.where(r <= k, r**2 / 2, k * r - k**2 / 2),
        "cauchy": c**2 / 2 * np.log1p((r / c) ** 2),
        "gnc": r**2 / 2,
    }
    for loss, cost in expected.items():
        (model,) = robust(loss, np.array([sigma]), 3, kink)
        prior = gtsam.PriorFactorPoint3(L, np.zeros(3), model)
        found = []
        for d in distance:
            values = gtsam.Values()
            values.insert(L, np.array([0.6 * d, 0, -0.8 * d]))
            found.append(prior.error(values))
        np.testing.assert_allclose(found, cost, rtol=1e-9, err_msg=loss)


def test_noise_models_are_shared_where_sigmas_agree_to_three_digits():
    sigmas = np.array([0.0100, 0.010001, 0.0102, 0.0100, 12.341, 12.342])
    models = robust("huber", sigmas, 2)
    assert models[0] is models[1]
    assert models[0] is models[3]
    assert models[0] is not models[2]
    assert models[4] is models[5]
    assert robust("huber", np.zeros(0), 2) == []


def test_a_range_along_a_ray_says_nothing_across_it():
    rng = np.random.default_rng(4)
    origin, n = rng.normal(size=3), np.array([2.0, -1, 2]) / 3
    (factor,) = along_ray(origin[None], n[None], np.array([4.0]), np.array([0.1]), np.array([0]))
    for along in (-0.1, 0.0, 0.2):
        values = gtsam.Values()
        values.insert(L, origin + (4.0 + along) * n + 7.0 * np.cross(n, [0.6, 0, 0.8]))
        r = abs(along) / 0.1
        k = HUBER_K
        assert factor.error(values) == pytest.approx(r**2 / 2 if r <= k else k * r - k**2 / 2, abs=1e-9)


def test_a_range_is_the_distance_from_the_camera():
    pose, _, point, _, distance = scene(1)
    (factor,) = ranges(np.array([0]), np.array([distance + 0.3]), np.array([0]), [gtsam.noiseModel.Unit.Create(1)])
    assert factor.unwhitenedError(values_of(pose, point))[0] == pytest.approx(-0.3)


def test_betweens_tie_each_keyframe_to_the_next():
    keyframes = planar_keyframes([[0, 0, 0], [1, 0, 0.2], [1.5, 1, 0.5]], np.zeros((3, 6, 6)))
    made = betweens(np.array([5, 6]), np.array([6, 7]), *motions(keyframes, Settings()))
    values = gtsam.Values()
    for k, pose in enumerate(keyframes.odom_T_base @ keyframes.base_T_camera):
        values.insert((X0 + 5 + k), gtsam.Pose3(pose))
    assert [list(factor.keys()) for factor in made] == [
        [(X0 + 5), (X0 + 6)],
        [(X0 + 6), (X0 + 7)],
    ]
    for factor in made:
        np.testing.assert_allclose(factor.unwhitenedError(values), 0, atol=1e-12)


def test_each_stretch_of_the_odometry_has_a_plane_of_its_own():
    keyframes = planar_keyframes([[0, 0, 0], [1, 0, 0.2], [1.5, 1, 0.5], [2, 1, 0.5]], np.zeros((4, 6, 6)))
    _, flat = motions(keyframes, Settings())
    tilted = keyframes.odom_T_base.copy()
    tilted[2:] = make_pose(np.array([[1.0, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]), np.ones(3)) @ tilted[2:]
    stretches = replace(keyframes, odom_T_base=tilted, localized_every=1.0, stretch=np.array([0, 0, 1, 1]))
    for steps in (stretches, replace(stretches, stretch=np.array([3, 3, -1, -1]))):
        _, covariance = motions(steps, Settings())
        np.testing.assert_allclose(covariance[0], flat[0], atol=1e-12)


def test_motions_need_odometry():
    keyframes = replace(planar_keyframes([[0, 0, 0], [1, 0, 0]], None), odom_T_base=None)
    with pytest.raises(ValueError, match="odometry"):
        motions(keyframes, Settings())


def test_localisations_hold_the_camera_as_the_base_is_known():
    keyframes = replace(planar_keyframes([[3, -2, 0.7], [1, 0, 0]], None), localized_every=4.0)
    settings = Settings()
    first, _ = localizations(keyframes, settings)
    extrinsics, base = keyframes.base_T_camera[0], keyframes.map_T_base[0]
    at, planar = settings.localization, settings.planar
    sigmas = 2.0 * np.array([planar.tilt, planar.tilt, at.yaw, at.xy, at.xy, planar.z])  # four share one: twice as unsure
    for axis in range(6):
        twist = np.zeros(6)
        twist[axis] = 0.5 * sigmas[axis]
        values = gtsam.Values()
        values.insert(X, gtsam.Pose3(base @ exp_se3(twist[None])[0] @ extrinsics))
        assert first.error(values) == pytest.approx(0.5 * 0.5**2, rel=1e-3)
