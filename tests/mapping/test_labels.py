"""Whether labels tell objects apart, on drives whose noise is three times that of the settings."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from driving_cart import with_cart_that_drives

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.estimate import Estimate
from objslam.core.types import Association, Log
from objslam.mapping import pipeline, several_starts
from objslam.mapping.joint.labels import labels_tell
from objslam.simulation import preset, simulate

pytestmark = pytest.mark.usefixtures("one_start")
QUIET = ("mode=joint", "output.recording=false", "checks.use=false", "bodies.use=false")
"""Without what does not decide whether labels tell objects apart."""
HELD = "calibration.use=false"
THIRD = (
    "rays.pixel_sigma=1",
    "rays.box_sigma=0",
    *(
        f"odometry.{n}={getattr(Odometry(), n) / 3}"
        for n in ("x_per_m", "y_per_m", "xy_per_rad", "yaw_per_m", "yaw_per_rad")
    ),
)
"""A third of the noise of the simulated drives."""


def drive(seed: int, **changes) -> Log:
    """Twelve objects with names of their own, and only odometry."""
    noise = {"pixel_sigma": 3.0, "odometry": Odometry(), "localization": None, "false": 0.0}
    shape = {"objects": 12, "classes": 12, "frames": 400, "laps": 4, "room": (12.0, 9.0)}
    return simulate(preset("demo", **{**noise, **shape, **changes}), seed)


def mapped(log: Log, *overrides: str):
    ledger = Ledger()
    return pipeline.run(log, load_settings(None, (*QUIET, *overrides)), ledger), ledger


def never_together(log: Log) -> tuple[int, int]:
    """The two most distant objects that no frame shows together, as indices of labels."""
    found = log.cameras[0].detections
    seen = np.zeros((len(found.frame_stamps), len(found.label_names)), dtype=bool)
    seen[found.frame, found.label] = True
    place = {o.label: o.position for o in log.truth.objects}
    at = np.array([place[name] for name in found.label_names])
    apart = np.linalg.norm(at[:, None] - at, axis=2)
    apart[(seen.T.astype(int) @ seen) > 0] = 0
    i, j = np.unravel_index(np.argmax(apart), apart.shape)
    assert apart[i, j] > 2
    return int(i), int(j)


@pytest.mark.parametrize(("seed", "changes"), [(2, {}), (1, {"laps": 2, "room": (8.0, 6.0)})])
def test_too_little_noise_in_the_settings_makes_no_second_object(seed, changes):
    log = drive(seed, **changes)
    result, ledger = mapped(log, *THIRD)
    assert result.summary["rounds"] == []  # one object for each label
    assert Counter(o.label for o in result.map.resolved()) == Counter(o.label for o in log.truth.objects)
    (said,) = [warning for warning in ledger.warnings if "the settings have too little noise" in warning]
    assert "noise.odometry=true, noise.rays=true" in said


def test_noise_that_the_settings_leave_open_makes_no_second_object():
    noise = Odometry()
    noise = noise.model_copy(
        update={n: 3 * getattr(noise, n) for n in type(noise).model_fields if not n.startswith("floor")}
    )
    log = drive(2, odometry=noise, pixel_sigma=9.0, frames=200, laps=2, room=(8.0, 6.0))
    result, ledger = mapped(log, HELD)
    assert result.summary["rounds"] == []
    assert Counter(o.label for o in result.map.resolved()) == Counter(o.label for o in log.truth.objects)
    assert not any("too little noise" in warning for warning in ledger.warnings)


def test_a_label_of_two_objects_is_two_objects():
    log = drive(4, frames=200, laps=2)
    keep, other = never_together(log)
    found = log.cameras[0].detections
    names = found.label_names
    label = np.where(found.label == other, keep, found.label)
    camera = replace(log.cameras[0], detections=replace(found, label=label))
    result, _ = mapped(replace(log, cameras=(camera,)), *THIRD)
    twins = [o.position for o in result.map.resolved() if o.label == names[keep]]
    true = [o.position for o in log.truth.objects if o.label in (names[keep], names[other])]
    assert result.summary["rounds"] != []
    for position in true:
        assert min(np.linalg.norm(position - twin) for twin in twins) < 0.5


def test_boxes_drawn_twice_and_a_few_wrong_names_leave_one_object_per_label():
    log = drive(5, frames=200, laps=2)
    camera, rng = log.cameras[0], np.random.default_rng(5)
    found = camera.detections
    label = np.where(rng.random(len(found.frame)) < 0.01, rng.integers(0, 12, len(found.frame)), found.label)
    twice = np.flatnonzero(rng.random(len(found.frame)) < 0.04)
    source = np.sort(np.concatenate([np.arange(len(found.frame)), twice]))
    jitter = np.zeros((len(source), 4))
    again = np.append(False, np.diff(source) == 0)
    jitter[again] = rng.normal(0, 6, (again.sum(), 4))
    more = replace(found, label=label).take(source)
    assert len(more.frame) == len(source)
    score = np.where(again, more.scores - 0.1, more.scores)
    more = replace(more, boxes=more.boxes + jitter, scores=np.clip(score, 0.01, 1))
    result, _ = mapped(replace(log, cameras=(replace(camera, detections=more),)))
    assert result.summary["rounds"] == []
    assert Counter(o.label for o in result.map.resolved()) == Counter(o.label for o in log.truth.objects)


def test_boxes_of_one_object_with_the_name_of_another_are_no_second_object():
    """The detector gives eight boxes of one object the name of another object, which has a box in the same frames."""
    log = drive(2, pixel_sigma=1.0)
    found = log.cameras[0].detections
    seen = np.zeros((len(found.frame_stamps), len(found.label_names)), dtype=bool)
    seen[found.frame, found.label] = True
    together = seen.T.astype(int) @ seen
    np.fill_diagonal(together, 0)
    one, other = np.unravel_index(together.argmax(), together.shape)
    wrong = np.flatnonzero((found.label == one) & seen[found.frame, other])[::5][:8]
    assert len(wrong) == 8
    label = found.label.copy()
    label[wrong] = other
    camera = replace(log.cameras[0], detections=replace(found, label=label))
    result, _ = mapped(replace(log, cameras=(camera,)))
    assert result.summary["rounds"] == []
    assert Counter(o.label for o in result.map.resolved()) == Counter(o.label for o in log.truth.objects)


def test_a_second_object_that_is_seldom_seen_is_found_beside_the_first():
    """Its few boxes are all in frames that show the first object of its label too."""
    log = drive(4, frames=200, laps=2)
    found = log.cameras[0].detections
    seen = np.zeros((len(found.frame_stamps), len(found.label_names)), dtype=bool)
    seen[found.frame, found.label] = True
    together = seen.T.astype(int) @ seen
    np.fill_diagonal(together, 0)
    keep, other = (int(i) for i in np.unravel_index(np.argmax(together), together.shape))
    both = np.flatnonzero(seen[:, keep] & seen[:, other])
    shown = both[:: max(len(both) // 12, 1)]
    left = (found.label != other) | np.isin(found.frame, shown)
    names = found.label_names
    fewer = replace(found, label=np.where(found.label == other, keep, found.label)).take(left)
    assert len(shown) < 0.1 * len(fewer.frame)
    result, _ = mapped(replace(log, cameras=(replace(log.cameras[0], detections=fewer),)), HELD)
    assert result.summary["rounds"] != []
    twins = [o.position for o in result.map.resolved() if o.label == names[keep]]
    for position in (o.position for o in log.truth.objects if o.label in (names[keep], names[other])):
        assert min(np.linalg.norm(position - twin) for twin in twins) < 0.5


def test_a_label_without_a_position_tells_nothing():
    association = Association(np.repeat([0, 1], 10), np.arange(2))
    agrees = np.repeat([1.0, 0.0], 10)
    somewhere, nowhere = np.ones(3), np.full(3, np.nan)

    def tells(*positions):
        covariance, poses = np.tile(np.eye(3), (2, 1, 1)), np.eye(4)[None]
        return labels_tell(
            association, Estimate(poses, np.array(positions), covariance, np.ones(2), np.ones(2, bool), agrees, 0.0, 0.0, 1)
        )

    assert tells(somewhere, nowhere)
    assert not tells(somewhere, somewhere)
    assert not tells(nowhere, nowhere)


@pytest.mark.parametrize("seed", [0, 2])
def test_a_cart_that_drives_is_no_object_and_makes_no_boxes_noisy(seed, monkeypatch):
    """With one object for each label, its few boxes fit if all boxes are noisy. The path by the other labels is known, so
    nothing is explored."""
    monkeypatch.setattr(several_starts, "explored", lambda *_: pytest.fail("the log is explored"))
    log = with_cart_that_drives(drive(seed, frames=200, laps=2, pixel_sigma=1.0, room=(8.0, 6.0)), seed)
    result, _ = mapped(log)
    assert Counter(o.label for o in result.map.resolved()) == Counter(o.label for o in log.truth.objects)
    assert result.summary["noise"]["rays"] < 1.0


def test_carts_with_names_of_their_own_bend_no_path(monkeypatch):
    """Five of seventeen labels are of carts. At the path that all labels show, things at rest seem to move as well."""
    monkeypatch.setattr(several_starts, "explored", lambda *_: pytest.fail("the log is explored"))
    log = drive(1, frames=300, laps=2, pixel_sigma=1.0, room=(8.0, 6.0))
    for number in range(5):
        log = with_cart_that_drives(log, 10 + number, f"cart {number}")
    result, _ = mapped(log)
    noise = result.summary["noise"]
    assert max(noise["along"], noise["across"], noise["turning"]) < 1.5
    assert noise["rays"] < 1.0
    assert Counter(o.label for o in result.map.resolved()) == Counter(o.label for o in log.truth.objects)
