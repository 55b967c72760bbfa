"""Rays against the projection of known points through each lens model."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from objslam.config import Settings
from objslam.core.camera import Camera, undistort
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import angles_off
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes

MATRIX = np.array([[520.0, 0, 322], [0, 515, 238], [0, 0, 1]])
LENSES = {
    "plumb_bob": [-0.28, 0.09, 0.001, -0.0005, 0.0],
    "rational_polynomial": [0.4, -0.1, 0.0006, 0.0003, -0.004, 0.75, -0.08, -0.02],
    "equidistant": [-0.01, 0.02, -0.015, 0.004],
}


def lens(model, distortion=None, matrix=MATRIX):
    return Camera("front", 640, 480, matrix, model, np.array(LENSES[model] if distortion is None else distortion))


def project(camera, directions):
    """Raw pixels (N, 2) of directions (N, 3) in the camera frame, by OpenCV's projection."""
    zero = np.zeros(3)
    points = np.ascontiguousarray(directions, dtype=np.float64)
    if camera.distortion_model == "equidistant":
        return cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.matrix, camera.distortion)[0][:, 0]
    return cv2.projectPoints(points, zero, zero, camera.matrix, camera.distortion)[0][:, 0]


@pytest.mark.parametrize("model", LENSES)
@examples(max_examples=50)
@given(data=st.data())
def test_a_projected_direction_comes_back(model, data):
    widest = np.radians(80 if model == "equidistant" else 33)
    off = data.draw(st.lists(st.tuples(st.floats(0, widest), st.floats(0, 2 * np.pi)), min_size=1, max_size=20))
    scale = data.draw(st.floats(0.3, 1.2))
    camera = lens(model, scale * np.array(LENSES[model]))
    angle, around = np.array(off).T
    directions = np.column_stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])
    found, valid = undistort(camera, project(camera, directions))
    assert valid.all()
    np.testing.assert_allclose(found, directions, atol=1e-6)


@pytest.mark.parametrize(("model", "count"), [("plumb_bob", 4), ("rational_polynomial", 12), ("rational_polynomial", 14)])
def test_other_numbers_of_coefficients(model, count):
    rng = np.random.default_rng(count)
    camera = lens(model, rng.normal(scale=0.01, size=count))
    directions = np.column_stack([rng.uniform(-0.5, 0.5, (50, 2)), np.ones(50)])
    found, valid = undistort(camera, project(camera, directions))
    assert valid.all()
    np.testing.assert_allclose(found, directions / np.linalg.norm(directions, axis=1, keepdims=True), atol=1e-7)


def test_without_distortion_it_is_the_inverse_of_the_matrix():
    pixels = np.array([[322.0, 238], [0, 0], [640, 480]])
    found, valid = undistort(lens("plumb_bob", np.zeros(5)), pixels)
    assert valid.all()
    expected = np.linalg.solve(MATRIX, np.column_stack([pixels, np.ones(3)]).T).T
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-12)
    assert undistort(lens("plumb_bob"), np.zeros((0, 2)))[0].shape == (0, 3)


def test_a_pixel_that_no_direction_reaches_has_no_ray():
    # a barrel with k1 < 0 alone folds back: r (1 + k1 r^2) has its greatest value at r = sqrt(-1 / (3 k1))
    k1 = -0.4
    camera = lens("plumb_bob", [k1, 0, 0, 0, 0])
    edge = np.sqrt(-1 / (3 * k1))
    limit = edge * (1 + k1 * edge**2)
    radius = np.array([0.5, 0.9, 0.99, 1.01, 1.1, 1.5]) * limit
    pixels = MATRIX[:2, 2] + radius[:, None] * [MATRIX[0, 0], 0]
    directions, valid = undistort(camera, pixels)
    assert valid.tolist() == [True, True, True, False, False, False]
    assert np.isfinite(directions).all()
    np.testing.assert_allclose(project(camera, directions[valid]), pixels[valid], atol=0.1)


def boxes_of(centres, size=(40.0, 30.0)):
    centres = np.asarray(centres, dtype=float)
    half = np.array(size) / 2
    return np.hstack([centres - half, centres + half])


def log_of(*cameras, stamps=(1.0, 2.0, 3.0)):
    path = Trajectory(np.arange(6.0), np.tile(np.eye(4), (6, 1, 1)))
    return Log("log", cameras, localization=path)


def seen(camera, boxes, *, stamps=(1.0, 2.0, 3.0), frame=None, labels=None, names=("cup",), scores=None, depths=None):
    m = len(boxes)
    return CameraLog(
        camera,
        Detections(
            frame_stamps=np.array(stamps),
            frame=np.zeros(m, dtype=np.int64) if frame is None else np.asarray(frame),
            boxes=np.asarray(boxes, dtype=float),
            label=np.zeros(m, dtype=np.int64) if labels is None else np.asarray(labels),
            scores=np.ones(m) if scores is None else np.asarray(scores, dtype=float),
            depths=np.full(m, np.nan) if depths is None else np.asarray(depths, dtype=float),
            track_ids=np.arange(m),
            label_names=names,
        ),
    )


def rays_of(log, **changes):
    settings, ledger = Settings.model_validate(changes), Ledger()
    return build_rays(log, build_keyframes(log, settings, Ledger()), settings, ledger), ledger


CENTRES = np.array([[322.0, 238], [100, 100], [500, 400]])


def test_a_ray_points_where_the_box_centre_is():
    camera = lens("plumb_bob")
    rays, ledger = rays_of(log_of(seen(camera, boxes_of(CENTRES), frame=[0, 2, 2])))
    assert rays.keyframe.tolist() == [0, 2, 2]
    np.testing.assert_allclose(project(camera, rays.direction), CENTRES, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(rays.direction, axis=1), 1)
    np.testing.assert_array_equal(rays.box, boxes_of(CENTRES))
    assert rays.track_id.tolist() == [0, 1, 2]
    assert np.isnan(rays.range).all()
    assert not ledger.lines()


def test_every_unusable_box_is_counted_once():
    camera = lens("plumb_bob", [-0.4, 0, 0, 0, 0], np.array([[260.0, 0, 320], [0, 260, 240], [0, 0, 1]]))
    boxes = np.array(
        [
            [300.0, 200, 340, 240],  # fine
            [300, 200, 340, 240],  # a low score
            [0.5, 200, 60, 240],  # cut off at the left edge
            [300, 200, 340, 478.5],  # and below
            [600, 200, 700, 240],  # its centre outside the image
            [-300, 500, -200, 600],  # all outside, with a low score too: counted for that
            [560, 420, 620, 470],  # where this lens folds back
        ]
    )
    scores = [0.9, 0.1, 0.9, 0.9, 0.9, 0.1, 0.9]
    rays, ledger = rays_of(log_of(seen(camera, boxes, scores=scores)), rays={"min_score": 0.5})
    assert len(rays) == 1
    np.testing.assert_array_equal(rays.cut.box, boxes[2:4])
    assert rays.cut.frame.tolist() == [0, 0]
    assert ledger.dropped == {
        "boxes below rays.min_score 0.5": 2,
        "boxes with their centre outside the image": 1,
        "boxes cut off by the image's edge (rays.border, rays.border_share)": 2,
        "boxes where the lens model has no inverse": 1,
    }
    assert all("camera front" in line for line in ledger.lines())
    assert ledger.lines()[2].startswith("dropped 2 of 7 (29 %): boxes cut off")


@pytest.mark.parametrize(
    ("border", "share", "kept"),
    [(1.0, 0.05, [0]), (1.0, 0.0, [0, 1]), (5.0, 0.0, [0]), (-1.0, 0.05, [0, 1, 2]), (60.0, 0.0, [])],
)
def test_the_border_grows_with_the_box(border, share, kept):
    # 100 px wide boxes that end 50, 4 and 0 px short of the right edge, whose last pixel is 639
    boxes = np.array([[489.0, 200, 589, 240], [535, 200, 635, 240], [539, 200, 639, 240]])
    rays, _ = rays_of(
        log_of(seen(lens("plumb_bob"), boxes, frame=[0, 1, 2])), rays={"border": border, "border_share": share}
    )
    assert rays.track_id.tolist() == kept
    np.testing.assert_array_equal(rays.cut.box, boxes[[] if border < 0 else [i for i in range(3) if i not in kept]])


def test_of_a_label_in_a_frame_the_surest_thousand_are_looked_at():
    rng = np.random.default_rng(0)
    count = np.array([1200, 30, 1000, 1100])  # cups, then books in the first frame, cups in the second, books in the third
    places = np.stack(np.meshgrid(*2 * [np.arange(50.0, 400.0, 10.0)]), axis=-1).reshape(-1, 2)  # 1225 places, not nested
    boxes = boxes_of(np.concatenate([rng.permutation(places)[:n] for n in count]))
    labels, frame, scores = np.repeat([1, 0, 1, 0], count), np.repeat([0, 0, 1, 2], count), rng.uniform(size=count.sum())
    log = log_of(seen(lens("plumb_bob"), boxes, frame=frame, labels=labels, names=("book", "cup"), scores=scores))
    rays, ledger = rays_of(log)
    assert ledger.dropped == {"boxes beyond the 1000 surest of their label in a frame": 300}
    most = np.sort(scores[:1200])[-1000:], np.sort(scores[2230:])[-1000:]
    kept = np.concatenate([scores[:1200] >= most[0][0], np.ones(1030, dtype=bool), scores[2230:] >= most[1][0]])
    assert rays.track_id.tolist() == np.flatnonzero(kept).tolist()


def test_boxes_of_what_is_never_cut_off_hold_up_to_the_edge():
    boxes = np.array([[-20.0, 200, 30, 240], [500, 440, 560, 479.5], [560, 200, 730, 240]])
    camera_log = seen(lens("plumb_bob", np.zeros(5)), boxes)
    rays, ledger = rays_of(log_of(replace(camera_log, detections=replace(camera_log.detections, whole=True))))
    assert rays.track_id.tolist() == [0, 1]
    assert len(rays.cut) == 0
    assert ledger.dropped == {"boxes with their centre outside the image": 1}


def test_sigma_is_how_a_shift_of_the_centre_turns_the_ray():
    camera = lens("plumb_bob", np.zeros(5), np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
    rays, _ = rays_of(log_of(seen(camera, boxes_of(CENTRES))), rays={"pixel_sigma": 4.0, "box_sigma": 0})
    # numerically: along and across the radius, the geometric mean of the two turns for 1e-3 px, scaled up
    for ray, centre in enumerate(CENTRES):
        radial = centre - [320, 240]
        radial = radial / np.linalg.norm(radial)
        moved = centre + 1e-3 * np.array([radial, [-radial[1], radial[0]]])
        turns = np.linalg.norm(undistort(camera, moved)[0] - rays.direction[ray], axis=1)
        assert rays.sigma[ray] == pytest.approx(4.0 * np.sqrt(turns.prod()) / 1e-3, rel=1e-3)


def test_sigma_of_a_fisheye_is_the_same_everywhere():
    camera = lens("equidistant", np.zeros(4))
    rays, _ = rays_of(log_of(seen(camera, boxes_of(CENTRES))), rays={"pixel_sigma": 4.0, "box_sigma": 0})
    np.testing.assert_allclose(rays.sigma, 4.0 / np.sqrt(520 * 515))


def test_large_boxes_wander_more():
    camera = lens("plumb_bob", np.zeros(5))
    log = log_of(seen(camera, np.vstack([boxes_of(CENTRES[:1], (10, 10)), boxes_of(CENTRES[:1], (400, 100))])))
    rays, _ = rays_of(log, rays={"pixel_sigma": 3.0, "box_sigma": 0.05})
    cos = rays.direction[:, 2] ** 1.5
    np.testing.assert_allclose(rays.sigma / cos * camera.focal, [np.hypot(3, 0.5), np.hypot(3, 10)])


def test_depths_become_ranges_along_the_ray():
    camera = lens("plumb_bob")
    depths = [2.0, np.nan, 3.0]
    log = log_of(seen(camera, boxes_of(CENTRES), depths=depths))
    rays, _ = rays_of(log, depth={"sigma": 0.1, "sigma_per_m": 0.05, "centre": 0.0})
    points = rays.direction * rays.range[:, None]
    np.testing.assert_allclose(points[:, 2], depths)
    assert rays.range[2] > 3.1  # off the axis the way is longer than the depth
    np.testing.assert_allclose(rays.range_sigma[[0, 2]], 0.1 + 0.05 * rays.range[[0, 2]])
    without, _ = rays_of(log, depth={"use": False})
    assert np.isnan(without.range).all()


def test_cameras_share_one_label_table():
    left = replace(lens("plumb_bob"), name="left")
    right = replace(lens("equidistant"), name="right")
    log = log_of(
        seen(left, boxes_of(CENTRES), frame=[0, 1, 2], labels=[1, 0, 1], names=("cup", "Stuhl grün")),
        seen(right, boxes_of(CENTRES[:2]), stamps=(1.5, 2.5), frame=[0, 1], labels=[0, 1], names=("book", "cup")),
        CameraLog(replace(left, name="blind")),
    )
    rays, _ = rays_of(log)
    assert rays.label_names == ("Stuhl grün", "book", "cup")
    assert [rays.label_names[i] for i in rays.label] == ["Stuhl grün", "book", "cup", "cup", "Stuhl grün"]
    assert rays.keyframe.tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(project(right, rays.direction[[1, 3]]), CENTRES[:2], atol=1e-6)
    np.testing.assert_allclose(project(left, rays.direction[[0, 2, 4]]), CENTRES, atol=1e-6)


def test_cut_off_boxes_of_several_cameras():
    left, right = replace(lens("plumb_bob"), name="left"), replace(lens("plumb_bob"), name="right")
    box = np.array([[0.0, 200, 60, 240], [300, 200, 340, 240]])
    log = log_of(
        seen(left, box, frame=[1, 2], names=("cup",)),
        seen(right, box, stamps=(1.5, 2.5), frame=[1, 1], labels=[1, 0], names=("cup", "book")),
    )
    cut = rays_of(log)[0].cut
    assert [part.tolist() for part in (cut.camera, cut.frame, cut.label)] == [[0, 1], [1, 1], [1, 0]]
    np.testing.assert_array_equal(cut.box, box[[0, 0]])


def test_frames_off_the_path_bring_no_rays():
    camera = lens("plumb_bob")
    log = log_of(seen(camera, boxes_of(CENTRES), stamps=(-1.0, 2.0, 9.0), frame=[0, 1, 2]))
    rays, _ = rays_of(log)
    assert rays.track_id.tolist() == [1]
    assert rays.keyframe.tolist() == [0]


def test_a_log_without_a_usable_box_has_no_rays():
    rays, _ = rays_of(log_of(seen(lens("plumb_bob"), np.zeros((0, 4)))))
    assert len(rays) == 0
    assert rays.direction.shape == (0, 3)


def test_rays_in_map():
    turn = np.array([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])
    rays, _ = rays_of(log_of(seen(lens("plumb_bob"), boxes_of(CENTRES), frame=[0, 1, 2])))
    origins, directions = rays.in_map(np.array([np.eye(4), turn, turn]))
    np.testing.assert_allclose(origins, [[0, 0, 0], [5, 6, 7], [5, 6, 7]])
    np.testing.assert_allclose(directions[0], rays.direction[0])
    np.testing.assert_allclose(directions[1:], rays.direction[1:] @ turn[:3, :3].T)


def test_angles_off():
    origins, directions = np.zeros((4, 3)), np.tile([0.0, 0, 1], (4, 1))
    points = np.array([[0.0, 0, 5], [0, 3, 3], [2, 0, 0], [0, 0, -1]])
    np.testing.assert_allclose(angles_off(origins, directions, points), np.radians([0, 45, 90, 180]), atol=1e-12)
    tiny = np.array([[1e-9, 0, 1.0]])  # arccos of the cosine would say 0
    np.testing.assert_allclose(angles_off(origins[:1], directions[:1], tiny), 1e-9, rtol=1e-6)


@pytest.mark.parametrize("distortion", [np.zeros(5), np.array([-0.1, 0.01, 0.0, 0.0, 0.0])])
def test_a_pixel_that_is_not_finite_has_no_ray(distortion):
    camera = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), "plumb_bob", distortion)
    directions, valid = undistort(camera, np.array([[320.0, 240.0], [np.nan, 1.0], [np.inf, 1.0], [820.0, 240.0]]))
    assert valid[:3].tolist() == [True, False, False]
    np.testing.assert_allclose(directions[0], [0.0, 0.0, 1.0], atol=1e-9)
