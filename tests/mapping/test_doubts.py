"""Doubts about a result: each is made on purpose, and must be found with its reason. A clean drive has none."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from doubtful_drives import DEFAULT, LEAN, boxes_of, camera_poses, clean_rooms, mapped, reassociated, relabelled
from more_boxes import with_boxes
from scipy.spatial.transform import Rotation

from objslam.config import Settings
from objslam.core.result import Doubt, RunResult
from objslam.core.types import Log
from objslam.mapping.doubts import words
from objslam.mapping.doubts.evidence import evidence_of
from objslam.mapping.doubts.find import _doubtful_objects, _praised
from objslam.mapping.doubts.groups import REASONS
from objslam.mapping.doubts.pairs import find_pairs
from objslam.mapping.doubts.sizes import _LEAST, _alike, mixed_sizes
from objslam.simulation import pair, preset, simulate
from objslam.simulation.settings import DepthNoise


def only(result: RunResult) -> Doubt:
    """The one doubt of a result."""
    assert len(result.doubts) == 1, [one.text for one in result.doubts]
    assert sum(result.summary["doubts"].values()) == 1
    return result.doubts[0]


def with_association(**changes: Any) -> Settings:
    """The settings with other values for the association."""
    return LEAN.model_copy(update={"association": LEAN.association.model_copy(update=changes)})


@pytest.fixture(scope="module")
def rooms() -> Log:
    return simulate(preset("rooms", false=0.05), 1)


@pytest.mark.parametrize("drive", ["demo", "rooms"])
def test_a_clean_drive_has_no_doubts(drive):
    result = mapped(simulate(preset(drive), 2), DEFAULT)
    assert result.doubts == ()
    assert set(result.summary["doubts"].values()) == {0}


def test_two_objects_taken_as_one_may_be_two():
    exact = LEAN.model_copy(update={"calibration": LEAN.calibration.model_copy(update={"translation": 0.0})})
    result = mapped(simulate(pair(0.25, pixel_sigma=2.0, missed=0.2), 0), exact)
    assert len(result.map) == 2
    assert result.doubts == ()
    found = only(reassociated(result, np.minimum(result.association.object, 0)))
    assert (found.kind, found.objects) == ("split", (0,))
    assert found.numbers["gap_m"] == pytest.approx(0.25, abs=0.03)
    true = np.bincount(result.association.object)
    assert sorted([found.numbers["rays_first"], found.numbers["rays_second"]]) == pytest.approx(sorted(true), rel=0.1)
    assert "of its rays meet near (1.50, " in found.text
    frames = result.rays.keyframe
    both = np.intersect1d(*(frames[result.association.object == j] for j in (0, 1)))
    assert found.numbers["frames_with_both"] == pytest.approx(len(both), rel=0.1)


def test_one_object_taken_as_two_may_be_one():
    result = mapped(simulate(preset("rooms", false=0.0, missed=0.3), 3))
    objects, count = result.association.object, len(result.map)
    mine = np.flatnonzero(objects == 4)
    later = objects.copy()
    later[mine[len(mine) // 2 :]] = count
    doubtful = reassociated(result, later)
    found = only(doubtful)
    assert (found.kind, set(found.objects)) == ("pair", {4, count})
    assert found.numbers["probability"] > 0.5
    assert set(found.rays) == set(mine)
    first, second = (result.map[4].label + f" #{one}" for one in (4, count))
    assert found.text.endswith(f" {first} was seen before {second}, so it may have moved from one place to the other.")
    pairs = find_pairs(evidence_of(doubtful))
    near = next(words._pairs(doubtful, replace(pairs, sigmas=np.full(len(pairs.sigmas), 0.5))))
    assert "moved" not in near.text  # Both places are one.
    for share in (2, 3):  # If their boxes alternate in time, it cannot have moved.
        later[mine] = np.where(np.arange(len(mine)) % share, 4, count)
        assert words._if_moved(reassociated(result, later), 4, count) == ""
    before, after = (one.summary["assessment"] for one in (result, doubtful))
    assert (before["level"], after["level"]) == ("good", "check")
    assert after["reasons"][0].startswith("1 object may be a double")
    assert after["reasons"][1:] == before["reasons"][1:]


def halves(result: RunResult, objects: int) -> RunResult:
    """The result whose first objects are two objects each: one of their earlier boxes, and one of their later boxes."""
    mine = result.association.object
    late = np.zeros(len(mine), dtype=bool)
    for j in range(objects):
        late[np.array_split(np.flatnonzero(mine == j), 2)[1]] = True
    return reassociated(result, np.where(late, mine + len(result.map), mine))


def test_a_map_of_many_doubles_is_bad_and_names_the_poses():
    result = mapped(simulate(preset("rooms", false=0.0), 1))
    assert result.summary["doubtful_objects"] == 0
    for objects, level in ((1, "check"), (len(result.map), "bad")):
        wrong = halves(result, objects)
        assert wrong.summary["doubtful_objects"] == pytest.approx(2 * objects, rel=0.2)
        assert wrong.summary["assessment"]["level"] == level
    unlikely = [replace(one, numbers={**one.numbers, "probability": 0.3}) for one in wrong.doubts if one.kind == "pair"]
    assert _doubtful_objects(tuple(unlikely), wrong) == 0
    assert "the poses are likely worse than localization.xy (0.02 m)" in wrong.summary["assessment"]["reasons"][0]


def test_objects_that_frames_show_together_are_two():
    # Their distance is less than two standard deviations, so nothing but the frames tells them apart.
    result = mapped(simulate(pair(0.08, pixel_sigma=1.0), 1))
    assert len(result.map) == 2
    assert [one for one in result.doubts if one.kind == "pair"] == []


def test_a_thing_that_moves():
    log = simulate(preset("rooms", moving=1, tracks="perfect", missed=0.1, false=0.05), 0)
    result = mapped(log)
    moving = len(log.truth.objects)
    # Its rays met in a wrong place ("sizes"), and some crossed another thing ("on an object").
    found = [one for one in result.doubts if one.reason in ("follow", "moves", "sizes", "on an object")]
    assert found == list(result.doubts) != []
    assert all(one.reason == "sizes" for one in found if one.kind == "split")
    rays = np.concatenate([one.rays for one in found])
    assert (result.rays.track_id[rays] == moving).mean() > 0.9
    assert len(rays) > 0.4 * (result.rays.track_id == moving).sum()


@pytest.mark.parametrize(("every", "blames_drift"), [(0.0, True), (1.0, False)])
def test_a_path_that_drifts_is_named_where_a_thing_seems_to_move(every, blames_drift):
    """Between two visits of a thing at rest, odometry alone drifts, which no test of the rays can tell from a motion."""
    number = np.zeros(1, dtype=int)
    groups = SimpleNamespace(
        reason=number + REASONS.index("moves"), label=number, miss=[0.02], sigma=[0.01], way=[0.23], odds=[-0.7]
    )
    result = SimpleNamespace(rays=SimpleNamespace(label_names=("mug",)), keyframes=SimpleNamespace(localized_every=every))
    told = words.why_no_object(result, groups, 0, number)
    assert "moves by 23 cm" in told
    assert ("the path drifted" in told) == blames_drift


def test_a_ghost_at_one_place_of_the_image(rooms):
    rng = np.random.default_rng(0)
    frames = np.flatnonzero(rng.random(len(camera_poses(rooms))) < 0.3)
    boxes = np.array([300.0, 400.0, 360.0, 470.0]) + rng.normal(scale=1.5, size=(len(frames), 4))
    kept = LEAN.model_copy(update={"rays": LEAN.rays.model_copy(update={"robot_parts": False})})
    result = mapped(with_boxes(rooms, frames, boxes, "person"), kept)
    found = only(result)
    assert (found.kind, found.reason, found.label, found.position) == ("boxes", "fixed in the image", "person", None)
    assert len(found.rays) > 0.9 * len(frames)
    assert "pixel (330, 435)" in found.text


def test_a_far_thing_has_no_parallax():
    far = (("tower", (300.0, 15.0, 20.0)),)
    found = only(mapped(simulate(preset("rooms", placed=far, max_range=400.0, false=0.0, objects=6), 0)))
    assert (found.kind, found.reason, found.label) == ("unresolved", "no parallax", "tower")
    assert found.numbers["parallax_deg"] < 3


def test_rays_that_pass_a_place_apart(rooms):
    # A thing that is at another place near (1, 1, 0.8) in each frame. Association takes it as one noisy object.
    rng, place = np.random.default_rng(0), np.array([1.0, 1.0, 0.8])
    places = place + rng.normal(scale=0.15, size=(len(camera_poses(rooms)), 3))
    frames, boxes = boxes_of(rooms, places, 0.1)
    result = mapped(with_boxes(rooms, frames, boxes, "wasp"))
    wasp = result.rays.label == result.rays.label_names.index("wasp")
    others = np.where(wasp, -1, result.association.object)
    kept = np.unique(others[others >= 0])
    found = only(reassociated(result, np.where(others >= 0, np.searchsorted(kept, others), -1)))
    assert (found.kind, found.reason, found.label) == ("boxes", "apart", "wasp")
    assert np.linalg.norm(found.position - place) < 0.2
    assert len(found.rays) > 0.8 * wasp.sum()
    # Of a normal distribution in the plane across a ray, half are within 1.18 standard deviations.
    assert found.numbers["miss_m"] == pytest.approx(1.18 * 0.15, rel=0.2)
    assert "their rays miss a common point by 1" in found.text
    assert found.numbers["miss_m"] > 3 * found.numbers["sigma_m"]


def test_a_thing_that_is_seen_too_rarely(rooms):
    frames, boxes = boxes_of(rooms, np.tile([1.0, 1.0, 0.8], (len(camera_poses(rooms)), 1)), 0.1)
    few = np.linspace(0, len(frames) - 1, 9).astype(int)
    label = rooms.cameras[0].detections.label_names[0]
    found = only(mapped(with_boxes(rooms, frames[few], boxes[few], label)))
    assert (found.kind, found.reason, found.label) == ("boxes", "rare", label)
    assert np.linalg.norm(found.position - [1.0, 1.0, 0.8]) < 0.05
    assert found.numbers["frames"] == len(found.rays) in (8, 9)
    assert found.numbers["frames_expected"] == pytest.approx(len(frames), rel=0.3)


def test_too_few_rays_for_an_object(rooms):
    frames, boxes = boxes_of(rooms, np.tile([1.0, 1.0, 0.8], (len(camera_poses(rooms)), 1)), 0.1)
    few = np.linspace(0, len(frames) - 1, 10).astype(int)
    found = only(mapped(with_boxes(rooms, frames[few], boxes[few], "kite"), with_association(min_rays=12, few_rays=False)))
    assert (found.kind, found.reason, found.label) == ("boxes", "few", "kite")
    assert len(found.rays) in (9, 10)
    assert "association.min_rays 12" in found.text


def test_ranges_that_end_elsewhere():
    result = mapped(simulate(preset("rooms", false=0.0, depth=DepthNoise()), 5))
    ranged = replace(result.rays, range=np.where(result.association.object == 3, 0.6, 1.0) * result.rays.range)
    without = np.where(result.association.object == 3, -1, result.association.object)
    without[without > 3] -= 1
    found = only(reassociated(replace(result, rays=ranged), without))
    assert (found.kind, found.reason) == ("boxes", "range")
    assert np.linalg.norm(found.position - result.map.objects[3].position) < 0.1
    assert set(found.rays) <= set(np.flatnonzero(result.association.object == 3))


def test_boxes_of_another_label_on_an_object():
    log = simulate(preset("rooms", false=0.0, tracks="perfect"), 4)
    ids = log.cameras[0].detections.track_ids
    often = int(np.bincount(ids[ids >= 0]).argmax())
    third = (ids == often) & (np.arange(len(ids)) % 3 == 0)
    result = mapped(relabelled(log, third, "thing"), with_association(fuse_labels=False))
    on = [one for one in result.doubts if one.reason == "on an object"]
    pairs = [one for one in result.doubts if one.kind == "pair"]
    assert len(on) + len(pairs) == len(result.doubts) == 1


def test_a_lost_thing_is_not_excused_by_a_neighbour_that_has_boxes_of_its_own():
    """A ball 12 cm from a cup, within the gate of the cup's rays, is in no object. The frames show both."""
    placed = (("cup", (1.5, -0.06, 0.4)), ("ball", (1.5, 0.06, 0.4)), ("ball", (1.5, 1.3, 0.4)))
    log = simulate(pair(0.12, placed=placed, pixel_sigma=2.0, missed=0.1), 0)
    exact = LEAN.localization.model_copy(update={"xy": 0.003, "yaw": 0.002})
    settings = LEAN.model_copy(update={"rays": LEAN.rays.model_copy(update={"pixel_sigma": 4.0}), "localization": exact})
    result = mapped(log, settings)
    ball = min((o for o in result.map.objects if o.label == "ball"), key=lambda o: abs(o.position[1]))
    j, mine = result.map.objects.index(ball), result.association.object
    found = only(reassociated(result, np.where(mine == j, -1, mine - (mine > j))))
    assert (found.kind, found.reason, found.label) == ("boxes", "unclear", "ball")
    assert found.position == pytest.approx([1.5, 0.06, 0.4], abs=0.02)
    assert len(found.rays) > 0.9 * (mine == j).sum()
    assert found.text.endswith(
        ", and the odds are more than 1000 to 1 for an object, but no search kept one there: a thing may be missing."
    )


def test_the_verdict_says_where_boxes_of_a_thing_are_that_the_map_lacks():
    """One of ten mugs is lost, whose boxes are fewer than a tenth of the boxes of its label."""
    places = [(x, y, 0.4) for y in (1.2, -1.2) for x in (-2.4, -1.2, 0.0, 1.2, 2.4)]
    log = simulate(preset("rooms", objects=0, placed=tuple(("mug", p) for p in places), false=0.0, missed=0.1), 0)
    result = mapped(log)
    number = np.bincount(result.association.object[result.association.object >= 0])
    j = int(np.argsort(number)[3])
    assert len(number) == 10
    assert number[j] < 0.1 * len(result.rays)
    mine = result.association.object
    lacking = reassociated(result, np.where(mine == j, -1, mine - (mine > j)))
    assessment = lacking.summary["assessment"]
    (reason,) = [one for one in assessment["reasons"] if "fit no object" in one]
    assert assessment["level"] == "check"
    x, y, z = (float(v) for v in reason.split("(")[1].split(")")[0].split(","))
    assert np.linalg.norm(np.array([x, y, z]) - result.map.objects[j].position) < 0.05


@pytest.mark.parametrize(("lost", "level"), [(1, "good"), (2, "check")])
def test_a_lost_thing_of_many_is_named_but_does_not_make_the_verdict(lost, level):
    """Of 22 things, one is 5 % and two are 9 %."""
    places = [(x, y, 0.4) for y in (1.2, -1.2) for x in np.linspace(-2.4, 2.4, 11).tolist()]
    placed = tuple((("mug", "bottle")[k % 2], place) for k, place in enumerate(places))
    log = simulate(preset("rooms", objects=0, placed=placed, false=0.0, missed=0.1), 0)
    result = mapped(log)
    assert len(result.map) == 22
    assert result.summary["assessment"]["level"] == "good"
    mine = result.association.object
    number = np.bincount(mine[mine >= 0])
    kept = np.full(22, -1)
    kept[np.sort(np.argsort(-number)[lost:])] = np.arange(22 - lost)
    lacking = reassociated(result, np.where(mine < 0, -1, kept[mine])).summary["assessment"]
    assert lacking["level"] == level
    assert sum("a thing may be missing" in one for one in lacking["reasons"]) == lost
    assert ("agree to within the expected noise" in lacking["reasons"][0]) == (level == "good")


def test_a_good_map_with_doubtful_objects_does_not_praise_them():
    good = {"level": "good", "reasons": ["40 objects, whose boxes agree to within the expected noise.", "A hint."]}
    first, *others = _praised(good, 2, 40)["reasons"]
    assert first == "40 objects, 2 of them doubtful. The boxes of the others agree to within the expected noise."
    assert others == ["A hint."]
    assert _praised(good, 0, 40) == good
    check = {**good, "level": "check"}
    assert _praised(check, 2, 40) == check


def test_why_an_object_has_no_position_is_one_reason():
    result = mapped(simulate(preset("rooms", false=0.0), 3))
    o = replace(result.map.objects[0], parallax_deg=8.0, rays=9, position=np.full(3, np.nan))
    for rms, said, other in ((0.2, "sigma exceeds", "disagree"), (5.0, "disagree", "sigma exceeds")):
        objects = [replace(o, rms_deg=rms), *result.map.objects[1:]]
        told = words.why_unresolved(replace(result, map=replace(result.map, objects=tuple(objects))), 0)
        assert said in told
        assert other not in told
        assert "nan" not in told


def test_an_object_whose_boxes_have_two_sizes():
    """A third of its boxes are of a thing that is half as large."""
    result = clean_rooms("perfect")
    widths = result.rays.box[:, 2] - result.rays.box[:, 0]
    wide = max(range(len(result.map)), key=lambda j: np.median(widths[result.association.object == j]))
    mine = np.flatnonzero(result.association.object == wide)[::3]
    box = result.rays.box.copy()
    middle, half = (box[mine, :2] + box[mine, 2:]) / 2, (box[mine, 2:] - box[mine, :2]) / 4
    box[mine] = np.hstack([middle - half, middle + half])
    assert mixed_sizes(result) == []
    (found,) = mixed_sizes(replace(result, rays=replace(result.rays, box=box)))
    assert (found.kind, found.reason, found.objects) == ("split", "sizes", (result.map.objects[wide].id,))
    # A third of the logarithms is ln 2 less: their standard deviation is ln 2 times the root of 1/3 * 2/3.
    assert found.numbers["size_scatter"] == pytest.approx(np.log(2) * np.sqrt(2) / 3, abs=0.06)
    assert set(mine.tolist()) < set(found.rays.tolist())


@pytest.mark.parametrize(("times", "doubted"), [(1.0, False), (6.0, True)])
def test_the_depth_of_a_flat_thing_scatters_its_height(times: float, doubted: bool) -> None:
    """The boxes of a keyboard, 0.42 m by 0.12 m, are higher from its ends than from its sides, and from near than from afar.
    If a third of them are of a thing that is 6 times as large, the depth does not explain this."""
    result = clean_rooms("perfect")
    mine = np.flatnonzero(result.association.object == 0)
    ray, away = result.directions[mine], np.linalg.norm(result.map.positions[0] - result.origins[mine], axis=1)
    along, across = np.abs(ray[:, :2].T) / np.linalg.norm(ray[:, :2], axis=1)
    sides = np.column_stack([0.42 * across + 0.12 * along, (0.42 * along + 0.12 * across) * np.abs(ray[:, 2]) + 0.01])
    assert np.log(sides).std(axis=0).min() > 1.2 * _LEAST
    sides[::3] *= times
    box, half = result.rays.box.copy(), sides * result.cameras[0].focal / away[:, None] / 2
    middle = (box[mine, :2] + box[mine, 2:]) / 2
    box[mine] = np.hstack([middle - half, middle + half])
    found = mixed_sizes(replace(result, rays=replace(result.rays, box=box)))
    assert [one.objects for one in found] == ([(result.map.objects[0].id,)] if doubted else [])


def test_boxes_that_show_the_vertical_otherwise_tell_no_size():
    """A wrist camera sees a tall thing upright from the side and short from above. A robot's camera sees it alike."""
    result = clean_rooms("perfect")
    mine = np.arange(len(result.rays))
    assert _alike(result, mine[result.association.object >= 0]).all()
    held = np.flatnonzero(result.association.object == 0)
    turned, poses = held[::3], result.map_T_base.copy()
    first = result.rays.keyframe[turned]
    # The camera of these boxes rolls by 60 degrees about the rays, so that each ray stays.
    for k, way in zip(first, result.directions[turned], strict=True):
        poses[k, :3, :3] = Rotation.from_rotvec(np.radians(60) * way).as_matrix() @ poses[k, :3, :3]
    only_these = np.setdiff1d(held[~np.isin(result.rays.keyframe[held], first)], turned)
    both = np.union1d(only_these, turned)
    told = _alike(replace(result, map_T_base=poses), both)
    assert not told[np.isin(both, turned)].any()
    # The mean of both lies 20 degrees from the level boxes: atan(sin 60 / (2 + cos 60)) is 19.1.
    assert told[np.isin(both, only_these)].mean() > 0.5


def test_a_camera_that_observes_no_sizes_tells_none():
    result = clean_rooms()
    mine = np.flatnonzero(result.association.object == 0)
    box = result.rays.box.copy()
    box[mine[::2], 2:] += 4 * (box[mine[::2], 2:] - box[mine[::2], :2])
    odd = replace(result, rays=replace(result.rays, box=box))
    assert len(mixed_sizes(odd)) == 1
    blind = tuple(replace(camera, sees_size=False) for camera in result.cameras)
    assert mixed_sizes(replace(odd, cameras=blind)) == []
