"""Second boxes of one thing make no objects in a session."""

import numpy as np
import pytest
from driving import feed
from more_boxes import aside, left_parts, with_second_boxes
from quick import NOTHING_BESIDE

from objslam.config import Odometry, load_settings
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.boxes.nested_boxes import PARTS
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate


@pytest.mark.parametrize("second", [left_parts, aside])
def test_second_boxes_of_things_make_no_objects_while_the_robot_drives(second):
    drive = simulate(preset("demo", frames=200, false=0.0, localization=None, odometry=Odometry()), 3)
    some = np.arange(0, len(drive.cameras[0].detections), 2)
    log = with_second_boxes(drive, some, second)
    session = feed(Session(load_settings(None, ("mode=joint", *NOTHING_BESIDE)), patient=True).start(), log)
    found = evaluate(session.snapshot().map, drive.truth, align="se2").objects
    session.abort()
    assert len(found.matches) == len(drive.truth.objects)
    assert not found.false
    if second is left_parts:  # Boxes that the image's edge cuts off need not be parts. Boxes of neighbours may be.
        assert 0.8 * len(some) < session.counters.dropped()[PARTS] <= 1.1 * len(some)


def test_a_second_box_does_not_end_that_each_label_is_one_object():
    drive = simulate(preset("demo", frames=60, objects=8, classes=8, false=0.0), 0)
    assert len({thing.label for thing in drive.truth.objects}) == 8
    log = with_second_boxes(drive, np.arange(0, len(drive.cameras[0].detections), 5), aside)
    session = feed(Session(load_settings(None, ("mode=joint",)), patient=True).start(), log)
    session.abort()
    assert session._mapper.state.by_label
