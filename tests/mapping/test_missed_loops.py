"""Loops that an exploration missed, on two laps of which the second has landmarks of its own."""

from dataclasses import replace

import numpy as np
import pytest
from log_parts import without_names
from turning_drive import errors_of

from objslam.config import AssociationSettings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import exp_se3, inverse
from objslam.core.types import Association, Rays
from objslam.mapping.joint.joint_alternation import JointState
from objslam.mapping.moves import missed_loops
from objslam.mapping.moves.missed_loops import largest_copy, largest_copy_in, with_missed_loops
from objslam.simulation import preset, simulate

SLIP = np.array([0.0, 0.0, np.radians(25), 0.3, -0.2, 0.0])
"""What the odometry misses between the laps: a rotation vector, rad, and a way, m."""


@pytest.fixture(scope="module")
def laps():
    """The log of two laps, whose odometry misses a slip between them, its things, and when the second lap begins."""
    places = simulate(preset("demo"), 0).truth.objects
    named = tuple((f"thing_{i}", tuple(one.position.tolist())) for i, one in enumerate(places))
    log = simulate(preset("demo", laps=2, frames=160, false=0.0, objects=0, placed=named), 0)
    poses = log.odometry.poses.copy()
    half = len(poses) // 2
    poses[half:] = poses[half] @ exp_se3(SLIP) @ inverse(poses[half]) @ poses[half:]
    log = replace(log, localization=None, odometry=replace(log.odometry, poses=poses))
    return log, len(log.truth.objects), log.odometry.stamps[half]


def solved(laps, *, apart):
    """The state with the true things. apart: each thing is another one in the second lap."""
    log, _, between = laps
    named, errors = errors_of(log), errors_of(without_names(log))
    things = named.rays.label
    second = errors.keyframes.stamps[errors.rays.keyframe] > between
    _, owner = np.unique(things + 100 * second if apart else things, return_inverse=True)
    of_log = errors.keyframes, errors.rays
    cameras = tuple(one.camera for one in log.cameras)
    state = JointState(*of_log, *of_log, cameras, errors.settings, Ledger(), lambda *_: None, None, errors)
    return state.solve("labels", Association(owner, np.zeros(owner.max() + 1, dtype=np.int64)))


def test_the_laps_come_together(laps):
    _, things, _ = laps
    state = solved(laps, apart=True)
    assert state.association.count > 1.5 * things
    found = with_missed_loops(state)
    assert found.association.count == things
    assert found.explained > state.explained
    same = solved(laps, apart=False).association.object
    pairs = np.unique(np.stack([same, found.association.object])[:, found.agree], axis=1)
    assert pairs.shape[1] == things  # Each thing is one object.


def test_laps_come_together_if_no_single_closure_explains_more(laps, monkeypatch):
    """Rays of a later visit that belong to wrong landmarks of an earlier one fit only the bent path."""
    monkeypatch.setattr(missed_loops, "_with_a_loop", lambda state, solved: None)
    _, things, _ = laps
    state = solved(laps, apart=True)
    found = with_missed_loops(state)
    assert found.association.count == things
    assert found.explained > state.explained
    alone = solved(laps, apart=False)
    assert with_missed_loops(alone) is alone


def test_no_closure_of_a_state_is_solved_twice(laps, monkeypatch):
    """The closures that alone explain less are tried together, and most of them are those that were tried alone."""
    solved_ones, of, as_measured = [], missed_loops._solved, JointState.explained.fget

    def counted(state, closure, landmarks):
        solved_ones.append((state.association.object.tobytes(), closure.now.tobytes(), closure.before.tobytes()))
        return of(state, closure, landmarks)

    monkeypatch.setattr(missed_loops, "_solved", counted)
    # Each closure seems to explain less.
    monkeypatch.setattr(JointState, "explained", property(lambda state: as_measured(state) - 1e4 * len(state.rounds)))
    with_missed_loops(solved(laps, apart=True))
    assert len(solved_ones) >= 2
    assert len(set(solved_ones)) == len(solved_ones)


@pytest.mark.parametrize("apart", [True, False])
def test_copies_of_the_first_lap_are_noticed(laps, apart):
    """All rays agree with the map that has the things of each lap at other places."""
    state = solved(laps, apart=apart)
    assert state.agree.mean() > 0.95
    copied = largest_copy_in(state)
    assert copied > 5 if apart else copied == 0


def test_a_map_without_missed_loops_stays(laps):
    state = solved(laps, apart=False)
    assert with_missed_loops(state) is state


def test_trees_that_stand_by_chance_like_others_are_no_copies():
    """A robot drives through a wood in five lanes, with ranges. It sees each tree once, for twenty frames.

    There are many trees and many places, so fifteen of them stand like others, with log odds of 10.5 in one search."""
    trees, size, seen = 100, 200.0, 20
    place = np.random.default_rng(3).uniform(0.0, size, (trees, 2))
    path = np.tile(np.eye(4), (5 * int(size), 1, 1))
    lane, along = np.divmod(np.arange(len(path)), int(size))
    path[:, 0, 3] = np.where(lane % 2, size - along, along)
    path[:, 1, 3] = (lane + 0.5) * size / 5
    nearest = np.linalg.norm(place[:, None] - path[:, :2, 3], axis=2).argmin(axis=1)
    keyframe = np.clip(nearest[:, None] + np.arange(seen) - seen // 2, 0, len(path) - 1).ravel()
    order = np.argsort(keyframe, kind="stable")
    keyframe, owner = keyframe[order], np.repeat(np.arange(trees), seen)[order]
    way = np.pad(place[owner] - path[keyframe, :2, 3], ((0, 0), (0, 1)))
    distance, every = np.linalg.norm(way, axis=1), np.ones(len(keyframe))
    label = np.zeros(len(keyframe), dtype=np.int64)
    rays = Rays(
        keyframe,
        way / distance[:, None],
        0.01 * every,
        distance,
        0.5 * every,
        0.0 * every,
        label,
        every,
        np.zeros((len(keyframe), 4)),
        label - 1,
        ("tree",),
    )
    of_tree = Association(owner, np.zeros(trees, dtype=np.int64))
    assert largest_copy(rays, of_tree, np.pad(place, ((0, 0), (0, 1))), path, AssociationSettings()) == 0
