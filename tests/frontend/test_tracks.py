"""Tracks of boxes in images that follow each other, of which a detector misses some."""

from types import SimpleNamespace

import numpy as np
import pytest

from objslam.core.types import Rays
from objslam.frontend.tracks import associate_tracks

AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def rays_of(keyframe, direction, label, ranges=None):
    """Rays with what tracks need."""
    count = len(keyframe)
    unknown, zero = np.full(count, np.nan), np.zeros(count, dtype=np.int64)
    ranges = unknown if ranges is None else ranges
    boxes = np.full((count, 4), np.nan)
    return Rays(keyframe, direction, unknown, ranges, unknown, unknown, label, unknown, boxes, zero, ("a", "b"))


def tracks(keyframe, angle, label=None, *, turn=0.0, step=0.1):
    """The tracks of rays to things at angles (rad) ahead. A robot turns by `turn` (rad) in each step (s)."""
    keyframe, number = np.array(keyframe), int(np.max(keyframe)) + 1
    yaw = turn * np.arange(number)
    poses = np.tile(np.eye(4), (number, 1, 1))
    poses[:, :2, :2] = np.moveaxis(np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]), 2, 0)
    mount = np.eye(4)
    mount[:3, :3] = AHEAD
    stamps, camera = step * np.arange(number), np.zeros(number, dtype=np.int64)
    keyframes = SimpleNamespace(
        stamps=stamps, camera=camera, odom_T_base=poses, base_T_camera=np.tile(mount, (number, 1, 1))
    )
    local = np.array(angle) - yaw[keyframe]
    direction = np.stack([np.cos(local), np.sin(local), np.zeros(len(local))], axis=1) @ AHEAD
    label = np.zeros(len(keyframe), dtype=np.int64) if label is None else np.array(label)
    return associate_tracks(keyframes, rays_of(keyframe, direction, label)).object.tolist()


def test_each_thing_is_a_track_while_the_robot_turns():
    keyframe, angle = np.repeat(np.arange(5), 2), np.tile([0.1, -0.4], 5)
    assert tracks(keyframe, angle, turn=0.15) == [0, 1] * 5


@pytest.mark.parametrize(
    ("missed", "step", "linked"),
    [([2], 0.1, True), ([2, 3], 0.1, True), ([1, 2, 3], 0.1, False), ([1, 3], 0.24, True), ([1, 3], 0.26, False)],
)
def test_boxes_that_the_detector_misses_end_no_track(missed, step, linked):
    """The other thing tells that there were images. A track goes on from three images before, if this is half a second."""
    images = np.arange(6)
    one = np.delete(images, missed)
    keyframe = np.concatenate([one, images])
    angle = np.concatenate([np.full(len(one), 0.3), np.full(len(images), -0.3)])
    order = np.argsort(keyframe, kind="stable")
    found = np.empty(len(order), dtype=np.int64)
    found[order] = tracks(keyframe[order], angle[order], step=step)
    mine, other = found[: len(one)], found[len(one) :]
    assert len(set(mine.tolist())) == len(set(other.tolist())) == 1
    assert (mine[0] >= 0) == linked
    assert other[0] >= 0
    assert mine[0] != other[0]


def test_things_of_two_labels_and_far_angles_are_not_joined():
    assert tracks([0, 1, 2], [0.0, 0.0, 0.0], [0, 1, 0]) == [-1, -1, -1]
    assert tracks([0, 1, 2], [0.0, 0.2, 0.4]) == [-1, -1, -1]


def test_images_that_are_too_far_apart_in_time_are_not_joined():
    assert tracks([0, 1, 2], [0.0, 0.0, 0.0], step=0.9) == [0, 0, 0]
    assert tracks([0, 1, 2], [0.0, 0.0, 0.0], step=1.1) == [-1, -1, -1]


@pytest.mark.parametrize(("known", "wrong"), [(1.0, 0.001), (0.5, 0.1)])
def test_ranges_tell_where_equal_things_beside_the_robot_go(known, wrong):
    """A robot drives past tags 0.4 m from each other, and they move on by half their distance from image to image."""
    rng = np.random.default_rng(0)
    tags = np.array([[0.4 * i, 1.5, z] for i in range(20) for z in (0.5, 1.1)])
    places = np.array([[0.2 * k, 0.0, 0.8] for k in range(40)])
    to = tags - places[:, None]
    keyframe, thing = np.nonzero(np.abs(to[..., 0]) < 1.0)
    to = to[keyframe, thing]
    distance = np.linalg.norm(to, axis=1)
    direction = to / distance[:, None] + rng.normal(0, 0.005, to.shape)
    ranges = np.where(rng.random(len(to)) < known, distance + rng.normal(0, 0.03, len(to)), np.nan)
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    keyframes = SimpleNamespace(
        stamps=0.25 * np.arange(len(places)),
        camera=np.zeros(len(places), dtype=np.int64),
        odom_T_base=poses,
        base_T_camera=np.tile(np.eye(4), (len(places), 1, 1)),
    )
    rays = rays_of(keyframe, direction / np.linalg.norm(direction, axis=1)[:, None], np.zeros_like(thing), ranges)
    owner = associate_tracks(keyframes, rays).object
    order = np.lexsort((keyframe, owner))
    follow = (np.diff(owner[order]) == 0) & (owner[order][1:] >= 0)
    assert follow.sum() > 0.8 * known * len(to)
    assert (np.diff(thing[order])[follow] != 0).mean() < wrong


@pytest.mark.parametrize(("sway", "joined"), [(0.0, False), (1.5, True)])
def test_a_robot_that_sways_has_a_wider_gate(sway, joined):
    """A robot at rest sees two things with ranges. At half time, one of them seems to step aside by 4 or 5.5 degrees.

    A robot that sways by 1.5 degrees from image to image may see such a step. To a robot on wheels, it is another thing."""
    step = np.radians(5.5)
    keyframe = np.repeat(np.arange(20), 2)
    sways = np.radians(sway) * np.where(np.arange(20) % 2, 1.0, -1.0)[keyframe] / 2
    angle = np.tile([0.0, 1.0], 20) + sways + np.where((keyframe >= 10) & (np.arange(40) % 2 == 0), step, 0.0)
    direction = np.stack([np.cos(angle), np.sin(angle), np.zeros(40)], axis=1)
    poses = np.tile(np.eye(4), (20, 1, 1))
    keyframes = SimpleNamespace(
        stamps=0.1 * np.arange(20), camera=np.zeros(20, dtype=np.int64), odom_T_base=poses, base_T_camera=poses
    )
    label = np.zeros(40, dtype=np.int64)
    owner = associate_tracks(keyframes, rays_of(keyframe, direction, label, np.full(40, 3.0))).object
    assert len(set(owner[::2].tolist())) == (1 if joined else 2)
    assert len(set(owner[1::2].tolist())) == 1
