"""Images of one stamp share one pose: a rig of cameras against single cameras, and against brute force."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from added_errors import add_shared_errors
from drives import drive_of
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import make_pose
from objslam.core.types import Keyframes
from objslam.frontend.known_errors import shared_errors
from objslam.graph.assembly import Measurements
from objslam.graph.batch_solver import solve_joint
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.calibration.shared_error_jacobian import linearise
from objslam.graph.factors.bearing import bearings, ray_residuals, tangent_basis
from objslam.graph.factors.range import ranges
from objslam.graph.multiframes import TOGETHER, Multiframes
from objslam.graph.optimizers import build_graph
from objslam.graph.variables import L0, X0, make_values
from objslam.simulation import DepthNoise, PoseNoise, make_camera, preset, simulate

RIG = (
    make_camera("front", position=(0.25, 0.0, 0.3)),
    make_camera("left", position=(0.0, 0.2, 0.5), yaw=np.radians(75), pitch=0.1),
    make_camera("right", position=(0.0, -0.2, 0.3), yaw=np.radians(-75)),
)
UNIT = gtsam.noiseModel.Unit.Create


def rig_drive(errors=None, seed=1, overrides=(), **changes):
    """A drive with three cameras that take their images together, and its shared errors."""
    settings = load_settings(None, ("mode=joint", "depth.bias=0", *overrides))
    changes = {"frames": 200, "objects": 12, "classes": 12, "localization": None, "odometry": Odometry(), **changes}
    log = simulate(preset("demo", **{"pixel_sigma": 3.0, "together": True, "cameras": RIG, **changes}), seed)
    made = drive_of(add_shared_errors(log, errors or {}), settings)
    return made, shared_errors(
        log if errors is None else add_shared_errors(log, errors), made.keyframes, made.rays, settings
    )


def keyframes_at(stamps, camera, stretch=None, localized_every=0.0):
    count = len(stamps)
    poses = np.tile(np.eye(4), (count, 1, 1))
    return Keyframes(
        stamps=np.array(stamps),
        camera=np.array(camera),
        frame=np.arange(count),
        base_T_camera=poses,
        map_T_base=poses,
        localized_every=localized_every,
        odom_T_base=poses,
        drift=np.zeros((count, 6, 6)),
        stretch=None if stretch is None else np.array(stretch),
    )


def test_images_of_one_stamp_are_joined():
    joined = Multiframes.of(keyframes_at([0, 0, 1, 1 + 0.9 * TOGETHER, 2, 2 + 1.1 * TOGETHER], [0, 1, 1, 0, 0, 1]))
    assert joined.number.tolist() == [0, 0, 1, 1, 2, 3]
    assert joined.first.tolist() == [0, 2, 4, 5]


def test_two_images_of_one_camera_are_never_joined():
    assert Multiframes.of(keyframes_at([0, 0.1 * TOGETHER, 0.2 * TOGETHER], [0, 0, 1])).number.tolist() == [0, 1, 1]


def test_a_gap_in_the_odometry_separates_images():
    beside = keyframes_at([0, 0, 1, 1], [0, 1, 0, 1], stretch=[0, 1, 1, 1], localized_every=1.0)
    assert Multiframes.of(beside).number.tolist() == [0, 1, 2, 2]


@pytest.mark.parametrize("errors", [{}, {"left.clock": 0.05, "right.clock": -0.03}])
def test_joined_rays_are_where_they_were(errors):
    """Also if the clocks of the cameras differ: then the robot moved between the images of a multiframe."""
    made, shared = rig_drive({}, frames=40)
    theta = np.array([errors.get(name, 0.0) for name in shared.names])
    images, rays, settings = shared.at(theta)
    measured = Measurements.of(images, rays, settings, Multiframes.of(shared.keyframes))
    assert len(measured.keyframes) == len(np.unique(made.keyframes.stamps)) < len(images)
    odometry = images.odom_T_base
    alone = rays.in_map(odometry @ images.base_T_camera)
    joined = measured.rays.in_map(measured.keyframes.odom_T_base @ measured.keyframes.base_T_camera)
    for one, other in zip(alone, joined, strict=True):
        assert_allclose(one, other, atol=1e-12)
    assert_allclose(
        measured.map_T_base(measured.keyframes.odom_T_base @ measured.keyframes.base_T_camera), odometry, atol=1e-12
    )


@pytest.mark.parametrize("seed", range(5))
def test_a_ray_with_an_offset_is_one_of_a_camera_there(seed):
    """Against GTSAM's own bearing and range factors, at the pose of a camera that stands where the ray begins."""
    rng = np.random.default_rng(seed)
    pose = make_pose(Rotation.random(random_state=seed).as_matrix(), rng.standard_normal(3))
    offset, direction = 0.3 * rng.standard_normal(3), rng.standard_normal(3)
    direction /= np.linalg.norm(direction)
    seen = 4 * direction + 0.5 * rng.standard_normal(3)
    point, zero = pose[:3, 3] + pose[:3, :3] @ (offset + seen), np.array([0])
    there = pose @ make_pose(np.eye(3), offset)
    values, values_there = (make_values(p[None], point[None], zero) for p in (pose, there))
    (aside,) = bearings(zero, direction[None], zero, [UNIT(2)], offset[None])
    (centred,) = bearings(zero, direction[None], zero, [UNIT(2)], np.zeros((1, 3)))
    assert isinstance(centred, gtsam.BearingFactor3D)
    # GTSAM takes the axes at the predicted direction, this factor at the measured one
    one, other = aside.unwhitenedError(values), centred.unwhitenedError(values_there)
    assert np.linalg.norm(one) == pytest.approx(np.linalg.norm(other), rel=1e-9)
    assert_allclose(one, other, atol=2 * np.linalg.norm(one) ** 2)
    residual = ray_residuals(direction[None], seen[None], tangent_basis(direction[None]), False)[0]
    assert_allclose(residual, aside.unwhitenedError(values), atol=1e-9)
    (measured,) = ranges(zero, np.array([4.0]), zero, [UNIT(1)], offset[None])
    assert measured.unwhitenedError(values)[0] == pytest.approx(np.linalg.norm(seen) - 4.0)
    for factor in (aside, measured):
        jacobian = factor.linearize(values).jacobian()[0]
        slopes = []
        for step in 1e-6 * np.eye(9):
            ahead, behind = (moved(pose, point, s * step) for s in (1, -1))
            slopes.append((factor.unwhitenedError(ahead) - factor.unwhitenedError(behind)) / 2e-6)
        # a factor has its keys in the order of X and L
        assert_allclose(jacobian, np.array(slopes).T, atol=1e-6)


def moved(pose, point, step):
    values = gtsam.Values()
    values.insert(X0, gtsam.Pose3(pose).retract(step[:6]))
    values.insert(L0, point + step[6:])
    return values


def test_an_object_behind_a_ray_with_an_offset_raises_nothing_and_costs_more_than_one_beside():
    zero, ahead = np.array([0]), np.array([[0.0, 0.0, 1.0]])
    (factor,) = bearings(zero, ahead, zero, [UNIT(2)], np.array([[0.1, 0.0, 0.0]]))
    behind, beside = (
        factor.error(make_values(np.eye(4)[None], np.array([p]), zero)) for p in ([0, 0, -3.0], [3.0, 0, 1e-6])
    )
    assert behind > beside


def test_the_columns_of_shared_errors_are_those_of_measuring_anew():
    """Brute force: the whitened residuals of the graph that is made at other shared errors, at the same poses and places."""
    exact = {"pixel_sigma": 0.0, "depth": DepthNoise(sigma=0, sigma_per_m=0), "false": 0.0, "odometry": PoseNoise()}
    made, errors = rig_drive({}, frames=40, overrides=("calibration.focal=0.01",), **exact)
    joined = Multiframes.of(errors.keyframes)
    theta, count = np.zeros(len(errors.names)), made.association.count
    base = made.map_T_base[joined.first] @ made.keyframes.base_T_camera[joined.first]
    which = made.association.object >= 0
    every, landmarks = np.flatnonzero(which), np.arange(count)

    def residuals(at):
        measured = Measurements.of(*errors.at(at), joined)
        graph = build_graph(measured.factors(made.association.object, every, landmarks, made.points))
        values = make_values(base, made.points, landmarks)
        return measured, graph, values

    measured, _, values = residuals(theta)
    of = Linearised(measured, made.association, base, made.points, which)
    system = linearise(of, errors, theta)
    rows = system.first_range
    for k, step in enumerate(0.01 * errors.steps):
        ahead, behind = (residuals(theta + s * step * np.eye(len(theta))[k])[1] for s in (1, -1))
        told = system.sides[:rows, k]
        found = np.concatenate(
            [(after(ahead, i, values) - after(behind, i, values)) / (2 * step) for i in range(len(every))]
        )
        assert_allclose(told, found, atol=0.03 * np.abs(found).max() + 1e-6, err_msg=errors.names[k])


def after(graph, i, values):
    """The whitened residual of a factor, with its robust weight."""
    return -graph.at(i).linearize(values).jacobian()[1]


def test_images_of_one_stamp_share_one_measurement_of_the_pose():
    made, _ = rig_drive(None, frames=60, localization=PoseNoise(xy=0.05, yaw=0.01), localization_rate=1.0)
    joined = Multiframes.of(made.keyframes)
    shared = joined.keyframes(made.keyframes)
    assert shared.localized_every * len(made.keyframes) == pytest.approx(made.keyframes.localized_every * len(shared))
    assert shared.localized_every > 2
    assert np.nanmax(made.object_errors(made.joint().positions)) < 0.3


def test_a_rig_has_one_pose_for_each_stamp_and_a_better_map():
    made, _ = rig_drive(None)
    estimate = made.joint()
    front = made.keyframes.camera == 0
    assert_allclose(len(estimate.map_T_base), len(made.keyframes))
    apart = np.diff(made.keyframes.stamps) == 0
    assert apart.any()
    assert_allclose(estimate.map_T_base[1:][apart], estimate.map_T_base[:-1][apart], atol=1e-9)
    few = made.rays.take(front[made.rays.keyframe])
    kept, keyframe = np.unique(few.keyframe, return_inverse=True)
    association = replace(made.association, object=made.association.object[front[made.rays.keyframe]])
    alone = solve_joint(made.keyframes.take(kept), replace(few, keyframe=keyframe), association, made.settings, Ledger())
    rig, one = (np.nanmedian(made.object_errors(found.positions)) for found in (estimate, alone))
    assert rig < one
    assert np.nanmax(made.object_errors(estimate.positions)) < 0.3


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_the_errors_of_each_camera_of_a_rig_are_found(seed):
    """The images of a stamp were taken one after the other, as a turning laser sees: each camera has a clock of its own."""
    true = {"left.clock": 1 / 15, "right.clock": 2 / 15, "left.yaw": 0.03, "right.tilt": -0.02}
    made, errors = rig_drive(true, seed, depth=DepthNoise(), together=False)
    assert len(Multiframes.of(made.keyframes).first) < 0.5 * len(made.keyframes)
    found = solve_joint(made.keyframes, made.rays, made.association, made.settings, Ledger(), errors=errors).calibration
    off = found.values - np.array([true.get(name, 0.0) for name in found.names])
    clock = np.array([name.endswith(".clock") for name in found.names])
    # The images of a stamp share one pose, so the odometry between them counts as exact, and clocks follow its noise.
    assert np.abs(off[clock]).max() < 0.1
    assert (np.abs(off) < 4 * found.sigma).all(), dict(zip(found.names, off / found.sigma, strict=True))
    at = {name: i for i, name in enumerate(found.names)}
    assert abs(off[at["left.yaw"]]) < 0.01
    assert abs(off[at["right.tilt"]]) < 0.01
    for one in ("left.clock", "right.clock"):  # from the front camera's, which bearings tell better than the odometry's
        apart = np.eye(len(off))[at[one]] - np.eye(len(off))[at["front.clock"]]
        sigma = np.sqrt(apart @ found.covariance @ apart)
        assert abs(apart @ off) < 4 * sigma
        assert sigma < 0.25 * np.sqrt(apart @ errors.prior @ apart)


def test_rays_across_a_rig_have_the_derivatives_by_its_clocks():
    """The derivatives by clocks with the velocities of the solved path, against differences with an exact odometry."""
    still = Odometry(**dict.fromkeys(("x_per_m", "y_per_m", "xy_per_rad", "yaw_per_m", "yaw_per_rad"), 0.0))
    made, errors = rig_drive(depth=DepthNoise(), odometry=still, frames=600, false=0.0)
    theta, every = np.zeros(len(errors.names)), np.ones(len(made.rays), dtype=bool)
    joined = Multiframes.of(made.keyframes)
    measured = Measurements.of(*errors.at(theta), joined)
    first = (made.map_T_base @ made.keyframes.base_T_camera)[joined.first]
    system = linearise(Linearised(measured, made.association, first, made.points, every), errors, theta)
    assert system.clocks is not None
    rays = slice(0, system.first_motion)
    clocks = list(system.clocks.moved)
    told, sides = system.by_path[rays], system.sides[rays][:, clocks]
    assert (sides != 0).any(axis=0).all()
    # The path has a velocity for two steps, and the differences one for 0.1 s. So they agree but for the acceleration.
    for mine, other in zip(told.T, sides.T, strict=True):
        assert mine @ other / np.linalg.norm(mine) / np.linalg.norm(other) > 0.98
        assert np.linalg.norm(mine) == pytest.approx(np.linalg.norm(other), rel=0.05)
    velocity, rng = np.random.default_rng(0).normal(size=(len(first), 6, 3)), np.random.default_rng(1)
    residual = rng.normal(size=len(system.residual))
    for k in clocks:
        columns = np.zeros((len(residual), 3))
        system.clocks.put(columns, k, velocity)
        np.testing.assert_allclose(system.clocks.products(residual, k, velocity), residual @ columns, rtol=1e-9)
