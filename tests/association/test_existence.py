"""What was seen and what should have been, how large things are, and what the counts say."""

from dataclasses import replace

import numpy as np
import pytest
from association_scenes import drive, rays_of_boxes, watch
from scipy.special import comb
from scipy.stats import betabinom

from objslam.association.existence import (
    Rates,
    _beta_binomial,
    beyond_chance,
    chance_odds,
    detection_rates,
    existence,
    prior_odds,
    rarer_objects,
    rest_odds,
    size_odds,
    static_odds,
)
from objslam.association.gating import alternate
from objslam.association.landmarks import Landmarks, State
from objslam.association.nearest_neighbour import associate_by_label
from objslam.association.observations import PosedRays, extents, observe, overlap
from objslam.association.refinement import refine
from objslam.association.visibility import CameraFrames, DetectionHistory, _hidden, detection_history, frames_of
from objslam.config import Settings
from objslam.core.bodies.cut_boxes import CutBoxes
from objslam.core.geometry import inverse, lift_se2
from objslam.core.types import Association
from objslam.simulation import DriveSettings, make_camera
from objslam.simulation.scene import EXTENTS


def straight(count=80):
    """Sideways past the origin, looking along x."""
    return lift_se2(np.column_stack([np.zeros(count), np.linspace(-1.2, 1.2, count), np.zeros(count)]))


def state_of(scene, rays=None, whose=None):
    """The true state of a scene."""
    rays = scene.rays if rays is None else rays
    whose = scene.whose if whose is None else whose
    poses = scene.keyframes.map_T_camera
    obs, ray, _ = observe(PosedRays(rays, scene.keyframes, scene.cameras, poses, rays.sigma))
    landmarks = Landmarks.new(scene.points, np.ones(len(scene.points)), scene.label, len(rays.label_names))
    view = CameraFrames(scene.keyframes.stamps, scene.cameras, scene.keyframes.camera, poses, 0.0, 0.0)
    return State(obs, view, landmarks, whose[ray])


@pytest.mark.parametrize(
    "camera",
    [
        make_camera(distortion=(-0.2, 0.05, 0.0, 0.0, 0.0)),
        make_camera(distortion_model="equidistant", distortion=(0.0, 0.0, 0.0, 0.0), focal=300.0, pitch=-0.1),
    ],
    ids=["plumb_bob", "fisheye"],
)
def test_what_is_always_detected_is_expected_where_it_is_seen(camera):
    settings = DriveSettings(objects=8, classes=8, frames=200, cameras=(camera,), max_range=4.0)
    scene = drive(settings, 1)
    seen = state_of(scene).history
    assert (seen.seen == np.bincount(scene.whose, minlength=8)).all()
    assert (seen.seen >= 0.9 * seen.expected).all()  # but for the edge of the image and of the range


def test_what_the_cameras_see_on_average():
    pinhole, around = make_camera(), make_camera("up", distortion_model="equidistant", distortion=(0.0,) * 4, focal=200.0)
    around = replace(around, width=1000, height=1000, matrix=np.array([[200.0, 0, 499.5], [0, 200, 499.5], [0, 0, 1]]))
    half = np.array([640, 480]) / 2 / 460
    flat = 4 * np.arctan(half.prod() / np.sqrt(1 + (half**2).sum()))

    def seen(camera):
        frames = np.array(camera)
        return CameraFrames(np.arange(4.0), (pinhole, around), frames, np.tile(np.eye(4), (4, 1, 1)), 0.0, 0.0).solid_angle

    assert seen([0, 0, 0, 0]) == pytest.approx(flat, rel=1e-12)
    assert seen([1, 1, 1, 1]) == pytest.approx(2 * np.pi, rel=1e-12)  # a fisheye of 180 degrees: the half sphere
    assert seen([0, 1, 0, 0]) == pytest.approx((3 * flat + 2 * np.pi) / 4, rel=1e-12)


def test_misses_are_counted():
    scene = watch(np.array([[2.0, 0.0, 0.3], [2.0, 0.4, 0.3]]), straight(), missed=0.4, seed=2)
    seen = state_of(scene).history
    inside = [int((np.abs(camera_pixels(scene, j) - 319.5) < 300).sum()) for j in range(2)]
    assert np.abs(seen.expected - inside).max() <= 6
    assert abs((seen.seen / seen.expected).mean() - 0.6) < 0.1


def camera_pixels(scene, j):
    local = inverse(scene.keyframes.map_T_camera)
    point = local[:, :3, :3] @ scene.points[j] + local[:, :3, 3]
    return 460 * point[:, 0] / point[:, 2] + 319.5


def test_a_detector_of_whole_objects_misses_a_thing_that_the_edge_of_the_image_cuts_off():
    """A false thing of wrong boxes, each larger than the image, was never missed, so a few such boxes were a proof of it."""
    scene = watch(np.array([[2.0, 0.0, 0.3], [2.0, 0.4, 0.3]]), straight(), missed=0.4, seed=2)
    box = scene.rays.box.copy()
    box[scene.whose == 1] += [-400, -400, 400, 400]
    of_image = state_of(scene, replace(scene.rays, box=np.clip(box, 0, [639, 479, 639, 479]))).history
    whole = state_of(scene, replace(scene.rays, box=box)).history
    inside = [int((np.abs(camera_pixels(scene, j) - 319.5) < 320).sum()) for j in range(2)]
    assert of_image.expected[1] <= of_image.seen[1] + 6  # Hardly an image holds all of it, so misses are not known.
    assert np.abs(whole.expected - inside).max() <= 6
    assert abs((whole.seen / whole.expected).mean() - 0.6) < 0.1


def test_a_few_wrong_boxes_beyond_the_image_do_not_change_what_counts_as_missed():
    scene = watch(np.array([[2.0, 0.0, 0.3], [2.0, 0.4, 0.3]]), straight(), missed=0.4, seed=2)
    box = scene.rays.box.copy()
    box[scene.whose == 1] += [-400, -400, 400, 400]
    cut = np.clip(box, 0, [639, 479, 639, 479])
    few = cut.copy()
    few[np.flatnonzero(scene.whose == 1)[:2]] = box[np.flatnonzero(scene.whose == 1)[:2]]
    history = state_of(scene, replace(scene.rays, box=few)).history
    assert history.expected[1] <= history.seen[1] + 6  # If only centres had to be in the image, 29 more would be expected.


def test_what_a_closer_box_hides_is_not_missed():
    points = np.array([[3.0, 0.0, 0.3], [1.2, 0.0, 0.3], [2.9, 0.5, 0.3]])
    scene = watch(points, straight(), label=np.array([0, 1, 0]), names=("cup", "screen"))
    wide = scene.rays.box.copy()
    wide[scene.whose == 1] += [-60, -60, 60, 60]
    state = state_of(scene, replace(scene.rays, box=wide))
    obs, label, position = state.obs, scene.label, state.landmarks.position
    # the cup is detected where the screen is not in the way
    free = np.abs(camera_pixels(scene, 0) - camera_pixels(scene, 1)) > 80
    visible = free[obs.frame] | (state.matched != 0)
    matched = np.where(visible, state.matched, -1)
    hidden = detection_history(obs, matched, position, label, state.view)
    screenless = np.where(obs.label == 1, -1, matched)
    missed = detection_history(obs, screenless, position, label, state.view)
    assert missed.expected[0] - hidden.expected[0] > 0.5 * (~free).sum()
    assert hidden.seen[0] == missed.seen[0]


def test_boxes_hide_alike_in_frames_of_few_and_of_many():
    scene, rng = watch(np.array([[2.0, 0.0, 0.3]]), straight()), np.random.default_rng(0)
    frame = np.sort(rng.integers(0, 80, 900) ** 2 // 80)  # 1 to 100 in a frame
    corner = rng.uniform(0, 330, (900, 2))
    boxes = rays_of_boxes(
        frame, np.hstack([corner, corner + 100]), np.zeros(900, dtype=np.int64), scene.cameras[0], ("cup",)
    )
    s, _, _ = observe(PosedRays(boxes, scene.keyframes, scene.cameras, scene.keyframes.map_T_camera, boxes.sigma))
    reach = np.where(rng.random(900) < 0.1, np.nan, rng.uniform(0.5, 4.0, 900))
    place, pixel, away = np.repeat(np.arange(80), 3), rng.uniform(50, 380, (240, 2)), rng.uniform(0.5, 4.0, 240)
    middle, half = (s.box[:, :2] + s.box[:, 2:]) / 2, 0.3 * (s.box[:, 2:] - s.box[:, :2])
    closer = reach < (away - np.maximum(0.3, 0.1 * away))[:, None]
    over = closer & (np.abs(pixel[:, None] - middle) <= half).all(axis=2) & (s.frame == place[:, None])
    np.testing.assert_array_equal(_hidden(place, away, pixel, s, reach, np.zeros(240)), over.any(axis=1))
    assert 20 < over.any(axis=1).sum() < 220


def test_misses_from_behind_say_nothing_of_what_has_a_front():
    angle = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    poses = lift_se2(np.column_stack([2 * np.cos(angle), 2 * np.sin(angle), angle + np.pi]))
    scene = watch(np.array([[0.0, 0.0, 0.4]]), poses)
    state = state_of(scene)
    frame = state.obs.frame
    front = np.cos(angle[frame]) > 0.3
    one_side = replace(state, matched=np.where(front, 0, -1)).history
    assert one_side.expected[0] <= 62
    everywhere = replace(state, matched=np.where(front | (frame % 10 == 0), 0, -1)).history
    assert everywhere.expected[0] >= 110


def test_beta_binomial_by_scipy():
    seen, expected = np.array([0, 3, 7, 20]), np.array([5, 9, 7, 30])
    rate, concentration = 0.3, 8.0
    whole = betabinom.logpmf(seen, expected, rate * concentration, (1 - rate) * concentration)
    one = whole - np.log(comb(expected, seen))
    np.testing.assert_allclose(_beta_binomial(seen, expected, np.zeros(4, dtype=int), np.array([rate]), concentration), one)
    # Objects of another class do not change the result.
    label, rates = np.array([1, 0, 1, 0]), np.array([0.9, rate])
    own = _beta_binomial(seen, expected, label, rates, concentration)[label == 1]
    np.testing.assert_allclose(own, np.asarray(one)[label == 1])


def counted(seen, expected):
    """A history with that many detections in that many frames."""
    obj = np.repeat(np.arange(len(seen)), expected)
    frame = np.concatenate([np.arange(n) for n in expected])
    return DetectionHistory(obj, frame, frame < np.repeat(seen, expected), np.array(expected))


def test_rates_are_those_of_most_boxes_and_phantoms_fall_out():
    rng = np.random.default_rng(0)
    expected = np.full(24, 60)
    seen = np.append(rng.binomial(60, 0.6, 20), [5, 6, 3, 4])
    label = np.zeros(24, dtype=np.int64)
    rates = detection_rates(counted(seen, expected), label, 1)
    assert abs(rates.mean[0] - 0.6) < 0.05
    odds = rates.log_odds(counted(seen, expected), label)
    assert (odds[:20] > 2).all()
    assert (odds[20:] < -1).all()


def test_where_rates_differ_a_low_one_is_no_proof():
    seen, expected = np.array([54, 42, 30, 24, 18, 57]), np.full(6, 60)
    label = np.zeros(6, dtype=np.int64)
    rates = detection_rates(counted(seen, expected), label, 1)
    assert (rates.log_odds(counted(seen, expected), label) > 0).all()
    assert isinstance(rates, Rates)
    assert rates.concentration <= 5


def test_one_thing_does_not_tell_how_often_others_of_its_class_are_seen():
    """One of the two things of class 0 stands free, and the other one is seen as often as the things of other classes. Ten
    things that are seen equally often do tell."""
    expected, others = 600, [0.25, 0.2, 0.3, 0.22, 0.27, 0.24, 0.33, 0.21]
    label = np.concatenate([[0, 0], np.arange(1, 9)])
    history = counted((expected * np.array([0.65, 0.21, *others])).astype(int), np.full(len(label), expected))
    odds = detection_rates(history, label, 9).log_odds(history, label, False)
    assert (odds > 0).all()
    label = np.concatenate([np.zeros(11, dtype=np.int64), np.arange(1, 9)])
    share = np.array([0.21, *np.full(10, 0.65), *others])
    history = counted((expected * share).astype(int), np.full(len(label), expected))
    many = detection_rates(history, label, 9).log_odds(history, label, False)
    assert many[0] < odds[1] - 1


def test_names_at_a_localisation_tell_how_often_each_thing_is_seen():
    """Fourteen named things are seen in shares of 0.3 to 0.95 of their frames. One of them is there twice, a little aside,
    because the localisation erred for a while."""
    share, expected = np.append(np.linspace(0.3, 0.95, 14), 0.2), 400
    label = np.append(np.arange(14), 11)
    history = counted((expected * share).astype(int), np.full(15, expected))
    rates = detection_rates(history, label, 14, told=True)
    odds = rates.log_odds(history, label, False)
    assert (odds[:14] > 2).all()
    assert odds[14] < -5  # -2.8 with the spread of rates of things without names
    # If names told nothing, all things would have one rate, so rates would differ much, and the double might be a thing.
    assert detection_rates(history, label, 14).concentration < rates.concentration / 2


def test_a_thing_that_one_visit_of_two_shows_is_no_phantom():
    """All other things are seen in 19 of 20 frames, one in half of them, and phantoms in a tenth."""
    seen, expected = np.array([57, 58, 56, 57, 59, 30, 6, 5]), np.full(8, 60)
    label = np.zeros(8, dtype=np.int64)
    rates = detection_rates(counted(seen, expected), label, 1)
    odds = rates.log_odds(counted(seen, expected), label)
    assert (odds[:5] > 10).all()
    assert odds[5] > -np.log(3.0)  # a box of a class without strays has prior odds of 3
    assert (odds[6:] < -3).all()
    mean, sum_ = rates.mean[0], rates.concentration
    usual = betabinom.pmf(seen, expected, sum_ * mean, sum_ * (1 - mean))
    rarer = betabinom.pmf(seen, expected, 12 * 0.6 * mean, 12 * (1 - 0.6 * mean))
    phantom = betabinom.pmf(seen, expected, 1.0, 8 / mean - 1)
    np.testing.assert_allclose(odds, np.log((0.95 * usual + 0.05 * rarer) / phantom))


def test_from_odometry_alone_half_of_the_boxes_are_too_few():
    """Where the path is wrong, the rays of a known thing meet beside it, and pass no other object."""
    scene = watch(np.array([[2.0, 0.0, 0.3], [2.0, 0.6, 0.3]]), straight())
    whole = state_of(scene)
    often = np.where((whole.matched == 0) & (whole.obs.frame % 3 > 0), -1, whole.matched)
    state = replace(whole, matched=often)
    rates = Rates(np.full(2, 0.95), 50.0, 0.95, 0.0)
    at_odometry = replace(state, view=replace(state.view, localized=False))
    assert rarer_objects(state, rates, 9.0).tolist() == [True, True]
    assert not rarer_objects(at_odometry, rates, 9.0).any()
    assert static_odds(state, 9.0)[0] > static_odds(at_odometry, 9.0)[0]


def test_a_cut_off_box_of_the_label_is_no_miss():
    scene = watch(np.array([[2.0, 0.0, 0.3], [2.0, 0.6, 0.3]]), straight())
    state = state_of(scene)
    frame, matched = state.obs.frame, np.where(state.obs.frame < 60, state.matched, -1)
    history = detection_history(state.obs, matched, scene.points, scene.label, state.view)
    missed = np.flatnonzero((history.object == 0) & ~history.detected)
    assert len(missed) >= 8
    shown = np.flatnonzero((state.matched == 0) & np.isin(frame, history.frame[missed]))
    box, of = state.obs.box[shown] - [40, 0, 0, 0], frame[shown]
    for label, left in ((scene.label[0], 0), (scene.label[0] + 7, len(missed))):
        cut = CutBoxes(np.zeros(len(of), dtype=np.int64), of, np.full(len(of), label), box)
        again = detection_history(state.obs, matched, scene.points, scene.label, replace(state.view, cut=cut))
        assert ((again.object == 0) & ~again.detected).sum() == left
        assert again.seen[0] == history.seen[0]


def test_cut_off_boxes_find_their_frames():
    scene, rng = watch(np.array([[2.0, 0.0, 0.3]]), straight()), np.random.default_rng(0)
    keyframes, order = scene.keyframes, rng.permutation(len(scene.keyframes))
    frame = rng.integers(0, 200, 50)
    cut = CutBoxes(np.zeros(50, dtype=np.int64), frame, np.arange(50), np.zeros((50, 4)))
    found = frames_of(keyframes, order, scene.cameras, keyframes.map_T_camera, Settings(), cut=cut).cut
    assert found is not None
    assert (np.diff(found.frame) >= 0).all()
    want = {(int(np.flatnonzero(keyframes.frame[order] == f)[0]), i) for i, f in enumerate(frame) if f in keyframes.frame}
    assert 0 < len(want) < 50
    assert set(zip(found.frame.tolist(), found.label.tolist(), strict=True)) == want


def test_small_things_hide_each_other_where_large_ones_do_not():
    """A thing 0.15 m in front, at 1 m: it is in front if both are 0.1 m large, and may be beside it if they are 0.3 m."""
    scene = watch(np.array([[1.0, 0.0, 0.3]]), straight(1))
    near = rays_of_boxes(
        np.zeros(1, dtype=int), np.array([[270.0, 190, 370, 290]]), np.zeros(1, dtype=int), scene.cameras[0], ("cup",)
    )
    s, _, _ = observe(PosedRays(near, scene.keyframes, scene.cameras, scene.keyframes.map_T_camera, near.sigma))
    at, pixel = np.zeros(1, dtype=np.int64), np.array([[320.0, 240.0]])
    for size, hides in ((0.1, True), (0.3, False), (0.0, False)):
        sized = replace(s, size=np.full((1, 2), 0.1 / 0.85))
        assert _hidden(at, np.ones(1), pixel, sized, np.array([0.85]), np.full(1, size))[0] == hides


def test_more_rays_and_fewer_strays_are_less_like_chance():
    points = np.array([[2.0, 0.2, 0.4]])
    scene = watch(points, straight())
    state = state_of(scene)
    odds = []
    for keep in (3, 5, 40):
        few = (np.cumsum(state.matched == 0) <= keep) & (state.matched == 0)
        odds.append(chance_odds(replace(state, obs=state.obs.take(few), matched=state.matched[few]), 13.8)[0])
    assert odds[0] < odds[1] <= odds[2]
    rng = np.random.default_rng(0)
    frame, centre = np.sort(rng.integers(0, 80, 4000)), rng.uniform(30, 450, (4000, 2))
    box, label = np.column_stack([centre - 9, centre + 9]), np.zeros(4000, dtype=np.int64)
    strays = rays_of_boxes(frame, box, label, scene.cameras[0], ("cup",), 4.0)
    many, ray, _ = observe(PosedRays(strays, scene.keyframes, scene.cameras, scene.keyframes.map_T_camera, strays.sigma))
    to = points[0] - many.origin
    near = np.linalg.norm(np.cross(to, many.direction), axis=1) < 3.7 * many.sigma * np.linalg.norm(to, axis=1)
    chance = replace(state, obs=many, matched=np.where(near, 0, -1))
    assert near.sum() >= 3
    assert chance_odds(chance, 13.8)[0] < 0
    assert len(ray) == 4000


def test_looks_are_only_counted_where_they_decide():
    points = np.array([[2.0, 0.2, 0.4]])
    state = state_of(watch(points, np.concatenate([straight(), lift_se2(np.tile([0.0, 0.0, np.pi], (400, 1)))])))
    answers = set()
    for keep in (3, 4, 5, 8, 40):
        few = np.flatnonzero((state.matched == 0) & (np.cumsum(state.matched == 0) <= keep))
        less = replace(state, obs=state.obs.take(few), matched=state.matched[few])
        for least in np.linspace(-20.0, 60.0, 41):
            fresh = replace(less)
            got = beyond_chance(fresh, 13.8, least)
            assert (got == (chance_odds(less, 13.8) >= least)).all()
            answers.add((bool(got[0]), "history" in vars(fresh)))
    # Yes without a count, and yes and no with one. A no is never said without a count.
    assert answers == {(True, False), (True, True), (False, True)}


def test_a_settled_state_stays_the_same_state():
    scene = drive(DriveSettings(), 3)
    state = state_of(scene)
    for _ in range(10):  # Without a limit, a fault here would never end.
        before, state = state, alternate(state, 13.8, lambda now: np.ones(now.count, dtype=bool))
        if state is before:
            break
    assert state is before
    louder = replace(state, landmarks=replace(state.landmarks, noise=1.5 * state.landmarks.noise))
    again = alternate(louder, 13.8, lambda now: np.ones(now.count, dtype=bool))
    np.testing.assert_allclose(again.landmarks.noise, state.landmarks.noise, rtol=0.1)
    empty = replace(state, matched=np.full_like(state.matched, -1))
    again = alternate(empty, 13.8, lambda now: np.ones(now.count, dtype=bool))
    assert np.array_equal(again.matched, state.matched)
    np.testing.assert_allclose(again.landmarks.position, state.landmarks.position, atol=1e-6)
    none = alternate(state, 13.8, lambda now: np.zeros(now.count, dtype=bool))
    assert none.count == 0


def test_priors_and_sizes():
    scene = watch(np.array([[2.0, 0.0, 0.3], [2.0, 0.4, 0.3]]), straight())
    state = state_of(scene)
    obs = state.obs
    np.testing.assert_allclose(prior_odds(state), np.log(3.0))
    most_free = replace(state, matched=np.where(obs.frame % 10 == 0, state.matched, -1))
    assert (prior_odds(most_free) < -1).all()
    np.testing.assert_allclose(size_odds(state), 0.0)
    large = np.where((state.matched == 1)[:, None], obs.size * 8, obs.size)
    thrice = np.concatenate([large, obs.size[state.matched == 0]])  # the first one has most boxes
    assert len(thrice) > len(large)
    half = np.where((obs.frame % 2 > 0) | (state.matched == 0), state.matched, -1)
    odds = size_odds(replace(state, obs=replace(obs, size=large), matched=half))
    assert odds[0] == 0
    assert odds[1] < -2


def test_what_moves_is_told_from_what_rests():
    count = 60
    poses = straight(count)
    resting = watch(np.array([[2.0, 0.1, 0.4]]), poses, pixel_sigma=3.0, seed=3)
    state = state_of(resting)
    obs = state.obs
    assert rest_odds(state)[0] > -1
    way = np.linspace(-0.3, 0.3, count)[obs.frame, None] * np.array([0.0, 0.0, 1.0])  # it is lifted
    turned = obs.direction + way / np.linalg.norm(scene_to(resting, obs), axis=1, keepdims=True)
    moving = replace(state, obs=replace(obs, direction=turned / np.linalg.norm(turned, axis=1, keepdims=True)))
    assert rest_odds(moving)[0] < -5

    def on_a_path_that_tilts(sigma):
        drift = np.zeros((count, 6, 6))
        drift[:, 1, 1] = 0.3 + sigma**2 * np.linspace(0, 1, count)
        return rest_odds(replace(moving, view=replace(state.view, drift=drift)))[0]

    # It is 2.04 m from the axis of the tilt, and lifted by 0.6 m, which is two standard deviations of a tilt of 0.147 rad.
    assert on_a_path_that_tilts(0.155) == 0.0
    assert on_a_path_that_tilts(0.135) < -5


@pytest.mark.parametrize("seed", range(3))
def test_lasting_errors_of_poses_are_no_motion(seed):
    """The poses of two visits err by 2 cm each, as the settings say, and all rays of a visit share the error."""
    rng, count = np.random.default_rng(seed), 60
    side, angle = np.linspace(-0.6, 0.6, count // 2), rng.uniform(0.8, 1.6)
    one = np.column_stack([np.zeros(count // 2), side, np.zeros(count // 2)])
    other = np.column_stack([2 - 1.5 * np.cos(angle) - side * np.sin(angle), -1.5 * np.sin(angle) + side * np.cos(angle)])
    poses = lift_se2(np.vstack([one, np.column_stack([other, np.full(count // 2, angle)])]))
    scene = watch(np.array([[2.0, 0.0, 0.4]]), poses, seed=seed)
    state = state_of(scene)
    visit = (state.obs.frame >= count // 2).astype(int)
    assert min(np.bincount(visit)) > 10
    shift = rng.normal(scale=0.02, size=(2, 3))
    obs = replace(state.obs, origin=state.obs.origin + shift[visit], position_sigma=0.02)
    ray = np.arange(len(obs))
    at = refine(obs, ray, np.zeros(len(ray), dtype=np.int64), scene.points, np.ones(1))
    small = replace(obs, size=obs.size * 0.05)  # Its own size allows no motion.
    still = replace(state, obs=small, landmarks=replace(state.landmarks, position=at))
    assert rest_odds(still)[0] >= 0
    walks = 0.5 * shift[0] / np.linalg.norm(shift[0]) * np.linspace(0, 1, len(ray))[:, None]
    moved = replace(small, origin=obs.origin + walks * [0, 1, 1])
    there = refine(moved, ray, np.zeros(len(ray), dtype=np.int64), scene.points, np.ones(1))
    moving = replace(state, obs=moved, landmarks=replace(state.landmarks, position=there))
    assert rest_odds(moving)[0] < 0


def scene_to(scene, obs):
    return scene.points[0] - obs.origin


def test_extents_are_those_of_the_things():
    scene = drive(DriveSettings(objects=6, frames=150), 0)
    association = associate_by_label(scene.rays)
    positions = scene.points[[int(np.flatnonzero(scene.label == label)[0]) for label in association.label]]
    poses = scene.keyframes.map_T_camera
    found = extents(scene.rays, association, positions, poses, scene.keyframes, scene.cameras)
    true = np.array([EXTENTS[scene.rays.label_names[label]] for label in association.label])
    np.testing.assert_allclose(found, true, rtol=0.02)
    rng = np.random.default_rng(0)
    torn = scene.rays.box.copy()
    some = rng.random(len(torn)) < 0.3
    torn[some, 2:] += rng.uniform(50, 300, (int(some.sum()), 2))
    again = extents(replace(scene.rays, box=torn), association, positions, poses, scene.keyframes, scene.cameras)
    np.testing.assert_allclose(again, true, rtol=0.02)
    blind = tuple(replace(camera, sees_size=False) for camera in scene.cameras)
    assert np.isnan(extents(scene.rays, association, positions, poses, scene.keyframes, blind)).all()
    nobody = Association(np.full(len(scene.rays), -1), np.zeros(1, dtype=np.int64))
    assert np.isnan(extents(scene.rays, nobody, np.zeros((1, 3)), poses, scene.keyframes, scene.cameras)).all()


def test_what_follows_from_a_state_is_computed_once(monkeypatch):
    state = state_of(watch(np.array([[2.0, 0.0, 0.3], [2.0, 0.4, 0.3]]), straight()))
    asked = []
    monkeypatch.setattr(
        "objslam.association.landmarks.detection_history", lambda *given: asked.append(given) or detection_history(*given)
    )
    assert (existence(state, 13.8) == existence(state, 13.8)).all()
    assert len(asked) == 1
    assert state.keep(np.ones(2, dtype=bool)) is state
    assert existence(state.keep(np.array([True, False])), 13.8).shape == (1,)
    assert len(asked) == 2


def test_overlap_of_boxes():
    a = np.array([[0, 0, 10, 10], [0, 0, 10, 10], [0, 0, 10, 10], [5, 5, 5, 5]], dtype=float)
    b = np.array([[0, 0, 10, 10], [5, 0, 15, 10], [20, 20, 30, 30], [5, 5, 5, 5]], dtype=float)
    np.testing.assert_allclose(overlap(a, b), [1, 1 / 3, 0, 0])
