"""A joint solve tries what a quick look at the boxes says."""

from dataclasses import replace

import numpy as np
import pytest
from added_errors import add_shared_errors
from wrong_inputs import MISTAKES, join

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import make_pose
from objslam.core.noise import NoiseFactors
from objslam.core.rotation import rotation_from_vector
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors
from objslam.mapping import pipeline, refuted
from objslam.mapping.alternation import solve
from objslam.mapping.checks.diagnosis import Diagnosis, diagnose
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.hypotheses.hypothesis import Hypothesis
from objslam.mapping.checks.hypotheses.trials import Trial, clear
from objslam.mapping.checks.parts.halves import check_halves, seen_in_both
from objslam.mapping.refuted import with_known_labels, without_refuted
from objslam.simulation import DepthNoise, PoseNoise, preset, simulate

pytestmark = pytest.mark.usefixtures("one_start")
SETTINGS = load_settings(None, ("mode=joint", "output.recording=false", "calibration.use=false", "bodies.use=false"))


def nothing(stage, done, total):
    pass


@pytest.fixture(scope="module")
def clean():
    return simulate(preset("demo", frames=200, objects=8, classes=8, false=0.0, localization=None), 0)


def solution_of(log):
    frames = build_keyframes(log, SETTINGS, Ledger())
    rays = build_rays(log, frames, SETTINGS, Ledger())
    return solve(frames, rays, (log.cameras[0].camera,), SETTINGS, Ledger(), nothing)


@pytest.fixture(scope="module")
def solved(clean):
    return solution_of(clean)


@pytest.fixture(scope="module")
def mirrored(clean):
    """The log with mirrored images, and its solution."""
    log = MISTAKES["image mirrored"](clean)
    return log, solution_of(log)


def no_boxes(log):
    camera = log.cameras[0]
    few = camera.detections.take(np.zeros(len(camera.detections), dtype=bool))
    return replace(log, cameras=(replace(camera, detections=few),))


@pytest.mark.parametrize(
    ("wrong", "put_right", "kept"),
    [
        (False, MISTAKES["image mirrored"], False),  # a clean log, which a hypothesis makes wrong
        (True, MISTAKES["image mirrored"], True),  # a mirrored log, which it puts right
        (True, no_boxes, False),  # a hypothesis that leaves nothing to solve
    ],
)
def test_a_finding_stays_only_if_the_log_put_right_is_explained_better(clean, mirrored, solved, wrong, put_right, kept):
    log, solution = mirrored if wrong else (clean, solved)
    trial = Trial(Hypothesis("mirrored", "the boxes mirrored", "the images are mirrored", put_right), 1.0, 1.0, None)
    others = Finding("depth in mm", "the depths are in mm")
    found = Diagnosis((Finding("mirrored", "it is mirrored", basis="boxes"), others), (trial,))
    left = without_refuted(found, solution, log, SETTINGS, nothing)
    assert [one.name for one in left.findings] == (["mirrored"] if kept else []) + ["depth in mm"]


@pytest.mark.parametrize(
    ("put_right", "kept"),
    [
        (lambda log: log, True),  # the corrected log needs no noise
        (no_boxes, False),  # it leaves nothing to solve
    ],
)
def test_boxes_that_fit_only_a_path_that_bends_refute_nothing(clean, solved, put_right, kept):
    bent = replace(solved, estimate=replace(solved.estimate, noise=NoiseFactors(turning=10.0)))
    trial = Trial(Hypothesis("odd", "it put right", "it is odd", put_right), 1.0, 1.0, None)
    found = Diagnosis((Finding("odd", "it is odd", basis="boxes"),), (trial,))
    assert bool(without_refuted(found, bent, clean, SETTINGS, nothing).findings) == kept
    assert not without_refuted(found, solved, clean, SETTINGS, nothing).findings


def names(log):
    settings = load_settings(None, ("mode=joint", "output.recording=false", "calibration.use=false", "bodies.use=false"))
    result = pipeline.run(log, settings, Ledger())
    return [one["name"] for one in result.summary["wrong_input"]], len(result.map.resolved())


def room(seed, **changes):
    noise = {"pixel_sigma": 2.0, "missed": 0.1, "false": 0.01, "odometry": Odometry(), "localization": None}
    return simulate(preset("demo", **{"objects": 10, "classes": 10, "frames": 300, **noise, **changes}), seed)


@pytest.mark.parametrize(
    ("noise", "corrected", "kept"),
    [
        (NoiseFactors(rays=10.5, along=20.0), NoiseFactors(along=2.9), True),  # a MRCLAM robot with the identity for a mount
        (NoiseFactors(rays=4.7), NoiseFactors(rays=0.7, along=5.2), True),  # a simulated robot with six times the drift
        (NoiseFactors(rays=1.0, along=3.0), NoiseFactors(along=2.9), False),  # a path that bends as much
        (NoiseFactors(rays=10.5, along=20.0), NoiseFactors(rays=3.0), False),  # boxes that do not fit either
    ],
)
def test_bad_wheels_do_not_refute_a_wrong_mount(clean, solved, monkeypatch, noise, corrected, kept):
    """The corrected log explains the boxes, but only with noisy odometry, because the robot has noisy odometry."""
    half = np.where(np.arange(len(solved.rays)) % 2 == 0, solved.estimate.weight, 0.0)
    wrong = replace(solved, estimate=replace(solved.estimate, weight=half, noise=noise))
    other = replace(solved, estimate=replace(solved.estimate, noise=corrected))
    monkeypatch.setattr(refuted, "_solved", lambda *_: other)
    trial = Trial(Hypothesis("mount", "the mount set", "the mount is not set", lambda log: log), 1.0, 1.0, None)
    found = Diagnosis((Finding("mount", "the mount is not set", basis="boxes"),), (trial,))
    assert bool(without_refuted(found, wrong, clean, SETTINGS, nothing).findings) == kept


def trials_of(as_it_is, named, others):
    """Trials of a log: as it is, with the named mount, and with other mounts."""
    scores = {"mount": named, **{f"other {number}": score for number, score in enumerate(others)}}
    hypotheses = [(Hypothesis(name, name, name, lambda log: log, of_mount=True), score) for name, score in scores.items()]
    return (Trial(None, as_it_is, as_it_is, None), *(Trial(one, score, score, None) for one, score in hypotheses))


@pytest.mark.parametrize(
    ("as_it_is", "named", "kept"),
    [
        (0.3, 0.86, True),  # a camera turned by 90 degrees
        (0.3, 0.44, False),  # no mount is clearly better than others
        (0.6, 0.86, False),  # as the log is, its boxes agree nearly as well
    ],
)
@pytest.mark.parametrize("fails", [False, True])
def test_solves_that_explain_nothing_refute_no_clear_mount(clean, solved, monkeypatch, as_it_is, named, kept, fails):
    """A solve may take two things for one. Then it explains the boxes of no mount, and the quick look decides."""
    wrong = replace(solved, estimate=replace(solved.estimate, noise=NoiseFactors(rays=20.0)))
    monkeypatch.setattr(refuted, "_solved", lambda *_: wrong)
    trials = trials_of(as_it_is, named, np.linspace(0.1, 0.4, 40))
    if fails:
        nowhere = replace(trials[1].hypothesis, put_right=no_boxes)
        monkeypatch.undo()
        trials = (trials[0], replace(trials[1], hypothesis=nowhere), *trials[2:])
    found = Diagnosis((Finding("mount", "the camera is turned", basis="boxes"),), trials)
    assert bool(without_refuted(found, wrong, clean, SETTINGS, nothing).findings) == kept
    assert not without_refuted(found, solved, clean, SETTINGS, nothing).findings


@pytest.mark.parametrize(("axis", "of_camera"), [(2, False), (1, False), (0, False), (2, True)])
def test_a_mount_turned_by_a_right_angle_is_clear_from_odometry_alone(axis, of_camera):
    log, turn = room(3), make_pose(rotation_from_vector(np.eye(3)[axis] * np.pi / 2), np.zeros(3))
    camera = log.cameras[0].camera
    mount = camera.base_T_camera @ turn if of_camera else turn @ camera.base_T_camera
    turned = replace(log, cameras=(replace(log.cameras[0], camera=replace(camera, base_T_camera=mount)),))
    found = diagnose(turned, SETTINGS, Ledger(), thorough=True)
    put_right = {t.hypothesis.name: t.hypothesis.put_right for t in found.trials if t.hypothesis is not None}
    right = put_right[found.findings[0].name](turned).cameras[0].camera.base_T_camera
    assert np.allclose(right[:3, :3], camera.base_T_camera[:3, :3], atol=1e-9)
    assert clear(found.trials, found.findings[0].name)


def test_a_right_mount_is_no_chance():
    trials = diagnose(room(3), SETTINGS, Ledger(), thorough=True).trials
    assert not any(clear(trials, trial.hypothesis.name) for trial in trials if trial.hypothesis is not None)


def test_objects_that_one_half_sees_under_little_parallax_are_no_mistake():
    """The quick look says that 99 % of the rays fit in the first half and 22 % in the second."""
    wrong, ok = names(simulate(preset("demo", frames=150, localization=None), 2))
    assert wrong == []
    assert ok == 12


@pytest.mark.parametrize("basis", ["halves", "frames"])
def test_a_solve_of_a_clean_log_refutes_what_a_quick_look_said(clean, solved, basis):
    said = Finding("odd", "some boxes do not fit", basis=basis)
    kept = Finding("odd", "the input says so itself")
    assert without_refuted(Diagnosis((said, kept)), solved, clean, SETTINGS, nothing).findings == (kept,)


@pytest.mark.parametrize(("depth", "unnamed"), [(None, False), (DepthNoise(), True)])
def test_a_half_of_another_recording_still_spoils_a_joint_map(depth, unnamed):
    log = join(room(0, depth=depth), room(50, depth=depth), interleaved=False)
    if unnamed:
        camera = log.cameras[0]
        boxes = replace(camera.detections, label=np.zeros_like(camera.detections.label), label_names=("thing",))
        log = replace(log, cameras=(replace(camera, detections=boxes),))
    wrong, ok = names(log)
    assert "halves differ" in wrong
    assert ok == 0


def test_frames_of_another_recording_still_spoil_a_joint_map():
    rooms = [room(seed, localization=PoseNoise(xy=0.02, yaw=0.005)) for seed in (0, 50)]
    wrong, ok = names(join(*rooms, interleaved=True))
    assert "mixed recordings" in wrong
    assert ok == 0


@pytest.mark.parametrize(("factor", "kept"), [(1.0, False), (1.25, True), (0.6, True)])
def test_ranges_in_another_scale_than_the_odometry_stay_wrong(factor, kept):
    """The quick look was wrong on a real robot whose camera is late: there, ranges end at one place if they are shorter."""
    settings = load_settings(None, ("mode=joint", "output.recording=false", "bodies.use=false"))
    log = add_shared_errors(room(0, depth=DepthNoise(), frames=150), {"front.clock": -0.24, "odometry.turn_scale": -0.06})
    camera = log.cameras[0]
    boxes = replace(camera.detections, depths=camera.detections.depths * factor)
    log = replace(log, cameras=(replace(camera, detections=boxes),))
    frames = build_keyframes(log, settings, Ledger())
    rays = build_rays(log, frames, settings, Ledger())
    errors = shared_errors(log, frames, rays, settings)
    solution = solve(frames, rays, (log.cameras[0].camera,), settings, Ledger(), nothing, errors=errors)
    said = Finding("depth scale", "the depths are too long", basis="ranges")
    assert bool(without_refuted(Diagnosis((said,)), solution, log, settings, nothing).findings) == kept
    if kept:
        found = diagnose(log, settings, Ledger()).findings
        assert [(one.name, one.basis) for one in found] == [("depth scale", "ranges")]


def test_halves_are_compared_by_their_fitting_rays():
    late = np.repeat([False, True], 100)
    assert check_halves(late, np.tile(np.arange(100) < 40, 2)) is None
    assert check_halves(np.zeros(200, dtype=bool), np.arange(200) < 90) is None  # There is no second half.
    differ = check_halves(late, np.concatenate([np.arange(100) < 90, np.arange(100) < 20]))
    assert differ.message.startswith("90 % of the rays fit in the first half of the log, 20 % in the second")


def test_an_object_is_seen_in_both_halves_unless_by_chance():
    late = np.repeat([False, True], 50)
    fits = np.ones(100, dtype=bool)
    assert seen_in_both(late, fits, np.zeros(100, dtype=int)) == 1.0
    assert seen_in_both(late, fits, np.repeat([0, 1], 50)) == 0.0
    # Object 0 fills the first half and two thirds of the second, the rest is new: most of the first half is seen again.
    assert seen_in_both(late, fits, np.append(np.zeros(83, dtype=int), np.ones(17, dtype=int))) == 1.0
    # Two rays of 52 are chance.
    assert seen_in_both(late, fits, np.append(np.zeros(52, dtype=int), np.ones(48, dtype=int))) == 0.0
    assert seen_in_both(late, ~fits, np.zeros(100, dtype=int)) == 0.0


def rays_of(log):
    return build_rays(log, build_keyframes(log, SETTINGS, Ledger()), SETTINGS, Ledger())


def test_labels_that_a_corrected_log_shows_as_names_are_names_in_the_wrong_log(clean):
    """So the boxes of a wrong log are not associated without their labels."""
    log = MISTAKES["base_T_camera inverted"](clean)
    diagnosis = diagnose(log, SETTINGS, Ledger())
    assert [one.name for one in diagnosis.findings] == ["mount inverted"]
    assert with_known_labels(diagnosis, log, rays_of(log), SETTINGS, nothing).association.method == "by_label"
    given = load_settings(None, ("mode=joint", "output.recording=false", "association.method=global"))
    assert with_known_labels(diagnosis, log, rays_of(log), given, nothing) is given
    assert with_known_labels(Diagnosis(), log, rays_of(log), SETTINGS, nothing) is SETTINGS


def test_labels_of_several_objects_are_no_names():
    """Neither in the given log nor in the corrected one. A camera sees at most one object of a label at once."""
    whole = simulate(preset("demo", frames=200, objects=8, classes=8, false=0.0, localization=None), 0)
    found = whole.cameras[0].detections
    pairs = replace(found, label=found.label // 2)
    apart = np.unique(np.stack([pairs.frame, pairs.label]), axis=1, return_index=True)[1]
    kept = np.sort(apart)
    columns = {name: getattr(pairs, name)[kept] for name in ("frame", "boxes", "label", "scores", "depths", "track_ids")}
    log = MISTAKES["base_T_camera inverted"](
        replace(whole, cameras=(replace(whole.cameras[0], detections=replace(pairs, **columns)),))
    )
    diagnosis = diagnose(log, SETTINGS, Ledger())
    assert diagnosis.spoilt
    assert with_known_labels(diagnosis, log, rays_of(log), SETTINGS, nothing) is SETTINGS


def test_the_settings_of_a_result_are_those_of_the_user(clean):
    """Although a wrong log was solved with one object for each label, because its corrected log shows that."""
    log = MISTAKES["base_T_camera inverted"](clean)
    for more in ((), ("noise.rays=false", "noise.ranges=false", "noise.odometry=false")):
        settings = load_settings(
            None, ("mode=joint", "output.recording=false", "calibration.use=false", "bodies.use=false", *more)
        )
        result = pipeline.run(log, settings, Ledger())
        assert [one["name"] for one in result.summary["wrong_input"]][:1] == ["mount inverted"]
        assert result.settings.association.method == "auto"
