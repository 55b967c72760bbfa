"""A map is the map of the log without the ignored boxes."""

import numpy as np
import pytest
from more_boxes import with_boxes
from quick import HELD

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.frontend.boxes.ignored_labels import IGNORED_LABELS
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate


@pytest.fixture(scope="module")
def drive():
    return simulate(preset("demo", frames=120, localization=None, odometry=Odometry()), 3)


@pytest.fixture(scope="module")
def crowded(drive):
    """The drive with a person in each image, who stands where no robot part is: the boxes move."""
    count = len(drive.cameras[0].detections.frame_stamps)
    left = np.linspace(20, 300, count)
    return with_boxes(drive, np.arange(count), np.column_stack([left, left, left + 80, left + 160]), "person")


def places(result):
    return {(one.label, *np.round(one.position, 6)) for one in result.map.objects}


def test_an_offline_map_is_that_of_the_log_without_these_boxes(drive, crowded):
    settings = ("mode=joint", *HELD)
    plain = pipeline.run(drive, load_settings(None, settings), Ledger())
    ledger = Ledger()
    result = pipeline.run(crowded, load_settings(None, (*settings, "rays.ignore_labels=person")), ledger)
    assert places(result) == places(plain)
    assert result.summary["dropped"][IGNORED_LABELS] == len(drive.cameras[0].detections.frame_stamps)
    assert result.summary["counts"]["detections"] == len(crowded.cameras[0].detections)
