"""Global association against drives whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from association_scenes import drive, join, passed_row, rays_of_boxes, watch

from objslam.association import global_association
from objslam.config import Settings
from objslam.core.geometry import lift_se2
from objslam.core.types import Keyframes, Rays
from objslam.simulation import DepthNoise, DriveSettings, pair, preset
from objslam.triangulation.triangulate import triangulate

ANYTHING = Settings.model_validate({"association": {"min_existence": 0.0}})
APART = Settings.model_validate({"association": {"fuse_labels": False}})


def circle(count, radius=2.0, outward=False):
    """Robot poses (count, 4, 4) on a circle about the origin, looking at its middle or away from it."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    heading = angle + (0.0 if outward else np.pi)
    return lift_se2(np.column_stack([radius * np.cos(angle), radius * np.sin(angle), heading]))


def renamed(rays, names):
    return replace(rays, label_names=names)


@pytest.mark.parametrize("seed", [0, 1])
def test_many_objects_of_a_class_with_misses_and_false_boxes(seed):
    scene = drive(preset("rooms"), seed)
    association = scene.associate()
    found, true, errors = scene.compare(association)
    assert len(found) == association.count
    assert set(np.flatnonzero(scene.well_seen())) <= set(true)
    assert np.sqrt((errors**2).mean()) <= 0.05
    # and each ray is given to its own object, or to nobody
    number = np.full(association.count, -1)
    number[found] = true
    given = association.object >= 0
    assert (number[association.object[given]] == scene.whose[given]).mean() > 0.97
    assert (~given[scene.whose >= 0]).mean() < 0.03


@pytest.mark.parametrize("seed", [1, 11])
def test_moving_objects_and_many_false_boxes(seed):
    scene = drive(preset("hard"), seed, 5.0)
    association = scene.associate()
    found, true, _ = scene.compare(association)
    assert len(found) >= 0.95 * association.count
    assert scene.well_seen()[true].sum() >= 0.95 * scene.well_seen().sum()
    roaming = scene.whose >= len(scene.points)
    assert (association.object[roaming] < 0).mean() > 0.6


@pytest.mark.parametrize("crowded", [1, 12], ids=["a frame", "many frames"])
def test_frames_of_10_000_boxes_of_a_label_do_no_harm(crowded):
    scene = watch(np.array([[0.2, 0.3, 0.3], [-0.3, -0.2, 0.5]]), circle(48), label=np.array([1, 1]), names=("cup", "vase"))
    rng = np.random.default_rng(0)
    frame = np.repeat(np.arange(crowded) * (48 // crowded), 10_000)
    centre = rng.uniform([12, 12], [627, 467], (len(frame), 2))
    cups, boxes = np.zeros(len(frame), dtype=np.int64), np.hstack([centre - 6, centre + 6])
    association = scene.associate(
        rays=join(scene.rays, rays_of_boxes(frame, boxes, cups, scene.cameras[0], ("cup", "vase")))
    )
    vases = np.flatnonzero(association.label == 1)
    assert len(vases) == 2
    number = np.bincount(association.object[association.object >= 0], minlength=association.count)
    assert (number[vases] >= 40).all()


@pytest.mark.parametrize("seed", [0, 2])
def test_what_moves_among_what_stands_gives_no_object(seed):
    placed = (("cup", (2.0, 1.0, 0.5)), ("ball", (-2.0, 1.0, 0.5)))
    settings = DriveSettings(placed=placed, objects=0, moving=3, pixel_sigma=3.0)
    scene = drive(settings, seed)
    association = scene.associate()
    found, _, errors = scene.compare(association)
    assert association.count == len(found) == 2
    assert errors.max() < 0.1
    roaming = scene.whose >= 2
    assert roaming.sum() > 80
    assert (association.object[roaming] < 0).mean() > 0.95


@pytest.mark.parametrize("distance", [0.25, 0.5])
def test_two_close_objects_of_a_class_stay_two(distance):
    for seed in range(3):
        scene = drive(pair(distance, pixel_sigma=3.0, missed=0.2, false=0.2), seed)
        association = scene.associate()
        found, _, errors = scene.compare(association, radius=0.1)
        assert association.count == 2
        assert len(found) == 2
        assert errors.max() < 0.03


@pytest.mark.parametrize("sees_size", [True, False])
def test_size_tells_a_small_thing_from_a_large_one_beside_it(sees_size):
    """A small and a large thing, of which a frame often shows only one. Bearings alone confuse some of their boxes."""
    points, size = np.array([[0.0, 0.0, 0.4], [0.08, 0.0, 0.4]]), (0.08, 0.4)
    scenes = [
        watch(points[[i]], circle(90, radius=2.5), pixel_sigma=4.0, missed=0.4, size=size[i], seed=i) for i in range(2)
    ]
    rays = join(*(one.rays for one in scenes))
    camera = scenes[0].cameras[0]
    large = (rays.box[:, 2] - rays.box[:, 0]) * 2.5 / camera.focal > 0.18  # The camera stays 2.4 to 2.6 m away.
    scene = replace(scenes[0], rays=rays, cameras=(replace(camera, sees_size=sees_size),))
    association = scene.associate()
    assert association.count == 2
    given = association.object >= 0
    same = (association.object[given] == large[given]).mean()
    wrong = min(same, 1 - same)
    assert wrong < 0.02 if sees_size else wrong > 0.04, wrong
    assert given.mean() > 0.95


def test_one_object_with_noisy_boxes_stays_one():
    # three times the noise that was promised: residuals alone would rather have several points
    scene = watch(np.array([[0.1, 0.0, 0.4]]), circle(120), pixel_sigma=1.0)
    noisy = drive(pair(0.5, pixel_sigma=9.0), 0, pixel_sigma=3.0)
    assert scene.associate().count == 1
    assert noisy.associate().count == 2


def test_an_object_has_as_many_rays_as_the_settings_ask_for():
    scene = watch(np.array([[0.1, 0.0, 0.4]]), circle(6), pixel_sigma=1.0)
    count = len(scene.rays)
    found = [
        scene.associate(settings=Settings.model_validate({"association": {"min_existence": 0.0, "min_rays": least}})).count
        for least in (count, count + 1)
    ]
    assert found == [1, 0]


def shuffled(scene, rng):
    """The same scene with its keyframes and the rays in another order; the new place of each ray."""
    frames, rays = rng.permutation(len(scene.keyframes)), rng.permutation(len(scene.rays))
    place = np.argsort(frames)
    keyframes = scene.keyframes.take(frames)
    columns = vars(scene.rays.take(rays))
    return keyframes, Rays(**{**columns, "keyframe": place[columns["keyframe"]]}), rays


def test_the_order_of_frames_and_boxes_changes_nothing():
    scene = drive(preset("hard", depth=DepthNoise(missing=0.5)), 4, 5.0)
    first = scene.associate()
    keyframes, rays, order = shuffled(scene, np.random.default_rng(0))
    assert isinstance(keyframes, Keyframes)
    again = scene.associate(keyframes=keyframes, rays=rays)
    np.testing.assert_array_equal(again.object, first.object[order])
    np.testing.assert_array_equal(again.label, first.label)
    np.testing.assert_allclose(again.existence, first.existence, rtol=1e-6)


def test_the_seed_decides_between_equal_answers_only():
    scene = drive(preset("rooms"), 5)
    one, two = scene.associate(seed=1), scene.associate(seed=1)
    np.testing.assert_array_equal(one.object, two.object)
    other = scene.associate(seed=2)
    assert other.count == one.count
    assert (other.object == one.object).mean() > 0.99


def phantom(scene, point, frames, camera, label=0):
    """Boxes at a point in some frames only."""
    place = watch(point[None], scene.keyframes.map_T_base, pixel_sigma=1.0, names=scene.rays.label_names)
    chosen = place.rays.take(np.isin(place.rays.keyframe, frames))
    return replace(chosen, label=np.full(len(chosen), label))


@pytest.mark.parametrize(
    ("sees", "expected"),
    [
        (lambda number, frame: (frame < 20) & (number < 3), 4),
        (lambda number, frame: frame % 8 == 0, 3),
        (lambda number, frame: (frame < 60) & (number == 1), 3),
        (lambda number, frame: (frame >= 40 * number) & (frame < 40 * number + 20), 3),
    ],
    ids=["hidden behind walls", "scattered", "there in one round", "at another place in each round"],
)
def test_a_thing_that_walls_hide_from_most_places_is_an_object(sees, expected):
    """Of three rounds around four things. Walls have no boxes. In the last case, a third of the looks from the same places
    sees the thing."""
    points = np.array([[0.3, 0.2, 0.4], [-0.4, 0.3, 0.3], [0.0, -0.5, 0.5], [0.2, -0.1, 0.3]])
    scene = watch(points, np.concatenate([circle(150)] * 3), missed=0.1)
    number, frame = np.divmod(scene.rays.keyframe, 150)
    kept = (scene.whose != 3) | sees(number, frame)
    rays = scene.rays.take(kept)
    assert (scene.whose[kept] == 3).sum() >= 45
    assert scene.associate(rays=rays).count == expected


def test_what_should_have_been_seen_and_was_not_loses_support():
    points = np.array([[0.3, 0.2, 0.4], [-0.4, 0.3, 0.3], [0.0, -0.5, 0.5]])
    scene = watch(points, circle(150), missed=0.3)
    ghost = phantom(scene, np.array([0.5, -0.3, 0.8]), np.arange(0, 150, 12), scene.cameras[0])
    both = join(scene.rays, ghost)
    assert len(ghost) >= 10
    kept = scene.associate(ANYTHING, rays=both)
    assert kept.count == 4  # its rays agree as well as any
    assert kept.existence is not None
    assert sorted(kept.existence > 0.5) == [False, True, True, True]
    assert kept.existence.min() < 0.1
    assert scene.associate(rays=both).count == 3
    # the same boxes, had nobody looked in the other frames
    looked = np.unique(ghost.keyframe)
    number = np.searchsorted(looked, both.keyframe)
    some = np.isin(both.keyframe, looked)
    few = Rays(**{**vars(both.take(some)), "keyframe": number[some]})
    assert scene.associate(rays=few, keyframes=scene.keyframes.take(looked)).count == 4


def test_an_object_missed_most_of_the_time_stays():
    points = np.array([[0.3, 0.2, 0.4], [-0.4, 0.3, 0.3], [0.0, -0.5, 0.5]])
    scene = watch(points, circle(150), missed=0.3)
    rarely = watch(np.array([[0.5, -0.3, 0.8]]), scene.keyframes.map_T_base, missed=0.65, seed=3)
    assert scene.associate(rays=join(scene.rays, rarely.rays)).count == 4


def test_one_thing_with_two_labels_is_one_object():
    scene = drive(preset("rooms"), 6)
    rng = np.random.default_rng(0)
    names = (*scene.rays.label_names, "zebra")  # sorts last
    flipped = (scene.rays.label == 0) & (rng.random(len(scene.rays)) < 0.3)
    rays = renamed(replace(scene.rays, label=np.where(flipped, len(names) - 1, scene.rays.label)), names)
    fused = scene.associate(rays=rays)
    assert fused.count == len(scene.points)
    assert fused.label_weights is not None
    np.testing.assert_allclose(fused.label_weights.sum(axis=1), 1.0)
    mixed = fused.label_weights[fused.label == 0]
    assert len(mixed) == (scene.label == 0).sum()
    assert np.abs(mixed[:, -1] - 0.3).max() < 0.25
    apart = scene.associate(APART, rays=rays)
    assert apart.label_weights is not None
    assert (apart.label_weights.max(axis=1) == 1).all()


def test_two_boxes_of_one_thing_in_a_frame_are_one_object():
    points = np.array([[0.3, 0.2, 0.4], [-0.4, 0.3, 0.3]])
    names = ("cat", "teddy bear")
    scene = watch(points, circle(100), names=names, label=np.array([1, 1]), size=0.3, missed=0.2)
    twice = scene.rays.take(np.random.default_rng(1).random(len(scene.rays)) < 0.6)
    box = twice.box + np.random.default_rng(2).normal(0, 2.0, (len(twice), 1))
    cats = rays_of_boxes(twice.keyframe, box, np.zeros(len(twice), dtype=np.int64), scene.cameras[0], names)
    association = scene.associate(rays=join(scene.rays, cats))
    assert association.count == 2
    assert (association.label == 1).all()
    frame_and_object = np.stack([join(scene.rays, cats).keyframe, association.object])[:, association.object >= 0]
    assert np.unique(frame_and_object, axis=1).shape[1] == frame_and_object.shape[1]


def test_different_things_that_touch_stay_two():
    names = ("bowl", "cup")
    points = np.array([[0.0, 0.0, 0.4], [0.12, 0.0, 0.4]])
    scene = watch(points, circle(100), names=names, label=np.array([0, 1]), size=0.1, missed=0.2)
    assert scene.associate().count == 2


@pytest.mark.parametrize(
    "depth", [DepthNoise(), DepthNoise(missing=0.5, wrong=0.3), DepthNoise(wrong=1.0)], ids=["right", "some", "wrong"]
)
def test_depth_breaks_nothing_when_it_is_missing_or_wrong(depth):
    scene = drive(preset("rooms", depth=depth), 3)
    association = scene.associate()
    found, true, _ = scene.compare(association)
    assert len(found) == association.count
    assert set(np.flatnonzero(scene.well_seen())) <= set(true)


def test_depth_tells_apart_what_bearings_cannot():
    # two cups in one line of sight for a robot that stands, one detected at a time
    count = 60
    poses = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
    scene = watch(np.array([[1.5, 0.0, 0.3], [3.0, 0.0, 0.3]]), poses)
    even = scene.rays.take((scene.rays.keyframe + scene.whose) % 2 == 0)
    distance = np.linalg.norm(scene.points - scene.keyframes.map_T_camera[0, :3, 3], axis=1)
    ranges = distance[scene.whose[(scene.rays.keyframe + scene.whose) % 2 == 0]]
    deep = replace(even, range=ranges, range_sigma=np.full(len(even), 0.05))
    assert scene.associate(rays=even).count == 1
    association = scene.associate(ANYTHING, rays=deep)
    assert association.count == 2
    for j in range(2):
        assert np.ptp(ranges[association.object == j]) == 0


def test_ranges_tell_a_row_of_things_from_a_far_point_where_rays_to_all_of_them_meet():
    scene, distance = passed_row(pixel_sigma=2.0)
    measured = distance + 0.1 * np.random.default_rng(0).standard_normal(len(distance))
    rays = replace(scene.rays, range=measured, range_sigma=np.full(len(distance), 0.1))
    association = scene.associate(rays=rays, sigma=np.hypot(rays.sigma, 0.02), position_sigma=0.05)
    held = association.object >= 0
    assert held.mean() > 0.9
    assert association.count == 10
    for j in range(association.count):
        assert len(np.unique(scene.whose[association.object == j])) == 1


@pytest.mark.parametrize("larger", [1.0, 3.0])
def test_sizes_tell_a_row_of_things_from_a_far_point_without_ranges(larger):
    """One post may be larger than the others. It is found all the same."""
    scene, _ = passed_row(pixel_sigma=2.0)
    middle, half = (scene.rays.box[:, :2] + scene.rays.box[:, 2:]) / 2, (scene.rays.box[:, 2:] - scene.rays.box[:, :2]) / 2
    half[scene.whose == 4] *= larger
    rays = replace(scene.rays, box=np.hstack([middle - half, middle + half]))
    association = scene.associate(rays=rays, sigma=np.hypot(rays.sigma, 0.02), position_sigma=0.05)
    assert association.count == 10
    assert (association.object >= 0).mean() > 0.9
    for j in range(association.count):
        assert len(np.unique(scene.whose[association.object == j])) == 1


@pytest.mark.parametrize("scale", [0.5, 1.5])
def test_ranges_of_a_wrong_scale_hide_nothing_that_bearings_show(scale, monkeypatch):
    """The searches that trust bearings have turns of their own, which those that trust ranges cannot use up."""
    monkeypatch.setattr(global_association, "_TURNS", 3)  # Each finds one of the three.
    scene = watch(np.array([[0.3, 0.2, 0.4], [-0.4, 0.3, 0.3], [0.1, -0.5, 0.5]]), circle(60), pixel_sigma=2.0)
    distance = np.linalg.norm(scene.points[scene.whose] - scene.keyframes.map_T_camera[scene.rays.keyframe, :3, 3], axis=1)
    rays = replace(scene.rays, range=scale * distance, range_sigma=np.full(len(distance), 0.05))
    association = scene.associate(rays=rays)
    assert association.count == 3
    assert len(scene.compare(association)[0]) == 3


def test_a_track_that_switches_objects_is_split():
    points = np.array([[0.3, 0.2, 0.4], [-0.4, 0.3, 0.3]])
    scene = watch(points, circle(120), missed=0.1)
    half = scene.rays.keyframe < 60
    wrong = replace(scene.rays, track_id=np.where(half, scene.whose, 1 - scene.whose))
    association = scene.associate(rays=wrong)
    assert association.count == 2
    number = np.array([np.bincount(scene.whose[association.object == j]).argmax() for j in range(2)])
    assert (number[association.object] == scene.whose).mean() > 0.99


@pytest.mark.parametrize("turning", [False, True], ids=["stands", "turns"])
def test_objects_without_parallax_are_found_and_stay_unresolved(turning):
    yaw = np.linspace(-0.2, 0.2, 80) if turning else np.zeros(80)
    poses = lift_se2(np.column_stack([np.zeros((80, 2)), yaw]))
    scene = watch(np.array([[2.5, 0.3, 0.4], [3.0, -0.5, 0.5]]), poses, pixel_sigma=2.0, missed=0.2)
    association = scene.associate()
    assert association.count == 2
    assert (association.object >= 0).mean() > 0.97
    origins, directions = scene.rays.in_map(poses @ scene.cameras[0].base_T_camera)
    placed = triangulate(origins, directions, association.object, 2, scene.rays.sigma, Settings().triangulation)
    assert not placed.ok.any()


def test_a_map_far_from_its_origin_is_the_same_map():
    scene = drive(preset("rooms"), 7)
    near = scene.associate()
    far = scene.keyframes.map_T_base.copy()
    far[:, :3, 3] += [4.1e5, 5.6e6, 120.0]  # a map in UTM coordinates
    there = scene.associate(keyframes=replace(scene.keyframes, map_T_base=far))
    assert there.count == near.count
    assert (there.object == near.object).mean() > 0.999


def test_nothing_to_associate():
    scene = watch(np.array([[0.3, 0.2, 0.4]]), circle(20))
    empty = scene.associate(rays=scene.rays.take(np.zeros(len(scene.rays), dtype=bool)))
    assert empty.count == 0
    assert empty.object.shape == (0,)
    one = scene.associate(rays=scene.rays.take(np.arange(1)))
    assert one.count == 0
    assert one.object.tolist() == [-1]
    assert one.label_weights is not None
    assert one.label_weights.shape == (0, 1)


def test_strays_alone_make_no_object():
    rng = np.random.default_rng(0)
    scene = watch(np.zeros((0, 3)), circle(200))
    frame = np.sort(rng.integers(0, 200, 150))
    centre = rng.uniform([20, 20], [620, 460], (150, 2))
    strays = rays_of_boxes(
        frame, np.column_stack([centre - 15, centre + 15]), np.zeros(150, dtype=np.int64), scene.cameras[0], ("cup",), 3.0
    )
    assert scene.associate(rays=strays).count == 0


def test_a_guess_is_gone_on_from_and_a_wrong_one_does_no_harm():
    """From its own answer nothing changes; two objects taken for one, and one for two, are put right."""
    scene = drive(preset("rooms"), 2)
    plain = scene.associate()
    origins, directions = scene.rays.in_map(scene.keyframes.map_T_camera)

    def placed(association):
        settings = Settings().triangulation
        return triangulate(origins, directions, association.object, association.count, scene.rays.sigma, settings).positions

    again = scene.associate(guess=(plain, placed(plain)))
    assert (again.object != plain.object).mean() < 0.005
    np.testing.assert_array_equal(again.label, plain.label)

    wrong = plain.object.copy()
    wrong[plain.object == 1] = 0
    half = np.flatnonzero(plain.object == 2)[::2]
    wrong[half] = plain.count
    guess = replace(plain, object=wrong, label=np.append(plain.label, plain.label[2]))
    mended = scene.associate(guess=(guess, placed(guess)))
    found, true, _ = scene.compare(mended)
    assert len(found) == mended.count
    assert set(np.flatnonzero(scene.well_seen())) <= set(true)
