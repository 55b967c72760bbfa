"""Tracks of boxes in images that follow each other, of which a detector misses some."""

from types import SimpleNamespace

import numpy as np
import pytest

from objslam.frontend.tracks import associate_tracks

AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def seen(keyframe, angle, label=None, *, turn=0.0, step=0.1):
    """Keyframes of a robot that turns by `turn` (rad) in each step (s), and rays to things at angles (rad) ahead."""
    keyframe, number = np.array(keyframe), int(np.max(keyframe)) + 1
    yaw = turn * np.arange(number)
    poses = np.tile(np.eye(4), (number, 1, 1))
    poses[:, :2, :2] = np.moveaxis(np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]), 2, 0)
    mount = np.eye(4)
    mount[:3, :3] = AHEAD
    keyframes = SimpleNamespace(
        stamps=step * np.arange(number),
        camera=np.zeros(number, dtype=np.int64),
        odom_T_base=poses,
        base_T_camera=np.tile(mount, (number, 1, 1)),
    )
    local = np.array(angle) - yaw[keyframe]
    direction = np.stack([np.cos(local), np.sin(local), np.zeros(len(local))], axis=1) @ AHEAD
    label = np.zeros(len(keyframe), dtype=np.int64) if label is None else np.array(label)
    return keyframes, SimpleNamespace(keyframe=keyframe, direction=direction, label=label, __len__=None)


class Rays(SimpleNamespace):
    def __len__(self):
        return len(self.keyframe)


def tracks(*given, **options):
    keyframes, rays = seen(*given, **options)
    return associate_tracks(keyframes, Rays(**{k: v for k, v in vars(rays).items() if k != "__len__"})).object.tolist()


def test_each_thing_is_a_track_while_the_robot_turns():
    keyframe, angle = np.repeat(np.arange(5), 2), np.tile([0.1, -0.4], 5)
    assert tracks(keyframe, angle, turn=0.15) == [0, 1] * 5


@pytest.mark.parametrize(("missed", "expected"), [([2], [0] * 5), ([2, 3], [0] * 4), ([1, 2, 3], [-1] * 3)])
def test_boxes_that_the_detector_misses_end_no_track(missed, expected):
    """The other thing tells that there were images. The image three before is the last that counts."""
    images = np.arange(6)
    one, other = np.delete(images, missed), images
    keyframe = np.concatenate([one, other])
    angle = np.concatenate([np.full(len(one), 0.3), np.full(6, -0.3)])
    order = np.argsort(keyframe, kind="stable")
    found = np.array(tracks(keyframe[order], angle[order]))[np.argsort(order, kind="stable")]
    mine = found[: len(one)]
    assert len(set(mine.tolist())) == 1
    assert (mine >= 0).all() == (expected[0] == 0)
    assert (found[len(one) :] >= 0).all()
    assert mine[0] not in found[len(one) :]


def test_things_of_two_labels_and_far_angles_are_not_joined():
    assert tracks([0, 1, 2], [0.0, 0.0, 0.0], [0, 1, 0]) == [-1, -1, -1]
    assert tracks([0, 1, 2], [0.0, 0.2, 0.4]) == [-1, -1, -1]


def test_images_that_are_too_far_apart_in_time_are_not_joined():
    assert tracks([0, 1, 2], [0.0, 0.0, 0.0], step=0.9) == [0, 0, 0]
    assert tracks([0, 1, 2], [0.0, 0.0, 0.0], step=1.1) == [-1, -1, -1]
