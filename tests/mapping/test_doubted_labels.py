"""Whether a label names one thing, on drives with a turn on the spot, where a bent path brings two things to one place."""

from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

from objslam.association.nearest_neighbour import associate_by_label
from objslam.config import load_settings
from objslam.core.camera import project
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse, lift_se2
from objslam.core.noise import NoiseFactors
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Keyframes, Log, Rays, Truth, TruthObject
from objslam.errors import SolveError
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.mapping import joint_solve, pipeline
from objslam.mapping.checks.agreement import agreement, bounded_part
from objslam.mapping.checks.diagnosis import diagnose
from objslam.mapping.joint.doubted_labels import doubted_labels, unchecked_labels
from objslam.simulation import make_camera

LAMP = ("lamp", 1.2, 3.5, 1.2)
FIRST, SECOND = ("mug", 4.2, 1.0, 0.7), ("mug", 0.5, 6.0, 0.9)
ALL_NAMED = ("lamp", "chair", "bin", "box")
SETTINGS = load_settings(None, ("output.recording=false", "checks.use=false", "bodies.use=false", "calibration.use=false"))
"""Without what does not decide how many things have a label: the noise does."""


def turning_drive(things, turn_error: float = 0.01) -> Log:
    """3 m ahead, 90 degrees to the left on the spot, 4 m ahead. The camera looks 45 degrees to the left, and down.

    things: label, x, y and z, m. turn_error: the share by which the odometry turns too far.
    """
    rng = np.random.default_rng(5)

    def path(t):
        return np.column_stack(
            [np.interp(t, [0, 15], [0, 3]), np.interp(t, [20, 40], [0, 4]), np.interp(t, [15, 20], [0, np.pi / 2])]
        )

    camera = make_camera(width=800, height=600, focal=600.0, position=(0.2, 0.0, 0.8), yaw=np.pi / 4, pitch=-0.2)
    stamps = np.arange(0.3, 39.5, 0.2)
    points, names = np.array([one[1:] for one in things]), tuple(dict.fromkeys(one[0] for one in things))
    to_camera = inverse(lift_se2(path(stamps)) @ camera.base_T_camera)
    seen = np.einsum("kij,nj->kni", to_camera[:, :3, :3], points) + to_camera[:, None, :3, 3]
    frame, thing = np.nonzero((seen[..., 2] > 0.4) & (seen[..., 2] < 7))
    local = seen[frame, thing]
    middle, half = project(camera, local), 60 / local[:, 2, None]
    boxes = np.hstack([middle - half, middle + half]) + rng.normal(size=(len(frame), 4))
    kept = ((boxes[:, :2] > 1) & (boxes[:, 2:] < camera.size - 2)).all(axis=1) & (rng.random(len(frame)) > 0.1)
    label = np.array([names.index(one[0]) for one in things])[thing]
    count = int(kept.sum())
    none = np.full(count, -1)
    found = Detections(stamps, frame[kept], boxes[kept], label[kept], np.ones(count), np.full(count, np.nan), none, names)
    times = np.arange(0, 40, 0.1)
    said = path(times) * [1.0, 1.0, 1 + turn_error] + rng.normal(scale=0.002, size=(len(times), 3))
    truth = Truth(tuple(TruthObject(i, one[0], points[i]) for i, one in enumerate(things)), None)
    odometry = Trajectory(times, lift_se2(said))
    return Log(name="turn", cameras=(CameraLog(camera, found),), odometry=odometry, truth=truth)


def measured(log: Log) -> tuple[Rays, Keyframes]:
    settings, ledger = load_settings(None, ("mode=joint",)), Ledger()
    keyframes = build_keyframes(log, settings, ledger)
    return build_rays(log, keyframes, settings, ledger), keyframes


@pytest.mark.parametrize("second", [SECOND, ("mug", -1.5, 5.0, 0.9)])
def test_two_things_that_no_frame_shows_together_are_two_objects(second):
    log = turning_drive((FIRST, second, LAMP))
    shown = log.cameras[0].detections
    assert max(Counter(zip(shown.frame.tolist(), shown.label.tolist(), strict=True)).values()) == 1
    result = pipeline.run(log, SETTINGS, Ledger())
    assert Counter(o.label for o in result.map.resolved()) == {"mug": 2, "lamp": 1}
    found = evaluate(result.map, log.truth, align="se2", radius=1.0).to_dict()
    assert found["matched"] == 3
    assert found["position_rmse"] < 0.1
    assert result.summary["noise"]["turning"] < 1.2
    for one in result.map.resolved():
        here = [o.position for o in log.truth.objects if o.label == one.label]
        assert min((one.position - p) @ np.linalg.solve(one.covariance, one.position - p) for p in here) < 14.2  # 3 sigma


def test_a_label_of_one_thing_stays_one_object_if_the_odometry_turns_wrongly():
    """The lamp is seen before and after the turn, and the odometry turns 30 % too far."""
    log = turning_drive((("mug", 0.5, 4.0, 0.9), LAMP), turn_error=0.3)
    result = pipeline.run(log, SETTINGS, Ledger())
    assert Counter(o.label for o in result.map.resolved()) == {"mug": 1, "lamp": 1}


def test_labels_that_others_see_on_both_sides_are_checked():
    """Four other labels stand where the robot sees them before and after it stops seeing the first mug."""
    rays, keyframes = measured(turning_drive((FIRST, SECOND, LAMP)))
    assert set(unchecked_labels(rays, keyframes)) == {0, 1}
    beside = [(name, 4.2 + 0.2 * i, 1.0 + 0.5 * i, 0.7) for i, name in enumerate(ALL_NAMED)]
    rays, keyframes = measured(turning_drive((FIRST, *beside)))
    witnesses = [np.ptp(keyframes.stamps[rays.keyframe[rays.label == i]]) for i in range(5)]
    assert min(witnesses) > 1.0
    assert 0 not in unchecked_labels(rays, keyframes)


def test_noisy_boxes_and_noisy_odometry_together_doubt_labels_that_check_one_another():
    """If several labels have two things each, each is seen on both sides of a moment, and checks the others in vain."""
    beside = [(name, 4.2 + 0.2 * i, 1.0 + 0.5 * i, 0.7) for i, name in enumerate(ALL_NAMED)]
    rays, keyframes = measured(turning_drive((FIRST, *beside), turn_error=0.0))
    association = associate_by_label(rays)
    at = {name: place for name, *place in (FIRST, *beside)}
    places = np.array([at[rays.label_names[i]] for i in association.label])

    def doubted(missed, **noise):
        """missed: m, how far the objects are from their places."""
        factors = NoiseFactors(**noise)
        found = {"noise": factors, "weight": np.ones(len(rays)), "map_T_base": keyframes.map_T_base}
        estimate = SimpleNamespace(**found, positions=places + np.array([0.0, 0.0, missed]))
        return doubted_labels(factors.rays_with_noise(rays), association, keyframes, estimate).tolist()

    assert 0 not in doubted(0.0, turning=4.0)
    assert doubted(0.5, rays=4.0) == []
    assert doubted(0.5, turning=4.0, rays=4.0) == [0, 1, 2, 3, 4]
    assert doubted(0.5, turning=4.0) == [0, 1, 2, 3, 4]
    # Boxes of one thing that err alike for seconds make the rays look noisy, but single boxes miss little.
    assert doubted(0.0, turning=4.0, rays=4.0) == doubted(0.0, turning=4.0)


def test_a_comparison_that_fails_keeps_the_map_by_labels_and_says_so(monkeypatch):
    def fail(named, other):
        raise SolveError("the linear system has no single solution")

    monkeypatch.setattr(joint_solve, "evidence_against", fail)
    result = pipeline.run(turning_drive((FIRST, SECOND, LAMP)), SETTINGS, Ledger())
    assert len(result.map) > 0
    assert "mug" in result.summary["doubted_labels"]


def test_boxes_that_show_a_thing_from_one_direction_are_no_fault():
    """In the window of the quick check, the robot turns to the bin and drives towards it. Its rays do not cross yet."""
    log = turning_drive((FIRST, LAMP, ("bin", 1.1, 7.0, 0.9)))
    settings = load_settings(None, ("mode=joint",))
    part = bounded_part(log, settings)
    found = agreement(part, part.log, settings)
    assert found.share < 0.75
    assert found.narrow.sum() > 40
    assert diagnose(log, settings, Ledger(), thorough=True).findings == ()
