"""Keyframes whose poses come from rarer measurements of a localisation, against the poses that were drawn."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse, lift_se2, split_se2
from objslam.core.statistics import Lasting
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors
from objslam.graph.factors.localization import localization_covariance, localized, localized_motions
from objslam.simulation import preset, simulate

SETTINGS = load_settings(None, ("mode=joint",))
T = np.linspace(0.0, 20.0, 401)
TURN = 1.05
"""The odometry turns by this factor too far."""


def drive(every: float, follows: bool, noise: float = 0.02, turn: float = TURN) -> tuple[Log, Trajectory, Trajectory]:
    """A drive on a curve, whose localisation has one error of x, y and yaw, `noise` (m, rad), every `every` s.

    follows: whether the odometry carries the localisation on, as AMCL does in tf. If not, it has poses at its corrections
    alone. Also returns the true path, and the localisation at its corrections.
    """
    w = 0.4 + 0.3 * np.sin(T)
    yaw = np.cumsum(w) * (T[1] - T[0])

    def path(headings):
        steps = 0.5 * np.diff(T, prepend=0.0)
        return lift_se2(
            np.column_stack([np.cumsum(steps * np.cos(headings)), np.cumsum(steps * np.sin(headings)), headings])
        )

    true, odom = path(yaw), path(turn * yaw)
    at = np.flatnonzero(np.diff(np.floor(T / every), prepend=-1.0))
    moved = lift_se2(noise * np.random.default_rng(0).standard_normal((len(at), 3)))
    said = true[at] @ moved
    corrected = Trajectory(T[at], said)
    last = np.searchsorted(at, np.arange(len(T)), side="right") - 1
    whole = Trajectory(T, (said @ inverse(odom[at]))[last] @ odom)
    made = simulate(preset("demo"), 0)
    found = made.cameras[0].detections
    stamps = np.linspace(0.03, 19.97, len(found.frame_stamps))
    camera = replace(made.cameras[0], rgb=None, detections=replace(found, frame_stamps=stamps))
    log = replace(made, cameras=(camera,), odometry=Trajectory(T, odom), localization=whole if follows else corrected)
    return log, Trajectory(T, true), corrected


def frames_of(log: Log):
    return build_keyframes(log, SETTINGS, Ledger())


@pytest.mark.parametrize("every", [0.4, 1.0])
def test_a_localisation_that_follows_the_odometry_counts_once_for_each_correction(every):
    log, _, corrected = drive(every, follows=True)
    frames = frames_of(log)
    measured = localized(frames)
    assert_array_equal(frames.localized_at[measured], corrected.stamps)
    assert np.abs(frames.stamps - frames.localized_at).max() < every / 2 + 0.06  # After the last correction it is more.
    sigma = np.sqrt(localization_covariance(frames, SETTINGS)[:, 3:, 3:].trace(axis1=1, axis2=2))
    assert sigma[measured].max() < 0.1
    assert np.delete(sigma, measured).min() > 1e3
    assert localized_motions(frames, SETTINGS) is None


@pytest.mark.parametrize("clock", [-0.15, 0.02, 0.15])
def test_a_clock_does_not_change_which_keyframes_count_as_localised(clock):
    """Otherwise, the motions of a graph would have other poses at each value of the clock."""
    log, _, _ = drive(0.4, follows=True)
    frames = frames_of(log)
    errors = shared_errors(log, frames, build_rays(log, frames, SETTINGS, Ledger()), SETTINGS)
    values = errors.mean.copy()
    values[errors.names.index(f"{log.cameras[0].camera.name}.clock")] = clock
    moved, _, _ = errors.at(values)
    assert np.abs(moved.stamps - frames.stamps - clock)[5:-5].max() < 1e-9
    assert_array_equal(localized(moved), localized(frames))
    again, _, _ = errors.take(moved, errors.rays).at(values)
    assert_array_equal(again.frame_stamps, frames.stamps)


def test_amcl_by_tf_gives_the_same_keyframes_as_its_poses_alone():
    frames, others = (frames_of(drive(0.4, follows)[0]) for follows in (True, False))
    both = np.searchsorted(frames.stamps, others.stamps)  # The poses alone end before the log.
    assert_array_equal(frames.stamps[both], others.stamps)
    assert_array_equal(frames.localized_at[both], others.localized_at)
    assert_allclose(frames.map_T_base[both], others.map_T_base, atol=1e-9)
    assert_allclose(frames.carried[both], others.carried, rtol=1e-9)
    assert_array_equal(both[localized(others)], localized(frames.take(both)))


def test_the_corrected_odometry_carries_a_measurement():
    """With the true scale of its turns, a pose between two corrections has the error of the correction alone."""
    log, true, corrected = drive(1.0, follows=True)
    frames = frames_of(log)
    errors = shared_errors(log, frames, build_rays(log, frames, SETTINGS, Ledger()), SETTINGS)
    index = errors.names.index("odometry.turn_scale")
    values = np.zeros(len(errors.names))
    values[index] = 1 / TURN - 1
    off = {}
    for name, at in (("raw", np.zeros(len(values))), ("corrected", values)):
        keyframes, _, _ = errors.at(at)
        last = np.searchsorted(corrected.stamps, keyframes.localized_at)
        error = inverse(true.poses[np.searchsorted(T, corrected.stamps)]) @ corrected.poses
        heading = split_se2(keyframes.map_T_base)[0][:, 2] - split_se2(error)[0][last, 2]
        expected = np.interp(keyframes.stamps, T, np.unwrap(split_se2(true.poses)[0][:, 2]))
        off[name] = np.abs((heading - expected + np.pi) % (2 * np.pi) - np.pi).max()
    assert off["raw"] > 0.01
    assert off["corrected"] < 2e-3


def test_the_odometry_adds_its_noise_on_the_way_from_the_measurement():
    """Against the settings: its variance grows with the way and the turn."""
    log, _, _ = drive(1.0, follows=True)
    frames, of = frames_of(log), SETTINGS.odometry
    here, there = frames.stamps, frames.localized_at
    heading = np.unwrap(split_se2(log.odometry.poses)[0][:, 2])
    turned, way = np.abs(np.interp(here, T, heading) - np.interp(there, T, heading)), 0.5 * np.abs(here - there)
    assert_allclose(frames.carried[:, 0], of.yaw_per_m**2 * way + of.yaw_per_rad**2 * turned, rtol=0.01, atol=1e-12)
    aside = (of.x_per_m**2 + of.y_per_m**2) / 2 * way + of.xy_per_rad**2 * turned
    assert (frames.carried[:, 1] >= 0.99 * aside).all()  # The heading that errs adds to it.
    assert frames.carried[:, 1].max() < 1.5 * aside.max()


@pytest.mark.parametrize("kind", ["every pose is new", "the odometry itself", "no odometry"])
def test_each_pose_is_a_measurement_unless_the_odometry_carries_it(kind):
    log, true, _ = drive(0.4, follows=True)
    if kind == "every pose is new":
        noise = lift_se2(0.01 * np.random.default_rng(1).standard_normal((len(T), 3)))
        log = replace(log, localization=Trajectory(T, true.poses @ noise))
    elif kind == "the odometry itself":
        log = replace(log, localization=log.odometry)
    else:
        log = replace(log, odometry=None)
    frames = frames_of(log)
    assert frames.localized_at is None
    assert_array_equal(localized(frames), np.arange(len(frames)))


def test_a_gap_of_the_odometry_ends_what_a_measurement_gives():
    log, _, _ = drive(0.4, follows=False)
    whole = (T < 8.0) | (T > 9.5)
    frames = frames_of(replace(log, odometry=Trajectory(T[whole], log.odometry.poses[whole])))
    assert (frames.localized_at[frames.stamps < 8.0] < 8.0).all()
    assert (frames.localized_at[frames.stamps > 9.5] > 9.5).all()


def test_keyframes_that_the_odometry_alone_gave_poses_have_no_localisation():
    frames = frames_of(drive(0.4, follows=True)[0])
    alone = replace(frames, localized_at=np.full(len(frames), np.nan), carried=np.zeros((len(frames), 2)))
    alone = replace(alone, lasting=(Lasting(1.0, 5.0), Lasting(1.0, 5.0)))
    assert np.sqrt(localization_covariance(alone, SETTINGS)[:, 5, 5]).min() > 100
    assert len(localized_motions(alone, SETTINGS).before) == 0
