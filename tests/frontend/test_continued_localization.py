"""The odometry continues a localisation: against the true path, at gaps of the odometry, and where it drifts too far."""

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate, lift_se2
from objslam.core.statistics import Lasting
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.localization.continued_localization import (
    bridged,
    continued_by_odometry,
    share_on_continuation,
    without_short_localization,
)
from objslam.graph.factors.localization import localization_covariance, localized, localized_motions
from objslam.simulation import preset, simulate

SETTINGS = load_settings(None, ("mode=joint",))
ODOM = lift_se2(np.array([[3.0, -2.0, 1.0]]))[0]
"""The pose of the map in the frame of the odometry."""


def drive(keep) -> tuple[Log, Trajectory]:
    """An arc of 20 s with exact poses, whose odometry has a frame of its own. keep: which seconds have a localisation."""
    t = np.linspace(0.0, 20.0, 201)
    true = lift_se2(np.column_stack([2 * np.sin(t / 20), 2 * (1 - np.cos(t / 20)), t / 20]))
    made = simulate(preset("demo"), 0)
    camera = replace(made.cameras[0], rgb=None)
    found = camera.detections
    frames = np.linspace(0.05, 19.95, len(found.frame_stamps))
    camera = replace(camera, detections=replace(found, frame_stamps=frames))
    kept = keep(t)
    path = Trajectory(t, true)
    return replace(
        made, cameras=(camera,), odometry=Trajectory(t, ODOM @ true), localization=Trajectory(t[kept], true[kept])
    ), path


@pytest.mark.parametrize(
    "keep", [lambda t: t > 8, lambda t: t < 12, lambda t: (t < 5) | (t > 12), lambda t: (t > 3) & (t < 17)]
)
def test_continued_poses_lie_on_the_true_path(keep):
    log, path = drive(keep)
    found = continued_by_odometry(log, SETTINGS).localization
    np.testing.assert_allclose(found.stamps, path.stamps)
    np.testing.assert_allclose(found.poses, path.poses, atol=1e-9)


def test_a_gap_of_the_odometry_ends_the_continuation():
    log, path = drive(lambda t: t > 8)
    whole = (path.stamps < 3) | (path.stamps > 5)
    log = replace(log, odometry=Trajectory(path.stamps[whole], ODOM @ path.poses[whole]))
    assert continued_by_odometry(log, SETTINGS).localization.stamps[0] == pytest.approx(5.1)


def test_both_sides_of_a_gap_of_the_odometry_follow_their_own_end():
    """Somebody restarts the odometry in its gap, while the localisation pauses."""
    log, path = drive(lambda t: (t < 5) | (t > 12))
    t = path.stamps
    later = t > 9
    odometry = np.where(later[:, None, None], path.poses, ODOM @ path.poses)
    whole = (t < 7) | later
    log = replace(log, odometry=Trajectory(t[whole], odometry[whole]))
    found = continued_by_odometry(log, SETTINGS).localization
    np.testing.assert_allclose(found.stamps, t[whole])
    np.testing.assert_allclose(found.poses, path.poses[whole], atol=1e-9)


def test_drift_ends_the_continuation():
    log, _ = drive(lambda t: t > 8)
    noisy = load_settings(None, ("mode=joint", "odometry.yaw_per_m=0.3", "odometry.yaw_per_rad=0"))
    begin = continued_by_odometry(log, noisy).localization.stamps[0]
    # The way has 0.1 m in each second, so the heading has drifted by 0.15 rad after 0.25 m.
    assert begin == pytest.approx(8.1 - 2.5, abs=0.11)


@pytest.mark.parametrize("keep", [lambda t: t >= 0, lambda t: t > 15])
def test_nothing_is_continued_if_the_localisation_is_whole_or_too_short(keep):
    log, _ = drive(keep)
    assert continued_by_odometry(log, SETTINGS) is log
    assert share_on_continuation(log, log, SETTINGS) == 0


def test_continued_keyframes_have_no_localisation():
    log, _ = drive(lambda t: t > 8)
    continued = continued_by_odometry(log, SETTINGS)
    frames = build_keyframes(continued, SETTINGS, Ledger(), log.localization)
    assert len(frames) == len(log.cameras[0].detections.frame_stamps)
    measured = localized(frames)
    np.testing.assert_array_equal(np.isfinite(frames.localized_at), frames.stamps >= 8.1)
    at = np.unique(frames.localized_at[np.isfinite(frames.localized_at)])  # Ten poses a second, and twenty frames.
    np.testing.assert_array_equal(frames.localized_at[measured], at)
    assert np.abs(frames.stamps[measured] - at).max() < 0.05
    covariance = localization_covariance(frames, SETTINGS)
    sigma = np.sqrt(np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2))
    assert np.delete(sigma, measured).min() > 1e3
    assert sigma[measured].max() < 1
    lasting = replace(frames, lasting=(Lasting(1.0, 5.0), Lasting(1.0, 5.0)))
    motions = localized_motions(lasting, SETTINGS)
    np.testing.assert_array_equal(motions.before, measured[:-1])
    np.testing.assert_array_equal(motions.after, measured[1:])
    smallest = np.sqrt(np.linalg.eigvalsh(motions.covariance)[:, 0])  # Tilt and height are untold anyway.
    assert smallest.max() < 0.1
    assert share_on_continuation(log, continued, SETTINGS) == pytest.approx(0.4, abs=0.1)


def rare(every: float) -> tuple[Log, Trajectory]:
    """The drive with a localised pose each `every` s, as AMCL gives them."""
    log, path = drive(lambda t: np.isclose(t % every, 0.0) | np.isclose(t % every, every))
    assert np.diff(log.localization.stamps) == pytest.approx(every)
    return log, path


@pytest.mark.parametrize("every", [2.0, 5.0])
def test_the_odometry_bridges_a_rare_localisation(every):
    """Most boxes lie between two measurements, so they are used although their share is large."""
    log, path = rare(every)
    found = continued_by_odometry(log, SETTINGS).localization
    np.testing.assert_allclose(found.stamps, path.stamps)
    np.testing.assert_allclose(found.poses, path.poses, atol=1e-9)
    assert share_on_continuation(log, replace(log, localization=found), SETTINGS) > 0.9


def test_each_rare_measurement_counts_once_and_at_the_nearest_keyframe():
    log, _ = rare(2.0)
    frames = build_keyframes(continued_by_odometry(log, SETTINGS), SETTINGS, Ledger(), log.localization)
    assert np.isfinite(frames.localized_at).all()
    measured = localized(frames)
    np.testing.assert_allclose(frames.localized_at[measured], log.localization.stamps)
    assert np.abs(frames.stamps[measured] - log.localization.stamps).max() < 0.06
    far = np.abs(frames.stamps - frames.localized_at) > 0.5
    assert (frames.carried[far] > 0).all()
    assert frames.localized_every == pytest.approx(len(frames) / 9)  # The first and the last lie outside of the frames.


def test_stamps_are_bridged_only_between_two_measurements_that_the_odometry_joins():
    log, path = drive(lambda t: (np.abs(t - 5) < 0.01) | (np.abs(t - 12) < 0.01))
    stamps = np.array([4.0, 5.1, 6.0, 11.0, 13.0])
    np.testing.assert_array_equal(
        bridged(log.localization, log.odometry, stamps, SETTINGS), [False, True, True, True, False]
    )
    whole = (path.stamps < 7) | (path.stamps > 9)
    broken = Trajectory(path.stamps[whole], path.poses[whole])
    assert not bridged(log.localization, broken, stamps[2:], SETTINGS).any()
    noisy = load_settings(None, ("mode=joint", "odometry.yaw_per_m=1.0"))
    np.testing.assert_array_equal(bridged(log.localization, log.odometry, np.array([5.1, 8.5]), noisy), [True, False])


@pytest.mark.parametrize("keep", [lambda t: t < 6, lambda t: np.abs(t - 9) < 0.11])
def test_a_localisation_of_few_boxes_is_left_out(keep):
    log, _ = drive(keep)
    assert without_short_localization(log, SETTINGS).localization is None
    assert without_short_localization(replace(log, odometry=None), SETTINGS).localization is not None


@pytest.mark.parametrize("keep", [lambda t: t < 14, lambda t: t > 8, lambda t: np.isclose(t % 4, 0.0)])
def test_a_localisation_that_the_odometry_completes_is_used(keep):
    log, _ = drive(keep)
    assert without_short_localization(log, SETTINGS) is log


def test_a_lone_pose_gives_the_map_its_frame():
    """As a constant transform from map to odom, which a session gets once."""
    log, path = drive(lambda t: np.abs(t - 9) < 0.01)
    continued = continued_by_odometry(log, SETTINGS, whole=True)
    assert continued.localization.stamps[[0, -1]] == pytest.approx(path.stamps[[0, -1]])
    frames = build_keyframes(continued, SETTINGS, Ledger(), log.localization)
    near = np.isfinite(frames.localized_at)
    np.testing.assert_array_equal(near, np.abs(frames.stamps - 9) <= 1.1)
    (measured,) = localized(frames)
    assert frames.stamps[measured] == pytest.approx(9.0, abs=0.03)
    true, _ = interpolate(path.stamps, path.poses, frames.stamps, 1.0)
    np.testing.assert_allclose(frames.map_T_base, true, atol=1e-9)
