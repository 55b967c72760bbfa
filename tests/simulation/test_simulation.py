from itertools import pairwise

import cv2
import numpy as np
import pytest
from scipy.stats import binom, chi2

from objslam.config import Odometry
from objslam.core.geometry import interpolate, inverse, split_se2, widest_angle
from objslam.errors import ConfigError
from objslam.simulation import PRESETS, DepthNoise, DriveSettings, PoseNoise, make_camera, pair, preset, simulate

EXACT = {"tracks": "perfect", "objects": 8, "frames": 120}
OF_CENTRES = DepthNoise(sigma=0.0, sigma_per_m=0.0, surface=0.0)
CAMERAS = {
    "pinhole": make_camera(pitch=0.1),
    "plumb_bob": make_camera(distortion=(-0.3, 0.1, 0.001, -0.002, 0.0), yaw=0.2),
    "rational": make_camera(
        distortion_model="rational_polynomial", distortion=(0.4, 0.05, 0.001, -0.0005, 0.002, 0.7, 0.1, 0.005)
    ),
    "equidistant": make_camera(distortion_model="equidistant", distortion=(-0.02, 0.004, -0.002, 0.0003), focal=300.0),
}


def detections(settings, seed=0):
    return simulate(settings, seed).cameras[0].detections


def centres(boxes):
    return (boxes[:, :2] + boxes[:, 2:]) / 2


def in_band(count, trials, share):
    """Whether a count of events is one that a binomial gives 999,998 times in a million."""
    low, high = binom.ppf([1e-6, 1 - 1e-6], trials, share)
    return low <= count <= high


def sigma_fits(errors, sigma):
    """Whether zero-mean Gaussian errors have this standard deviation, as all but one in a million samples do."""
    low, high = chi2.ppf([5e-7, 1 - 5e-7], len(errors))
    return low <= (errors**2).sum() / sigma**2 <= high and abs(errors.mean()) < 5 * sigma / np.sqrt(len(errors))


def matched(first, second):
    """Rows of two detections that are of one object in one frame, by their perfect track ids."""
    return np.intersect1d(*(d.frame * 1000 + d.track_ids for d in (first, second)), return_indices=True)[1:]


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_boxes_are_where_opencv_projects_the_objects(camera):
    settings = DriveSettings(**EXACT, cameras=(camera,))
    log = simulate(settings, 3)
    d = log.cameras[0].detections
    points = np.array([o.position for o in log.truth.objects])
    compared = 0
    for k in range(0, settings.frames, 7):
        camera_T_map = inverse(log.truth.trajectory.poses[k] @ camera.base_T_camera)
        local = points @ camera_T_map[:3, :3].T + camera_T_map[:3, 3]
        rvec, tvec = cv2.Rodrigues(camera_T_map[:3, :3])[0], camera_T_map[:3, 3]
        project = cv2.fisheye.projectPoints if camera.distortion_model == "equidistant" else cv2.projectPoints
        pixels = project(points[:, None], rvec, tvec, camera.matrix, camera.distortion)[0].reshape(-1, 2)
        rows = np.nonzero(d.frame == k)[0]
        np.testing.assert_allclose(centres(d.boxes[rows]), pixels[d.track_ids[rows]], atol=1e-6)
        compared += len(rows)
        # what has no box is behind the camera, too far, or hangs over the edge of the image
        unseen = np.setdiff1d(np.arange(len(points)), d.track_ids[rows])
        margin = 0.5 * camera.matrix[0, 0] * 0.4 / np.maximum(local[unseen, 2], 0.01)
        inside = (pixels[unseen] - margin[:, None] > 0) & (pixels[unseen] + margin[:, None] < [639, 479])
        near = np.linalg.norm(local[unseen], axis=1) < settings.max_range
        in_front = local[unseen, 2] > np.linalg.norm(local[unseen], axis=1) * np.cos(np.deg2rad(40))
        assert not (inside.all(axis=1) & near & in_front).any()
    assert compared > 20
    assert (d.boxes >= 0).all()
    assert (d.boxes <= [639, 479, 639, 479]).all()


def test_the_boxes_of_a_fisheye_do_not_grow_towards_the_edge():
    camera = make_camera(distortion_model="equidistant", distortion=(0.0, 0.0, 0.0, 0.0), focal=200.0)
    log = simulate(DriveSettings(**EXACT | {"frames": 300}, cameras=(camera,), cut_off=True), 0)
    d, points = log.cameras[0].detections, np.array([o.position for o in log.truth.objects])
    camera_T_map = inverse(log.truth.trajectory.poses[d.frame] @ camera.base_T_camera)
    local = np.einsum("rij,rj->ri", camera_T_map[:, :3, :3], points[d.track_ids]) + camera_T_map[:, :3, 3]
    distance = np.linalg.norm(local, axis=1)
    whole = ((d.boxes > 0) & (d.boxes < [639, 479, 639, 479])).all(axis=1)
    extent = (d.boxes[:, 2:] - d.boxes[:, :2]) * distance[:, None] / 200
    for track in np.unique(d.track_ids[whole]):
        own = extent[whole & (d.track_ids == track)]
        np.testing.assert_allclose(own, np.broadcast_to(own[0], own.shape), rtol=1e-9)
    assert np.degrees(np.arccos(local[whole, 2] / distance[whole])).max() > 75


def test_a_distortion_that_folds_back_shows_nothing_from_outside_the_field_of_view():
    camera = make_camera(focal=700.0, distortion=(-0.35, 0.0, 0.0, 0.0, 0.0))  # turns round at 44 degrees, back at 0 at 59
    log = simulate(DriveSettings(**EXACT | {"frames": 600}, cameras=(camera,), min_view_share=0.05), 0)
    d = log.cameras[0].detections
    camera_T_map = inverse(log.truth.trajectory.poses[d.frame] @ camera.base_T_camera)
    points = np.array([o.position for o in log.truth.objects])[d.track_ids]
    local = np.einsum("rij,rj->ri", camera_T_map[:, :3, :3], points) + camera_T_map[:, :3, 3]
    assert len(d) > 100
    assert np.rad2deg(np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])).max() < 40


def test_rays_of_exact_boxes_pass_through_the_objects():
    settings = DriveSettings(**EXACT, cameras=(CAMERAS["pinhole"], make_camera("back", yaw=2.9, pitch=-0.05)))
    log = simulate(settings, 1)
    truth = np.array([o.position for o in log.truth.objects])
    for entry in log.cameras:
        d, camera = entry.detections, entry.camera
        poses, valid = interpolate(log.truth.trajectory.stamps, log.truth.trajectory.poses, d.stamps, 1.0)
        poses = poses @ camera.base_T_camera
        homogeneous = np.column_stack([centres(d.boxes), np.ones(len(d))])
        rays = np.einsum("rij,rj->ri", poses[:, :3, :3], homogeneous @ np.linalg.inv(camera.matrix).T)
        offset = np.cross(truth[d.track_ids] - poses[:, :3, 3], rays / np.linalg.norm(rays, axis=1, keepdims=True))
        assert valid.all()
        assert len(d) > 100
        assert np.linalg.norm(offset, axis=1).max() < 1e-9
        ahead = np.einsum("ri,ri->r", truth[d.track_ids] - poses[:, :3, 3], rays)
        assert (ahead > 0).all()


def test_camera_points_where_it_is_told():
    R = make_camera(yaw=np.pi / 2, pitch=0.1).base_T_camera[:3, :3]
    np.testing.assert_allclose(R[:, 2], [0, np.cos(0.1), np.sin(0.1)], atol=1e-12)  # forward: to the left, a little up
    np.testing.assert_allclose(R[:, 0], [1, 0, 0], atol=1e-12)  # the image's right is ahead of the robot
    np.testing.assert_allclose(np.linalg.det(R), 1.0)


def test_box_sizes_follow_extent_and_depth():
    settings = DriveSettings(objects=0, placed=(("cup", (3.5, 0.0, 0.3)),), path=(1, 2), frames=100, depth=OF_CENTRES)
    d = detections(settings)
    sizes = d.boxes[:, 2:] - d.boxes[:, :2]
    assert len(d) > 10
    np.testing.assert_allclose(sizes * d.depths[:, None], np.broadcast_to([460 * 0.09, 460 * 0.11], sizes.shape), rtol=1e-9)


def test_pixel_noise_has_its_sigma_on_both_axes():
    exact, noisy = (detections(DriveSettings(**EXACT | {"frames": 2000}, pixel_sigma=s)) for s in (0.0, 3.0))
    a, b = matched(exact, noisy)
    errors = centres(noisy.boxes[b]) - centres(exact.boxes[a])
    assert len(a) > 1500
    assert sigma_fits(errors[:, 0], 3.0)
    assert sigma_fits(errors[:, 1], 3.0)
    assert abs(np.corrcoef(errors.T)[0, 1]) < 5 / np.sqrt(len(a))
    np.testing.assert_allclose(noisy.boxes[b, 2:] - noisy.boxes[b, :2], exact.boxes[a, 2:] - exact.boxes[a, :2], atol=1e-9)


def test_misses_and_false_boxes_come_at_their_rates():
    base = {"objects": 15, "classes": 3, "frames": 400, "tracks": "perfect"}
    full = detections(DriveSettings(**base))
    d = detections(DriveSettings(**base, missed=0.2, false=0.3))
    real = d.take(d.track_ids >= 0)
    assert in_band(len(full) - len(real), len(full), 0.2)
    a, b = matched(full, real)
    assert len(b) == len(real)
    np.testing.assert_array_equal(full.boxes[a], real.boxes[b])
    for label in range(3):
        frames = d.frame[(d.track_ids < 0) & (d.label == label)]
        assert len(np.unique(frames)) == len(frames)
        assert in_band(len(frames), 400, 0.3)
    nothing = d.boxes[d.track_ids < 0]
    assert (nothing >= 0).all()
    assert (nothing <= [639, 479, 639, 479]).all()
    spread = centres(nothing).std(axis=0)
    assert (spread > [120, 90]).all()


def test_boxes_of_a_frame_come_surest_first_not_in_the_order_of_the_truth():
    d = detections(DriveSettings(**EXACT, false=0.5))
    same = d.frame[1:] == d.frame[:-1]
    assert (np.diff(d.scores)[same] <= 0).all()
    assert (np.diff(d.track_ids)[same] > 0).any()
    assert (np.diff(d.track_ids)[same] < 0).any()


def test_one_seed_one_log():
    settings = preset(
        "hard", frames=80, min_view_share=0.02, min_parallax_deg=10, tracks="broken", depth=DepthNoise(wrong=0.1)
    )
    first, second, other = simulate(settings, 5), simulate(settings, 5), simulate(settings, 6)
    a, b = first.cameras[0].detections, second.cameras[0].detections
    for name in ("frame_stamps", "frame", "boxes", "label", "scores", "depths", "track_ids"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_array_equal(first.odometry.poses, second.odometry.poses)
    np.testing.assert_array_equal(first.localization.poses, second.localization.poses)
    assert not np.allclose(first.truth.objects[0].position, other.truth.objects[0].position)
    assert not np.allclose(first.odometry.poses[0], other.odometry.poses[0])


CHANGES = {
    "pixel_sigma": 3.0,
    "missed": 0.3,
    "false": 0.5,
    "moving": 2,
    "depth": DepthNoise(missing=0.3, wrong=0.3),
    "odometry": Odometry(),
    "localization": PoseNoise(xy=0.1, yaw=0.1),
}


@pytest.mark.parametrize("change", CHANGES)
def test_one_error_leaves_the_others_as_they_were(change):
    before, after = simulate(DriveSettings(**EXACT), 4), simulate(DriveSettings(**EXACT | {change: CHANGES[change]}), 4)
    for a, b in zip(before.truth.objects, after.truth.objects, strict=True):
        assert a.label == b.label
        np.testing.assert_array_equal(a.position, b.position)
    np.testing.assert_array_equal(before.truth.trajectory.poses, after.truth.trajectory.poses)
    assert np.array_equal(before.odometry.poses, after.odometry.poses) == (change != "odometry")
    assert np.array_equal(before.localization.poses, after.localization.poses) == (change != "localization")
    d, e = before.cameras[0].detections, after.cameras[0].detections
    e = e.take((e.track_ids >= 0) & (e.track_ids < len(before.truth.objects)))
    i, j = matched(d, e)
    np.testing.assert_array_equal(d.scores[i], e.scores[j])
    np.testing.assert_array_equal(d.label[i], e.label[j])
    assert np.array_equal(d.boxes[i], e.boxes[j]) == (change != "pixel_sigma")
    assert (len(i) == len(d)) == (change not in ("missed", "pixel_sigma"))
    assert np.isnan(e.depths[j]).all() == (change != "depth")


def test_exact_odometry_and_localization_are_the_truth():
    log = simulate(DriveSettings(**EXACT, odometry_rate=None, localization_rate=None), 2)
    np.testing.assert_array_equal(log.localization.stamps, log.truth.trajectory.stamps)
    np.testing.assert_allclose(log.localization.poses, log.truth.trajectory.poses, atol=1e-12)
    np.testing.assert_allclose(log.odometry.poses, log.truth.trajectory.poses, atol=1e-10)


def test_odometry_and_localization_have_rates_of_their_own_and_cover_the_frames():
    log = simulate(DriveSettings(**EXACT, odometry_rate=50.0, localization_rate=12.0), 2)
    truth = log.truth.trajectory
    for path, rate in ((log.odometry, 50.0), (log.localization, 12.0)):
        np.testing.assert_allclose(np.diff(path.stamps), 1 / rate, atol=1e-6)
        poses, valid = interpolate(path.stamps, path.poses, truth.stamps, 0.5)
        assert valid.all()
        np.testing.assert_allclose(poses, truth.poses, atol=2e-3)  # an arc between samples is not quite the curve


def step_errors(log):
    """Errors (S, 3) of the odometry's steps between frames, in the frame of the step's start."""
    true = log.truth.trajectory
    poses, _ = interpolate(log.odometry.stamps, log.odometry.poses, true.stamps, 0.5)
    steps = [split_se2(inverse(p[:-1]) @ p[1:])[0] for p in (poses, true.poses)]
    return steps[0] - steps[1], steps[1]


@pytest.mark.parametrize("rate", [None, 25.0])
def test_odometry_errs_by_so_much_per_frame(rate):
    noise = PoseNoise(xy=0.01, yaw=np.deg2rad(0.3))
    log = simulate(DriveSettings(**EXACT | {"frames": 600}, odometry=noise, odometry_rate=rate, localization=None), 7)
    errors, _ = step_errors(log)
    for axis, sigma in enumerate((0.01, 0.01, np.deg2rad(0.3))):
        assert sigma_fits(errors[:, axis], sigma)
    np.testing.assert_allclose(log.odometry.poses[0], log.truth.trajectory.poses[0], atol=1e-12)
    assert np.linalg.norm(log.odometry.poses[-1, :2, 3] - log.truth.trajectory.poses[-1, :2, 3]) > 0.05
    np.testing.assert_array_equal(log.odometry.poses[:, 2, 3], 0.0)


def test_odometry_drifts_as_a_random_walk_with_the_way():
    noise = Odometry(x_per_m=0.05, y_per_m=0.01, xy_per_rad=0.02, yaw_per_m=0.02, yaw_per_rad=0.05)
    errors, true = step_errors(simulate(DriveSettings(**EXACT | {"frames": 600}, odometry=noise, odometry_rate=None), 7))
    way, turn = np.hypot(true[:, 0], true[:, 1]), np.abs(true[:, 2])
    for axis, (per_m, per_rad) in enumerate(((0.05, 0.02), (0.01, 0.02), (0.02, 0.05))):
        assert sigma_fits(errors[:, axis] / np.sqrt(per_m**2 * way + per_rad**2 * turn), 1.0)


def test_localization_errs_independently_at_each_pose():
    log = simulate(
        DriveSettings(**EXACT | {"frames": 600}, localization=PoseNoise(xy=0.03, yaw=0.01), localization_rate=None), 7
    )
    got, true = split_se2(log.localization.poses)[0], split_se2(log.truth.trajectory.poses)[0]
    errors = got - true
    errors[:, 2] = (errors[:, 2] + np.pi) % (2 * np.pi) - np.pi
    for axis, sigma in enumerate((0.03, 0.03, 0.01)):
        assert sigma_fits(errors[:, axis], sigma)
        assert abs(np.corrcoef(errors[1:, axis], errors[:-1, axis])[0, 1]) < 5 / np.sqrt(600)


@pytest.mark.parametrize("swings", [(1, 1), (1, 2), (2, 3), (3, 1), (4, 5)])
def test_the_path_is_one_that_wheels_can_drive(swings):
    settings = DriveSettings(path=swings, laps=1.0, frames=2001, frame_rate=50.0, objects=0)
    log = simulate(settings, 0)
    steps = split_se2(inverse(log.truth.trajectory.poses[:-1]) @ log.truth.trajectory.poses[1:])[0]
    way = np.hypot(steps[:, 0], steps[:, 1])
    assert np.abs(steps[:, 1]).max() < 0.1 * way.max()  # no sideways motion
    assert (steps[:, 0] > 0).all()
    outer_wheel = np.hypot(way, 0.5 * steps[:, 2])  # keeps its speed, whatever the bend
    assert np.ptp(outer_wheel) < 0.02 * outer_wheel.mean()
    places = log.truth.trajectory.poses[:, :3, 3]
    assert (np.abs(places[:, :2]).max(axis=0) <= [3.0, 2.0]).all()
    np.testing.assert_allclose(places[0], places[-1], atol=2 * way.max())  # one lap closes


def test_speed_is_kept_on_average():
    log = simulate(DriveSettings(speed=0.5, frames=2000, objects=0, path=(1, 2)), 0)  # several laps
    places = log.truth.trajectory.poses[:, :3, 3]
    way = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    assert way / (log.truth.trajectory.stamps[-1] - log.truth.trajectory.stamps[0]) == pytest.approx(0.5, rel=0.02)


def test_several_cameras_take_turns():
    cameras = (make_camera("front"), make_camera("left", yaw=1.5), make_camera("right", yaw=-1.5))
    log = simulate(DriveSettings(**EXACT, cameras=cameras), 0)
    assert [c.camera.name for c in log.cameras] == ["front", "left", "right"]
    stamps = np.stack([c.detections.frame_stamps for c in log.cameras])
    np.testing.assert_allclose(np.diff(stamps.T.ravel()), 1 / 15, atol=1e-6)
    np.testing.assert_array_equal(log.truth.trajectory.stamps, np.sort(stamps.ravel()))
    assert all(len(c.detections) > 10 for c in log.cameras)


def test_depth_ends_on_the_surface():
    """The surface is nearer than the centre by a share of half the width of the object, along the ray."""
    frames = DriveSettings(**EXACT | {"frames": 400}, depth=OF_CENTRES)
    balls = frames.model_copy(update={"depth": OF_CENTRES.model_copy(update={"surface": 1.0})})
    log, nearer = simulate(frames, 0), detections(balls)
    d = log.cameras[0].detections
    map_T_camera = log.truth.trajectory.poses[d.frame] @ log.cameras[0].camera.base_T_camera
    points = np.array([o.position for o in log.truth.objects])[d.track_ids]
    distance = np.linalg.norm(points - map_T_camera[:, :3, 3], axis=1)
    width = (d.boxes[:, 2] - d.boxes[:, 0]) * d.depths / log.cameras[0].camera.matrix[0, 0]
    np.testing.assert_allclose(distance * (1 - nearer.depths / d.depths), width / 2, rtol=1e-6)


def test_depth_is_z_with_its_errors():
    log = simulate(DriveSettings(**EXACT | {"frames": 400}, depth=OF_CENTRES), 0)
    d = log.cameras[0].detections
    map_T_camera = log.truth.trajectory.poses[d.frame] @ log.cameras[0].camera.base_T_camera
    points = np.array([o.position for o in log.truth.objects])[d.track_ids]
    z = np.einsum("ri,ri->r", points - map_T_camera[:, :3, 3], map_T_camera[:, :3, 2])
    np.testing.assert_allclose(d.depths, z, atol=1e-9)

    noisy = DepthNoise(sigma=0.03, sigma_per_m=0.02, missing=0.2, surface=0.0)
    noisy = detections(DriveSettings(**EXACT | {"frames": 400}, depth=noisy))
    missing = np.isnan(noisy.depths)
    assert in_band(missing.sum(), len(noisy), 0.2)
    assert sigma_fits(((noisy.depths - z) / np.hypot(0.03, 0.02 * z))[~missing], 1.0)

    wrong = DepthNoise(sigma=0.0, sigma_per_m=0.0, wrong=0.1, surface=0.0)
    wrong = detections(DriveSettings(**EXACT | {"frames": 400}, depth=wrong))
    assert in_band((np.abs(wrong.depths - z) > 1e-6).sum(), len(wrong), 0.1)


def test_broken_tracks_start_anew_after_a_second():
    base = {**EXACT, "frames": 600, "missed": 0.6, "false": 0.3}
    truth, broken = detections(DriveSettings(**base)), detections(DriveSettings(**base | {"tracks": "broken"}))
    np.testing.assert_array_equal(truth.boxes, broken.boxes)
    np.testing.assert_array_equal(broken.track_ids < 0, truth.track_ids < 0)
    names = {}
    for k in range(8):
        rows = np.nonzero(truth.track_ids == k)[0]
        for a, b in pairwise(rows):
            gone = truth.frame[b] - truth.frame[a] > 5
            assert (broken.track_ids[a] == broken.track_ids[b]) == (not gone)
        names[k] = set(broken.track_ids[rows])
    assert sum(len(n) for n in names.values()) == len(set().union(*names.values()))
    assert max(len(n) for n in names.values()) > 1
    assert (detections(DriveSettings(**base | {"tracks": "none"})).track_ids == -1).all()


def test_moving_objects_are_seen_but_no_part_of_the_truth():
    log = simulate(DriveSettings(**EXACT | {"frames": 400}, moving=3, depth=OF_CENTRES), 0)
    d, camera = log.cameras[0].detections, log.cameras[0].camera
    assert len(log.truth.objects) == 8
    for k in (8, 9, 10):
        mine = d.take(d.track_ids == k)
        assert len(mine) > 10
        assert len(set(mine.label)) == 1
        local = (
            np.column_stack([centres(mine.boxes), np.ones(len(mine))])
            @ np.linalg.inv(camera.matrix).T
            * mine.depths[:, None]
        )
        poses = log.truth.trajectory.poses[mine.frame] @ camera.base_T_camera
        places = np.einsum("rij,rj->ri", poses[:, :3, :3], local) + poses[:, :3, 3]
        assert (np.ptp(places, axis=0)[:2] > 0.3).any()
        assert np.ptp(places[:, 2]) < 1e-9
        speed = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(mine.stamps)
        assert 0.05 < np.median(speed) < 0.8


def test_cut_off_boxes_end_at_the_edge():
    whole, cut = detections(DriveSettings(**EXACT)), detections(DriveSettings(**EXACT, cut_off=True, min_view_share=0.1))
    at_edge = (cut.boxes[:, :2] == 0).any(axis=1) | (cut.boxes[:, 2:] == [639, 479]).any(axis=1)
    assert at_edge.any()
    assert not ((whole.boxes[:, :2] == 0).any(axis=1) | (whole.boxes[:, 2:] == [639, 479]).any(axis=1)).any()
    assert (cut.boxes >= 0).all()
    assert (cut.boxes <= [639, 479, 639, 479]).all()


def test_objects_stand_apart_in_classes_taken_in_turn():
    log = simulate(DriveSettings(objects=20, classes=3, min_distance=0.8, heights=(0.2, 0.9), min_view_share=0.05), 0)
    places = np.array([o.position for o in log.truth.objects])
    apart = np.linalg.norm(places[:, None] - places, axis=-1) + 10 * np.eye(20)
    assert apart.min() >= 0.8
    assert places[:, 2].min() >= 0.2
    assert places[:, 2].max() <= 0.9
    assert sorted(log.cameras[0].detections.label_names) == ["bottle", "cup", "plant"]
    assert [o.label for o in log.truth.objects].count("cup") == 7
    alone = simulate(DriveSettings(objects=14, min_view_share=0.05), 0)
    assert len({o.label for o in alone.truth.objects}) == 14


@pytest.mark.parametrize("seed", range(5))
def test_the_demo_shows_every_object_often_and_from_different_sides(seed):
    log = simulate(preset("demo", tracks="perfect"), seed)
    d = log.cameras[0].detections
    origins = (log.truth.trajectory.poses @ log.cameras[0].camera.base_T_camera)[:, :3, 3]
    for item in log.truth.objects:
        views = item.position - origins[d.frame[d.track_ids == item.id]]
        assert len(views) >= 30
        assert np.rad2deg(widest_angle(views / np.linalg.norm(views, axis=1, keepdims=True))) >= 30


SIZES = {
    "demo": (12, 400, None),
    "rooms": (15, 300, 3),
    "hard": (24, 300, 3),
    "drift": (15, 300, 3),
    "long": (46, 3000, 8),
    "large": (200, 10_000, 10),
}


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_what_they_promise(name):
    log = simulate(preset(name), 0)
    objects, frames, classes = SIZES[name]
    d = log.cameras[0].detections
    assert log.name == name
    assert len(log.truth.objects) == objects
    assert len(d.frame_stamps) == frames
    assert classes is None or len(d.label_names) == classes
    assert (log.localization is None) == (name == "drift")
    if name in ("long", "large"):
        assert 4.5 < len(d) / frames < 6
    if name == "long":
        assert d.frame_stamps[-1] - d.frame_stamps[0] == pytest.approx(900, rel=0.01)


def test_a_pair_is_seen_from_one_to_four_metres():
    log = simulate(pair(0.2, tracks="perfect"), 0)
    a, b = (o.position for o in log.truth.objects)
    assert np.linalg.norm(a - b) == pytest.approx(0.2)
    d = log.cameras[0].detections
    origins = (log.truth.trajectory.poses @ log.cameras[0].camera.base_T_camera)[d.frame, :3, 3]
    away = np.linalg.norm((a + b) / 2 - origins, axis=1)
    assert away.min() == pytest.approx(1.0, abs=0.05)
    assert away.max() == pytest.approx(4.0, abs=0.05)
    assert np.bincount(d.track_ids).min() > 280


def test_settings_that_make_no_drive_are_refused():
    for wrong, message in (
        ({"odometry": None, "localization": None}, "odometry or localization"),
        ({"path": (2, 4)}, "common divisor"),
        ({"margin": 3.0}, "no room"),
        ({"cameras": (make_camera("a"), make_camera("a"))}, "name of its own"),
        ({"moving": 1, "objects": 0}, "moving objects"),
        ({"missed": 1.5}, "less than or equal to 1"),
    ):
        with pytest.raises(ValueError, match=message):
            DriveSettings(**wrong)
    with pytest.raises(ConfigError, match="no simulated drive 'nowhere'"):
        preset("nowhere")
    with pytest.raises(ConfigError, match=r"only \d+ of 200 objects"):
        simulate(DriveSettings(objects=200, frames=50), 0)
