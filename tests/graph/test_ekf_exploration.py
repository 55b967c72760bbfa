"""Exploration without names, from odometry that drifts."""

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors
from objslam.graph.ekf_exploration import explore, is_sure
from objslam.mapping.solution import seen_something
from objslam.simulation import preset, simulate

SETTINGS = load_settings(None, ("mode=joint", "rays.pixel_sigma=3"))


def drive(seed, frames=600, shift=0.0, **boxes):
    """Keyframes, rays without names, their objects, errors. 20 objects, at 5 Hz, from odometry that drifts."""
    room = {"room": (12.0, 9.0), "objects": 20, "classes": 20, "min_view_share": 0.01}
    noise = {"pixel_sigma": 3.0, "false": 0.0, "localization": None, "odometry": Odometry(), "depth": {}} | boxes
    log = simulate(preset("demo", frames=frames, frame_rate=5.0, **room, **noise), seed)
    if shift:
        cameras = tuple(
            replace(c, detections=replace(c.detections, frame_stamps=c.detections.frame_stamps + shift)) for c in log.cameras
        )
        odometry = replace(log.odometry, stamps=log.odometry.stamps + shift)
        log = replace(log, cameras=cameras, odometry=odometry)
    frames_of = build_keyframes(log, SETTINGS, Ledger())
    keyframes, rays = seen_something(frames_of, build_rays(log, frames_of, SETTINGS, Ledger()))
    truth = rays.label
    rays = replace(rays, label=np.zeros_like(truth), label_names=("thing",))
    return keyframes, rays, truth, shared_errors(log, keyframes, rays, SETTINGS)


def explored(seed, **changes):
    keyframes, rays, truth, errors = drive(seed, **changes)
    return explore(keyframes, rays, SETTINGS, lambda done, total: None, errors), truth


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_every_object_is_one_landmark(seed):
    """With depths of 2 % noise, all objects called the same."""
    start, truth = explored(seed)
    held = start.association.object >= 0
    table = np.zeros((start.association.count, truth.max() + 1), dtype=int)
    np.add.at(table, (start.association.object[held], truth[held]), 1)
    assert is_sure(start)
    assert table.max(axis=1).sum() >= 0.99 * held.sum()  # a landmark has the rays of one object
    many = table[:, np.bincount(truth) >= 20]
    assert ((many >= 10).sum(axis=0) == 1).all()  # an object has one landmark


def test_what_the_filter_cannot_tell_is_not_sure():
    """Two of three boxes are false, in every frame."""
    start, _ = explored(0, frames=200, false=0.2, missed=0.2)
    assert not is_sure(start)


def test_an_exploration_that_cannot_be_sure_ends_early():
    """It ends when more rays have no landmark than a sure exploration leaves."""
    keyframes, rays, _, errors = drive(0, frames=200, false=0.2, missed=0.2)
    done = []
    start = explore(keyframes, rays, SETTINGS, lambda number, _: done.append(number), errors)
    assert not is_sure(start)
    assert done[-1] < 0.9 * len(keyframes)
    later = rays.keyframe >= done[-1]
    assert (start.association.object[later] < 0).all()
    assert (start.association.object[~later] < 0).sum() > 0.2 * len(rays)


def test_rounding_of_stamps_changes_nothing():
    """Stamps of 1.7e9 s are multiples of 2.4e-7 s, so a shift that is none rounds each of them in another way."""
    one, _ = explored(0, frames=300)
    other, _ = explored(0, frames=300, shift=1 / 3)
    np.testing.assert_array_equal(one.association.object, other.association.object)
