"""Square fiducials: the pose of a square against its truth, both poses of a flat one, and drives past them."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tag_drives import SQUARE, TagDrive, make_tag_drive, scale_of

from objslam.config import Settings, load_settings
from objslam.core.bodies.tag_pose import TagPose
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import exp_se3, make_pose
from objslam.core.result import RunResult
from objslam.graph.factors.tags import tag_ties
from objslam.graph.tags.placement import place
from objslam.graph.tags.shapes import CLOCKWISE, COUNTER_CLOCKWISE, goes_clockwise, squares_of
from objslam.graph.tags.square_fit import Corners, Squares, costs, fit, independent, poses_of_views, with_pose_noise
from objslam.graph.tags.square_rows import SquareRows
from objslam.graph.variables import L0, TAG0, TAG_SIZE0
from objslam.mapping import pipeline


def squares(count: int, seed: int = 0) -> Squares:
    rng = np.random.default_rng(seed)
    pose = make_pose(Rotation.random(count, random_state=seed).as_matrix(), rng.uniform(-5, 5, (count, 3)))
    return Squares(np.tile(COUNTER_CLOCKWISE, (count, 1, 1)), pose, rng.uniform(0.1, 0.4, count))


def views(of: Squares, each: int, cone: float, sigma: float = 0.0, seed: int = 0) -> Corners:
    """Views from 1 to 3 m, up to `cone` degrees off one direction of each square, itself up to 50 degrees off its normal."""
    rng, count = np.random.default_rng(seed), len(of.side)
    square = np.repeat(np.arange(count), each)
    tilt = np.radians(rng.uniform(20, 50, count)[square] + rng.uniform(-cone, cone, len(square)))
    turn = rng.uniform(0, 2 * np.pi, count)[square]
    local = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=1)
    away = np.einsum("vij,vj->vi", of.pose[square, :3, :3], local) * rng.uniform(1, 3, len(square))[:, None]
    origin = of.pose[square, :3, 3] + away
    to = of.corners[square] - origin[:, None]
    direction = to / np.linalg.norm(to, axis=2, keepdims=True) + sigma * rng.normal(size=to.shape)
    return Corners(
        square,
        origin,
        direction / np.linalg.norm(direction, axis=2, keepdims=True),
        np.full(len(square), 1e-3),
        independent(len(square)),
    )


def test_a_square_is_found_exactly_from_views_without_noise() -> None:
    truth = squares(30)
    for sides in (truth.side, np.full(30, np.nan)):  # Known, and from the parallax of the views.
        found = place(views(truth, 6, cone=20), truth.shape, sides)
        np.testing.assert_allclose(found.best.pose, truth.pose, atol=1e-8)
        np.testing.assert_allclose(found.best.side, truth.side, rtol=1e-8)
        assert (found.cost < 1e-9).all()


def test_one_view_gives_the_pose_of_a_square_of_known_size() -> None:
    truth = squares(30, seed=1)
    found = place(views(truth, 1, cone=0), truth.shape, truth.side)
    np.testing.assert_allclose(found.best.pose, truth.pose, atol=1e-6)
    unknown = place(views(truth, 1, cone=0), truth.shape, np.full(30, np.nan))
    assert np.isinf(unknown.cost).all()  # One view says nothing of the size.


def test_both_poses_of_one_view_agree_with_opencv() -> None:
    """IPPE (Collins and Bartoli 2014), refined, is the second implementation. It gives the better pose first."""
    cv2 = pytest.importorskip("cv2")
    truth = replace(squares(30, seed=2), side=np.full(30, 0.3))
    seen = views(truth, 1, cone=0, sigma=2e-3)
    both = 0
    for v in range(30):
        middle = seen.direction[v].mean(axis=0)
        ahead = Rotation.align_vectors([[0, 0, 1.0]], [middle])[0].as_matrix()
        direction = seen.direction[v] @ ahead.T
        one = Corners(np.zeros(1, dtype=np.int64), np.zeros((1, 3)), direction[None], np.full(1, 2e-3), independent(1))
        pair = poses_of_views(one, truth.shape[:1], 60)
        each = Corners(np.arange(2), np.zeros((2, 3)), np.tile(direction, (2, 1, 1)), np.full(2, 2e-3), independent(2))
        ours = pair.pose[np.argsort(costs(each, pair)), :3, :3]
        points, image = SQUARE[[3, 2, 1, 0]], (direction[:, :2] / direction[:, 2:])[[3, 2, 1, 0]]
        _, turns, shifts, _ = cv2.solvePnPGeneric(points, image, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
        better = [
            cv2.solvePnPRefineLM(points, image, np.eye(3), None, turn.copy(), shift.copy())[0].ravel()
            for turn, shift in zip(turns, shifts, strict=True)
        ]
        off = [Rotation.from_matrix(a.T @ Rotation.from_rotvec(w).as_matrix()) for a, w in zip(ours, better, strict=True)]
        assert off[0].magnitude() < np.radians(3)  # OpenCV weighs pixels of a plane, we weigh angles.
        both += off[1].magnitude() < np.radians(20)  # They are 40 to 90 degrees apart, and our robust loss moves the worse.
    assert both >= 27  # Where the second pose is no minimum of its own, a fit ends at the first one.


def test_a_far_square_from_the_front_has_two_poses_until_the_parallax_decides() -> None:
    truth = replace(squares(40, seed=3), side=np.full(40, 0.15))
    close, wide = views(truth, 4, cone=0.5, sigma=4e-3, seed=3), views(truth, 12, cone=20, sigma=4e-3, seed=3)
    close, wide = (replace(seen, sigma=np.full(len(seen), 4e-3)) for seen in (close, wide))
    for seen, open_ in ((close, True), (wide, False)):
        found = place(seen, truth.shape, truth.side)
        off = [
            Rotation.from_matrix(np.swapaxes(truth.pose[:, :3, :3], 1, 2) @ one.pose[:, :3, :3]).magnitude()
            for one in (found.best, found.other)
        ]
        two = found.other_cost - found.cost < 9.2  # odds above 1 : 100
        if open_:
            assert two.mean() > 0.5
            assert (np.minimum(off[0], np.where(two, off[1], np.inf)) < np.radians(30)).mean() > 0.9
        else:
            assert two.mean() < 0.1
            assert (off[0] < np.radians(20)).mean() > 0.95


def test_the_information_is_that_of_the_scatter() -> None:
    """The covariance of a fit against Monte Carlo, in all seven parameters."""
    truth = squares(1, seed=4)
    once = views(truth, 8, cone=20)
    many = 400
    rng = np.random.default_rng(0)
    noisy = np.tile(once.direction, (many, 1, 1)) + 1e-3 * rng.normal(size=(8 * many, 4, 3))
    noisy /= np.linalg.norm(noisy, axis=2, keepdims=True)
    seen = Corners(
        np.repeat(np.arange(many), 8), np.tile(once.origin, (many, 1)), noisy, np.full(8 * many, 1e-3), independent(8 * many)
    )
    start = Squares(*(np.repeat(part, many, axis=0) for part in (truth.shape, truth.pose, truth.side)))
    found, _, information = fit(seen, start, np.ones(many, dtype=bool), 15)
    inverse = np.linalg.inv(truth.pose[0]) @ found.pose
    error = np.column_stack(
        [Rotation.from_matrix(inverse[:, :3, :3]).as_rotvec(), inverse[:, :3, 3], np.log(found.side / truth.side)]
    )
    measured, told = np.cov(error.T), np.linalg.inv(information).mean(axis=0)
    ratio = np.linalg.eigvals(np.linalg.solve(told, measured)).real
    assert 0.6 < ratio.min() < ratio.max() < 1.2  # Cauchy's weights make the told covariance a quarter wider.


def test_the_noise_of_poses_is_shared_by_the_corners_of_a_view() -> None:
    """As above, but with cameras that are 2 cm and 5 mrad off: ten times the noise of the corners, in all four alike."""
    truth = squares(1, seed=4)
    once = views(truth, 10, cone=20)
    many, angle, place_ = 400, 5e-3, 0.02
    rng = np.random.default_rng(1)
    direction = np.tile(once.direction, (many, 1, 1))
    shift = place_ * rng.normal(size=(10 * many, 3))
    away = np.linalg.norm(np.tile(truth.corners, (10, 1, 1)) - once.origin[:, None], axis=2)
    seen_from = direction * np.tile(away, (many, 1))[..., None] - shift[:, None]  # The camera is not where it is told.
    turn = Rotation.from_rotvec(angle * rng.normal(size=(10 * many, 3))).as_matrix()
    noisy = np.einsum("vij,vcj->vci", turn, seen_from / np.linalg.norm(seen_from, axis=2, keepdims=True))
    noisy += 1e-3 * rng.normal(size=noisy.shape)
    noisy /= np.linalg.norm(noisy, axis=2, keepdims=True)
    number = 10 * many
    origin, square = np.tile(once.origin, (many, 1)), np.repeat(np.arange(many), 10)
    start = Squares(*(np.repeat(part, many, axis=0) for part in (truth.shape, truth.pose, truth.side)))
    seen = Corners(square, origin, noisy, np.full(number, 1e-3), independent(number))
    seen = with_pose_noise(seen, start, np.full(number, angle), np.full(number, place_))
    found, _, information = fit(seen, start, np.ones(many, dtype=bool), 15)
    inverse = np.linalg.inv(truth.pose[0]) @ found.pose
    error = np.column_stack(
        [Rotation.from_matrix(inverse[:, :3, :3]).as_rotvec(), inverse[:, :3, 3], np.log(found.side / truth.side)]
    )
    squared = np.einsum("hi,hij,hj->h", error, information, error)
    assert 0.92 < (squared < 14.07).mean() < 0.99  # chi-squared, 7 degrees of freedom, 95 %
    assert np.median(error[:, 6] ** 2 * information[:, 6, 6]) > 0.3


def test_corners_say_which_way_round_they_go() -> None:
    for shape, clockwise in ((CLOCKWISE, True), (COUNTER_CLOCKWISE, False)):
        ahead = shape @ np.diag([1.0, -1.0, -1.0]) + [0.1, 0.2, 2.0]  # The tag looks at the camera.
        assert goes_clockwise(ahead[None])[0] == clockwise
        pose = exp_se3(np.array([0.3, -0.5, 1.0, 1.0, 2.0, 3.0]))
        rotation, centre, side = squares_of((0.3 * shape @ pose[:3, :3].T + pose[:3, 3])[None], shape[None])
        np.testing.assert_allclose(rotation[0], pose[:3, :3], atol=1e-12)
        np.testing.assert_allclose([*centre[0], side[0]], [*pose[:3, 3], 0.3], atol=1e-12)


@pytest.mark.parametrize("known", [True, False])
def test_ties_hold_a_square_of_known_or_free_size_and_nothing_else(known: bool) -> None:
    truth, side = squares(1, seed=5), 0.2
    landmarks = np.arange(4)[None]
    sides = np.array([side if known else np.nan])
    made = tag_ties(np.array([3]), landmarks, truth.shape, sides, np.array([side]), 10.0)

    def cost(of: Squares) -> float:
        values = gtsam.Values()
        values.insert(TAG0 + 3, gtsam.Pose3(of.pose[0]))
        for j, corner in enumerate(of.corners[0]):
            values.insert(L0 + j, corner)
        if not known:
            values.insert(TAG_SIZE0 + 3, float((side - of.side[0]) / np.sqrt(2)))
        return sum(factor.error(values) for factor in made)

    same, larger = replace(truth, side=np.array([side])), replace(truth, side=np.array([1.1 * side]))
    assert cost(same) < 1e-9
    assert (cost(larger) < 1e-4) != known  # The weak prior of a free size is left.
    bent = same.corners[0].copy()
    bent[0] += 0.01 * truth.pose[0, :3, 2]  # One corner off the plane.
    values = gtsam.Values()
    values.insert(TAG0 + 3, gtsam.Pose3(truth.pose[0]))
    for j, corner in enumerate(bent):
        values.insert(L0 + j, corner)
    if not known:
        values.insert(TAG_SIZE0 + 3, 0.0)
    assert sum(factor.error(values) for factor in made) > 100


@pytest.mark.parametrize("known", [True, False])
def test_rows_of_squares_are_the_ties_without_the_pose(known: bool) -> None:
    """Against GTSAM's ties: the same cost after their pose and size are solved. And the derivatives, numerically."""
    truth, rng = squares(3, seed=8), np.random.default_rng(8)
    sides = truth.side if known else np.full(3, np.nan)
    rows = SquareRows(np.arange(3), np.arange(12).reshape(3, 4), truth.shape, sides)
    no_poses = np.zeros((0, 4, 4))
    assert np.abs(rows.rows(no_poses, truth.corners.reshape(-1, 3))[0]).max() < 1e-6
    bent = truth.corners.reshape(-1, 3) + 1e-4 * rng.normal(size=(12, 3))
    residual, derivative, told = rows.rows(no_poses, bent)
    assert told == pytest.approx((residual**2).sum() / 2)
    for t in range(3):
        made = tag_ties(np.array([t]), rows.corner[t : t + 1], truth.shape[:1], sides[t : t + 1], truth.side[t : t + 1], 1e3)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for factor in made:
            graph.push_back(factor)
        values.insert(TAG0 + t, gtsam.Pose3(truth.pose[t]))
        for j in rows.corner[t].tolist():
            values.insert(L0 + j, bent[j])
            graph.push_back(gtsam.PriorFactorPoint3(L0 + j, bent[j], gtsam.noiseModel.Isotropic.Sigma(3, 1e-9)))
        if not known:
            values.insert(TAG_SIZE0 + t, 0.0)
        cost = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        assert graph.error(cost) == pytest.approx((residual[t] ** 2).sum() / 2, rel=0.02)
        for c in range(12):
            step = np.zeros((12, 3))
            step.reshape(3, 12)[t, c] = 1e-7
            change = (rows.rows(no_poses, bent + step)[0] - rows.rows(no_poses, bent - step)[0])[t] / 2e-7
            np.testing.assert_allclose(change, derivative[t][:, c], atol=2e-2 * np.abs(derivative[t]).max())


def settings_for(drive: TagDrive, *overrides: str, known: bool = True) -> Settings:
    plain = (
        "mode=joint",
        "output.recording=false",
        "checks.use=false",
        "association.method=by_label",
        "tags.corner_sigma=0.5",
    )
    settings = load_settings(None, (*plain, *overrides))
    return settings.model_copy(update={"tags": settings.tags.model_copy(update={"sizes": drive.side if known else {}})})


def mapped(drive: TagDrive, settings: Settings) -> RunResult:
    return pipeline.run(drive.log, settings, Ledger())


def errors(drive: TagDrive, result: RunResult) -> tuple[np.ndarray, np.ndarray]:
    """Squared Mahalanobis distances of the positions and of the rotations from the truth."""
    place, turn = [], []
    for o in result.map.resolved():
        assert o.tag is not None
        true = drive.map_T_tag[o.label]
        off = o.position - true[:3, 3]
        turns = [o.tag.rotation] if o.tag.other is None else [o.tag.rotation, o.tag.other]
        vectors = [Rotation.from_matrix(r.T @ true[:3, :3]).as_rotvec() for r in turns]
        place.append(off @ np.linalg.solve(o.covariance, off))
        turn.append(min(v @ np.linalg.solve(o.tag.covariance, v) for v in vectors))
    return np.array(place), np.array(turn)


def test_sigmas_of_places_and_rotations_cover_the_truth() -> None:
    place, turn, count = [], [], 0
    for seed in range(6):
        drive = make_tag_drive(seed)
        result = mapped(drive, settings_for(drive, "calibration.use=false", "noise.rays=false", "noise.odometry=false"))
        found = errors(drive, result)
        place.extend(found[0])
        turn.extend(found[1])
        count += len(drive.map_T_tag)
    assert len(place) == count
    for squared in (np.array(place), np.array(turn)):  # 48 tags, in six drives: each drive's tags err together
        assert (squared < 7.815).mean() >= 0.85
        assert np.median(squared) > 0.4


def test_known_sizes_give_the_scale_and_centres_do_not() -> None:
    """The odometry takes 1.05 m for 1 m, which bearings to centres cannot tell."""
    drive = make_tag_drive(3, stretch=1.05, clockwise=True)
    true = np.array([drive.map_T_tag[label][:3, 3] for label in sorted(drive.map_T_tag)])
    scale = {}
    for name, overrides in (("corners", ()), ("centres", ("tags.use=false", "rays.box_sigma=0", "rays.pixel_sigma=0.5"))):
        result = mapped(drive, settings_for(drive, *overrides))
        found = {o.label: o.position for o in result.map.resolved()}
        assert len(found) == len(true)
        scale[name] = scale_of(np.array([found[label] for label in sorted(found)]), true)
    assert abs(scale["corners"] - 1) < 0.01
    assert abs(scale["centres"] - 1) > 0.025


@pytest.mark.parametrize("wrong", [1.03, 0.98])
def test_odometry_that_knows_its_scale_tells_the_error_of_given_sizes(wrong: float) -> None:
    noise = tuple(f"odometry.{name}=0.002" for name in ("x_per_m", "y_per_m", "yaw_per_m", "yaw_per_rad", "xy_per_rad"))
    settings = load_settings(None, noise)
    drive = make_tag_drive(2, pixel_sigma=0.5, settings=settings)
    given = replace(drive, side={label: wrong * side for label, side in drive.side.items()})
    overrides = (
        *noise,
        "noise.odometry=false",
        "calibration.scale=0.001",
        "calibration.turn_slip=0",
        "calibration.tag_scale=0.05",
    )
    result = mapped(drive, settings_for(given, *overrides))
    assert result.calibration is not None
    k = result.calibration.names.index("tag_scale")
    value, sigma = result.calibration.values[k], result.calibration.sigma[k]
    assert sigma < 0.007
    assert abs(value - (1 / wrong - 1)) < 3 * sigma
    for o in result.map.resolved():
        assert o.tag is not None
        assert abs(o.tag.size - drive.side[o.label]) < 3 * o.tag.size_sigma
        assert o.tag.size_sigma == pytest.approx(o.tag.size * sigma / (1 + value), rel=0.05)
    place, _ = errors(drive, result)
    assert (place < 7.815).all()


def test_given_sizes_are_only_as_exact_as_their_prior() -> None:
    """All sizes are 1 % too large, which nothing in the log can tell. The map is 1 % too large, and its sigmas say so."""
    drive = make_tag_drive(4, pixel_sigma=0.3, drift=0.1, reach=4)
    given = replace(drive, side={label: 1.01 * side for label, side in drive.side.items()})
    noise = ("odometry.x_per_m=0.004", "odometry.y_per_m=0.002", "odometry.yaw_per_m=0.003", "odometry.yaw_per_rad=0.002")
    sizes = {}
    for prior in (0.0, 0.01):
        result = mapped(drive, settings_for(given, f"calibration.tag_scale={prior}", "calibration.scale=0.2", *noise))
        spread = [float(np.sqrt(np.trace(o.covariance))) for o in result.map.resolved()]
        sizes[prior] = np.array(spread)
        away = np.array([np.linalg.norm(o.position) for o in result.map.resolved()])
    grown = np.sqrt(sizes[0.01] ** 2 - sizes[0.0] ** 2)
    assert np.median(grown / away) == pytest.approx(0.01, rel=0.4)


def test_an_unknown_size_is_estimated_in_the_scale_of_the_odometry() -> None:
    drive = make_tag_drive(1, drift=0.2, pixel_sigma=0.3)
    result = mapped(drive, settings_for(drive, "tags.corner_sigma=0.3", known=False))
    sizes = [(o.tag.size, o.tag.size_sigma, drive.side[o.label]) for o in result.map.resolved() if o.tag is not None]
    assert len(sizes) >= 6
    size, sigma, true = np.array(sizes).T
    assert np.median(np.abs(size / true - 1)) < 0.03
    assert (np.abs(size - true) < 3 * sigma).all()
    assert (sigma > 0).all()


def test_tags_of_unknown_size_keep_their_covariances_in_an_uncertain_map() -> None:
    """GTSAM calls the linear systems of both drives indeterminate, though their condition number is 20,000."""
    for seed in (2, 5):
        drive, ledger = make_tag_drive(seed), Ledger()
        plain = ("calibration.use=false", "noise.rays=false", "noise.odometry=false")
        result = pipeline.run(drive.log, settings_for(drive, *plain, known=False), ledger)
        assert not ledger.warnings
        assert len(result.map.resolved()) == len(drive.map_T_tag)
        place, turn = errors(drive, result)
        assert (place < 7.815).all()
        assert (turn < 7.815).sum() >= 6
        for o in result.map.resolved():
            assert o.tag is not None
            assert 0 < abs(o.tag.size - drive.side[o.label]) < 3 * o.tag.size_sigma


def test_odometry_that_jumps_gives_way_where_tags_are_seen() -> None:
    """One step of the odometry is 0.3 m off, as if visual odometry corrected itself. The tags see that nothing jumped."""
    for seed in (0, 1):
        drive = make_tag_drive(seed, tags=14)
        odometry, detections = drive.log.odometry, drive.log.cameras[0].detections
        assert odometry is not None
        assert detections is not None
        seen = np.bincount(detections.frame, minlength=len(odometry))
        k = 20 + int(np.argmax(np.minimum(seen[20:100], seen[21:101]))) + 1
        shift, poses = np.eye(4), odometry.poses.copy()
        shift[:3, 3] = [0.2, 0.2, 0.1]
        poses[k:] = poses[k] @ shift @ np.linalg.inv(poses[k]) @ poses[k:]
        jumped = replace(drive, log=replace(drive.log, odometry=replace(odometry, poses=poses)))
        plain = ("calibration.use=false", "noise.rays=false", "noise.odometry=false")
        result = mapped(jumped, settings_for(drive, *plain))
        true = drive.map_T_base[np.round(result.keyframes.stamps / 0.1).astype(int)]
        off = np.linalg.norm((result.map_T_base - true)[:, :3, 3], axis=1)
        assert off.max() < 0.13  # About 0.2 m if the jump has the weight of other steps.


def test_at_fixed_poses_a_tag_has_a_rotation_and_a_size() -> None:
    drive = make_tag_drive(4)
    odometry = drive.log.odometry
    assert odometry is not None
    rng = np.random.default_rng(4)
    off = np.zeros((len(odometry), 6))
    off[:, 2], off[:, 3:5] = 0.005 * rng.normal(size=len(off)), 0.02 * rng.normal(size=(len(off), 2))
    log = replace(drive.log, odometry=None, localization=replace(odometry, poses=drive.map_T_base @ exp_se3(off)))
    result = mapped(replace(drive, log=log), settings_for(drive, "mode=fixed", "calibration.use=false", known=False))
    _, turn = errors(drive, result)
    assert len(turn) == len(drive.map_T_tag)
    assert (turn < 7.815).mean() > 0.8
    sizes = [(o.tag.size, o.tag.size_sigma, drive.side[o.label]) for o in result.map.resolved() if o.tag is not None]
    size, sigma, true = np.array(sizes).T
    assert np.median(np.abs(size / true - 1)) < 0.05
    assert (np.abs(size - true) < 3 * sigma).all()


def test_a_recording_shows_objects_and_not_their_corners() -> None:
    drive = make_tag_drive(5, frames=60)
    result = mapped(drive, settings_for(drive, "output.recording=true", "calibration.use=false"))
    assert result.trace
    for done in result.trace:
        assert all(len(step.positions) == done.association.count for step in done.iterations)


def test_a_tag_turns_with_the_frame_of_its_map() -> None:
    turn = Rotation.from_euler("z", 0.7)
    own = Rotation.from_rotvec([0.3, 1.0, -0.2])
    tag = TagPose(own.as_quat(), 1e-4 * np.eye(3), 0.2, 0.0, own.inv().as_quat(), 0.1)
    turned = tag.turned(turn.as_matrix(), 0.05)
    np.testing.assert_allclose(turned.rotation, (turn * own).as_matrix(), atol=1e-12)
    assert turned.other is not None
    np.testing.assert_allclose(turned.other, (turn * own.inv()).as_matrix(), atol=1e-12)
    in_map = turned.rotation @ turned.covariance @ turned.rotation.T
    np.testing.assert_allclose(in_map, np.diag([1e-4, 1e-4, 1e-4 + 0.05**2]), atol=1e-12)
    assert turned.sigma_deg == pytest.approx(np.degrees(np.sqrt(1e-4 + 0.05**2)))


def test_a_tag_with_one_size_of_its_own() -> None:
    settings = load_settings(None, ("tags.size=0.16", "tags.sizes={3: 0.3, tag_4: null}"))
    assert [settings.tags.size_of(f"tag_{i}") for i in (2, 3, 4)] == [0.16, 0.3, None]
    assert settings.tags.size_of("door") == 0.16


def test_costs_count_corners_behind_the_camera() -> None:
    truth = squares(1, seed=6)
    seen = views(truth, 1, cone=0)
    behind = replace(seen, direction=-seen.direction)
    assert costs(seen, truth)[0] < 1e-9
    assert costs(behind, truth)[0] > 1e5
