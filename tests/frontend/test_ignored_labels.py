"""Boxes of labels that the user does not want in the map."""

import numpy as np
import pytest
from more_boxes import with_boxes

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.errors import ConfigError
from objslam.frontend.boxes.ignored_labels import IGNORED_LABELS, without_ignored_labels
from objslam.simulation import preset, simulate


@pytest.fixture(scope="module")
def drive():
    own = simulate(preset("demo"), 0)
    boxes = np.tile([100.0, 100.0, 200.0, 300.0], (20, 1))
    return with_boxes(own, np.arange(20), boxes, "person")


def test_ignored_boxes_are_dropped_and_counted_and_all_frames_stay(drive):
    ledger, before = Ledger(), drive.cameras[0].detections
    after = (
        without_ignored_labels(drive, load_settings(None, ("rays.ignore_labels=[person]",)), ledger).cameras[0].detections
    )
    own = np.array(before.labels) != "person"
    assert after.labels == [name for name in before.labels if name != "person"]
    assert np.array_equal(after.boxes, before.boxes[own])
    assert np.array_equal(after.frame_stamps, before.frame_stamps)
    assert ledger.dropped == {IGNORED_LABELS: 20}
    assert ledger.examples == {IGNORED_LABELS: ["20 of person"]}
    assert ledger.totals == {IGNORED_LABELS: len(before)}
    assert not ledger.warnings


def test_a_mistyped_label_is_said(drive):
    ledger = Ledger()
    left = without_ignored_labels(drive, load_settings(None, ("rays.ignore_labels=[persn, person]",)), ledger)
    assert len(left.cameras[0].detections) == len(drive.cameras[0].detections) - 20
    (warning,) = ledger.warnings
    assert warning.startswith("no box has the label persn of rays.ignore_labels; labels of the log: ")
    assert "person" in warning.split(";")[1]


def test_without_the_setting_the_log_is_the_same(drive):
    assert without_ignored_labels(drive, load_settings(None, ()), Ledger()) is drive


@pytest.mark.parametrize(
    ("typed", "meant"),
    [("person", ["person"]), ("0", ["0"]), ("[0, cup]", ["0", "cup"]), ("[]", []), ("[a, b]", ["a", "b"])],
)
def test_names_are_read_as_people_type_them(typed, meant):
    settings = load_settings(None, (f"rays.ignore_labels={typed}",))
    assert list(settings.rays.ignore_labels) == meant


@pytest.mark.parametrize("typed", ["1.5", "true", "['']", "{a: b}", "[[a]]"])
def test_a_wrong_list_of_labels_is_refused(typed):
    with pytest.raises(ConfigError, match=r"rays\.ignore_labels"):
        load_settings(None, (f"rays.ignore_labels={typed}",))
