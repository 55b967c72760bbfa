"""Errors of a localisation that last: their factors, their rows, and their size as the log shows it."""

from dataclasses import replace

import numpy as np
import pytest
from drives import drive_of
from lasting_localization import with_lasting
from numpy.testing import assert_allclose
from test_joint_rows import by_gtsam

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import exp_se3
from objslam.core.statistics import WHITE, Lasting
from objslam.core.types import Log
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors
from objslam.graph.assembly import Measurements
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.calibration.localization_noise import noise_of_paths
from objslam.graph.calibration.pose_errors import ComparedPoses, ErrorKind, PoseErrors, most_likely
from objslam.graph.calibration.shared_error_jacobian import linearise
from objslam.graph.calibration.shrinkage import force_of_heights
from objslam.graph.factors.localization import chain, localized_motions
from objslam.graph.least_squares.joint_rows import JointGraph
from objslam.simulation import PoseNoise, preset, simulate

LONG, AT = 32.0, 5
"""s; one of the times that a search tries, and its index."""
LASTING = Lasting(1.0, 5.0), Lasting(0.8, 3.0)


def information(gaps: np.ndarray, sigma: float, lasting: Lasting) -> np.ndarray:
    """The information matrix of the terms of `chain`."""
    single, apart = chain(gaps, sigma, lasting)
    between = np.diff(np.eye(len(single)), axis=0)
    return np.diag(single**-2) + between.T @ np.diag(apart**-2) @ between


def covariance(gaps: np.ndarray, sigma: float, lasting: Lasting) -> np.ndarray:
    times = np.append(0.0, np.cumsum(gaps))
    alike = np.exp(-np.abs(times[:, None] - times) / lasting.seconds)
    return sigma**2 * (lasting.share * alike + (1 - lasting.share) * np.eye(len(times)))


def test_the_terms_of_an_error_that_only_lasts_are_its_whole_information():
    gaps = np.random.default_rng(0).uniform(0.05, 3.0, 20)
    lasting = Lasting(1.0, 2.0)
    assert_allclose(information(gaps, 0.7, lasting) @ covariance(gaps, 0.7, lasting), np.eye(21), atol=1e-9)


def test_an_error_that_is_new_in_each_pose_has_no_terms_between_poses():
    single, apart = chain(np.full(5, 0.1), 0.3, WHITE)
    assert_allclose(single, 0.3)
    assert np.isinf(apart).all()


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
@pytest.mark.parametrize("seconds", [1.0, 20.0])
def test_the_terms_of_an_error_with_both_parts_promise_no_more_than_there_is(share, seconds):
    gaps, lasting = np.full(300, 0.25), Lasting(share, seconds)
    told, root = information(gaps, 1.0, lasting), np.linalg.cholesky(covariance(gaps, 1.0, lasting))
    told = np.linalg.eigvalsh(root.T @ told @ root)
    assert told[-1] < 1.3  # At both ends of the chain. Everywhere else, it is below 1.
    assert told[-3] < 1.01
    constant = np.ones(301)
    exact = constant @ np.linalg.solve(covariance(gaps, 1.0, lasting), constant)
    assert 0.7 * exact < constant @ information(gaps, 1.0, lasting) @ constant < 1.05 * exact


def localised(seed: int = 3, **changes):
    settings = load_settings(None, ("mode=joint",))
    changes = {"frames": 200, "objects": 8, "classes": 8, "odometry": Odometry(), **changes}
    return simulate(preset("demo", **changes), seed), settings


def test_the_rows_are_those_of_gtsam():
    """Far from the optimum, where robust weights count."""
    log, settings = localised()
    made = drive_of(log, settings)
    rng, used = np.random.default_rng(0), made.right()
    measured = Measurements.of(replace(made.keyframes, lasting=LASTING), made.rays, settings)
    poses = made.map_T_base @ made.keyframes.base_T_camera
    poses = poses @ exp_se3(rng.normal(scale=0.05, size=(len(poses), 6)))
    graph, values = measured.whole(made.association.object, used, poses, made.points)
    rows = JointGraph.of(measured, made.association, used, made.points).rows(poses, made.points)
    jacobian, residual = by_gtsam(graph, values, *rows.jacobian.shape)
    largest = np.abs(jacobian).max(axis=1, keepdims=True)
    assert_allclose(rows.jacobian.toarray() / largest, jacobian / largest, atol=5e-3)
    assert_allclose(rows.residual, residual, atol=5e-3 * np.abs(residual).max())
    assert rows.cost == pytest.approx(graph.error(values), rel=2e-3)
    motions = measured.localized_motions
    assert motions is not None
    assert len(motions.before) == len(poses) - 1


def test_the_sides_of_a_clock_contain_the_motions_of_the_localisation():
    log, settings = localised(localization=PoseNoise(xy=1e-4, yaw=1e-4))
    ledger = Ledger()
    keyframes = build_keyframes(log, settings, ledger)
    errors = shared_errors(log, keyframes, build_rays(log, keyframes, settings, ledger), settings)
    assert errors is not None
    noise = replace(errors.noise, heading_share=1.0, heading_seconds=5.0, place_share=1.0, place_seconds=5.0)
    errors, theta = errors.with_noise(noise), errors.mean
    nothing = np.zeros(len(errors.rays), dtype=bool)
    made = drive_of(log, settings)

    def state(values):
        measured = Measurements.of(*errors.at(values))
        return Linearised(measured, made.association, poses, np.zeros((0, 3)), nothing)

    poses = errors.at(theta)[0].map_T_camera
    system, clock = linearise(state(theta), errors, theta), errors.names.index("front.clock")
    step = errors.steps[clock] * np.eye(len(theta))[clock]
    ahead, behind = (state(theta + sign * step).rows.residual for sign in (1, -1))
    last = 6 * (len(poses) - 1)
    told = (ahead - behind)[-last:] / (2 * errors.steps[clock])
    assert np.abs(told).max() > 1
    off = np.maximum(np.abs(ahead[-last:]), np.abs(behind[-last:]))
    near = off.reshape(-1, 6).max(axis=1) < 1  # Others have another robust weight after the step.
    assert near.mean() > 0.5
    assert_allclose(
        system.sides[-last:, clock].reshape(-1, 6)[near], told.reshape(-1, 6)[near], atol=0.02 * np.abs(told).max()
    )


@pytest.mark.parametrize("scale", [0.0, 0.1])
def test_motions_that_seem_short_or_long_have_the_same_noise(scale):
    """Else, short ones would count for more, and the map would be too small."""
    log, settings = localised(localization=PoseNoise(xy=0.3, yaw=0.02))
    ledger = Ledger()
    keyframes = build_keyframes(log, settings, ledger)
    errors = shared_errors(log, keyframes, build_rays(log, keyframes, settings, ledger), settings)
    noise = replace(errors.noise, heading_share=1.0, heading_seconds=60.0, place_share=1.0, place_seconds=60.0)
    errors = errors.with_noise(noise)
    places = keyframes.map_T_base.copy()
    places[:, :2, 3] = keyframes.odom_T_base[:, :2, 3]
    exact = replace(keyframes, map_T_base=places, lasting=noise.lasting)
    given, _, told = errors.at(np.where(np.array(errors.names) == "odometry.scale", scale, errors.mean))
    noisy = localized_motions(replace(given, base_T_camera=keyframes.base_T_camera), told)
    assert_allclose(noisy.covariance, localized_motions(exact, settings).covariance, rtol=1e-6, atol=1e-12)


def test_the_noise_of_heights_does_not_make_a_map_small():
    log, settings = localised()
    settings = settings.model_copy(update={"planar": settings.planar.model_copy(update={"z": 0.05, "seconds": 3.0})})
    made = drive_of(log, settings)
    measured = Measurements.of(replace(made.keyframes, lasting=LASTING), made.rays, settings)
    height = 0.003 * np.random.default_rng(0).standard_normal(len(made.keyframes))

    def cost(larger):
        poses = made.keyframes.map_T_base.copy()
        poses[:, 2, 3] += larger * height
        state = Linearised(measured, made.association, poses @ made.keyframes.base_T_camera, made.points, made.right())
        return state, state.rows.residual[state.graph.first_motion + 6 * len(state.graph.moves[0]) :]

    (state, _), (_, more), (_, less) = cost(1.0), cost(1.001), cost(0.999)
    assert force_of_heights(state) == pytest.approx((more @ more - less @ less) / 2 / 0.002, rel=1e-3)
    assert force_of_heights(cost(0.0)[0]) == pytest.approx(0.0, abs=1e-6)


def found_in(log: Log, *told: str):
    settings, ledger = load_settings(None, ("mode=joint", *told)), Ledger()
    keyframes = build_keyframes(log, settings, ledger)
    errors = shared_errors(log, keyframes, build_rays(log, keyframes, settings, ledger), settings)
    return noise_of_paths(errors, errors.mean)


def test_the_cost_of_a_model_is_that_of_its_whole_covariance():
    """The search takes the places out first, and keeps them for all models of headings."""
    rng, n = np.random.default_rng(0), 12
    mixed, shared = rng.standard_normal((2, 3 * n, 3 * n))
    of = 0.01 * rng.standard_normal(3 * n), 1e-4 * mixed @ mixed.T, 1e-5 * shared @ shared.T
    data = ComparedPoses(*of, np.arange(n), 0.0, (0.005, 0.02), True, 3.0)
    for heading in (ErrorKind(), ErrorKind(1.0, 5, 2)):
        for place, predicted in ((ErrorKind(0.5), 0.0), (ErrorKind(-0.2, 8, 4), 0.3)):
            model = PoseErrors(heading, place, predicted)
            whole = data.expected(model)
            own = 3.0 * (2 * predicted + np.exp(-2 * predicted)) + sum(max(of.factor, 0.0) ** 2 for of in (heading, place))
            cost = data.off @ np.linalg.solve(whole, data.off) + np.linalg.slogdet(whole)[1] + own
            assert data.cost(model) == pytest.approx(cost, rel=1e-9)
    singular = replace(data, shared=-2 * of[1])
    assert singular.cost(PoseErrors(place=ErrorKind(-9.0))) == np.inf


def drifting(seed: int, size: tuple[float, float], seconds: float) -> ComparedPoses:
    """A localisation that errs for seconds by size, rad and m, against a path of 480 s by good odometry, at 108 poses."""
    rng, steps = np.random.default_rng(seed), 4800
    at = np.unique(np.linspace(0, steps - 17, 18).astype(int)[:, None] + [0, 1, 2, 4, 8, 16])
    n, times = len(at), 0.1 * at
    yaw = np.cumsum(np.repeat(rng.uniform(-0.05, 0.05, 48), 100))
    along = np.column_stack([np.cos(yaw), np.sin(yaw)])
    place = np.cumsum(0.03 * along, axis=0)
    past = (at[:, None] >= np.arange(steps)).astype(float)
    to = place[at][:, None] - place
    turns = 2e-4 * np.concatenate([past, -past * to[..., 1], past * to[..., 0]])
    ways = 6e-4 * np.concatenate([0 * past, past * along[:, 0], past * along[:, 1]])
    whole = np.zeros((3 * n, 3))  # No measurement tells where the map is.
    whole[:n, 0], whole[n : 2 * n, 0], whole[2 * n :, 0] = 1, -place[at, 1], place[at, 0]
    whole[n : 2 * n, 1], whole[2 * n :, 2] = 1, 1
    rows = np.hstack([turns, ways, whole, 1e-4 * np.eye(3 * n)])
    root = np.linalg.cholesky(np.exp(-np.abs(times[:, None] - times) / seconds) + 1e-9 * np.eye(n))
    own = np.concatenate([each * root @ rng.standard_normal(n) for each in (size[0], size[1], size[1])])
    off = rows @ rng.standard_normal(rows.shape[1]) + own
    return ComparedPoses(off, rows @ rows.T, 0 * rows @ rows.T, times, 0.0, (0.005, 0.02), True, 20.0)


@pytest.mark.parametrize(("yaw", "xy", "seed"), [(0.0036, 0.02, 0), (0.0036, 0.02, 4), (0.02, 0.05, 2), (0.005, 0.2, 1)])
def test_the_search_finds_a_model_as_likely_as_the_true_one(yaw, xy, seed):
    """A search that begins at white errors, which the drift of the odometry mostly explains, ends 46 and 98 above the cost
    of the true model. Larger errors that last longer look the same from pose to pose: one that changes only one value at a
    time ends 26 and 14 above it."""
    data = drifting(seed, (yaw, xy), LONG)
    true = PoseErrors(ErrorKind(np.log(yaw / 0.005), 8, AT), ErrorKind(np.log(xy / 0.02), 8, AT))
    found = most_likely(data)
    assert data.cost(found) < data.cost(true) + 2
    assert found.place.lasting.seconds == pytest.approx(LONG, rel=0.6)
    assert 0.02 * np.exp(found.place.factor) == pytest.approx(xy, rel=0.5)


def test_a_localisation_that_errs_as_the_settings_say_has_no_more_noise():
    for seed in range(3):
        log, _ = localised(seed, localization=PoseNoise(xy=0.02, yaw=0.005))
        found = found_in(log)
        assert (found.heading, found.place) == (1.0, 1.0)
        assert found.lasting == (WHITE, WHITE)


def test_a_localisation_without_errors_has_no_lasting_ones():
    """Its small differences from pose to pose must not count as a large error that hardly changes."""
    for seed in range(2):
        found = found_in(localised(seed, localization=PoseNoise(xy=1e-4, yaw=1e-4))[0])
        assert (found.heading, found.place) == (1.0, 1.0)
        assert found.lasting == (WHITE, WHITE)


def test_the_size_of_lasting_errors_and_their_time_are_found():
    sizes, times = [], []
    for seed in range(3):
        log, _ = localised(seed, frames=600, localization=PoseNoise(xy=0.001, yaw=0.001))
        found = found_in(with_lasting(log, 1.0, 3.0, seed, 0.3, 0.01))
        sizes.append(0.02 * found.place)
        times.append(found.place_seconds)
        assert found.place_share > 0.9
    assert 0.2 < np.median(sizes) < 0.5
    assert 1.5 < np.median(times) < 10


def test_new_errors_in_each_pose_are_found_to_be_new():
    log, _ = localised(0, localization=PoseNoise(xy=0.2, yaw=0.01))
    found = found_in(log)
    assert 0.15 < 0.02 * found.place < 0.25
    assert found.place_share < 0.2


def test_how_long_errors_last_is_found_if_their_size_is_given():
    log, _ = localised(0, frames=600, localization=PoseNoise(xy=0.001, yaw=0.001))
    found = found_in(with_lasting(log, 1.0, 3.0, 0, 0.3, 0.01), "localization.xy=0.3", "localization.yaw=0.01")
    assert (found.heading, found.place) == (1.0, 1.0)
    assert found.place_share > 0.9
    assert 1 < found.place_seconds < 10


def test_a_jump_is_no_noise():
    log, _ = localised(0, localization=PoseNoise(xy=0.02, yaw=0.005))
    path = log.localization
    poses = path.poses.copy()
    poses[60:63, :2, 3] += 3.0
    found = found_in(replace(log, localization=replace(path, poses=poses)))
    assert found.place < 1.5
