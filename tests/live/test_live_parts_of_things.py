"""A session drops second boxes of things, as an offline run does."""

import numpy as np
from driving import feed
from more_boxes import with_parts

from objslam.config import Odometry, load_settings
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.boxes.nested_boxes import PARTS
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate


def test_second_boxes_of_things_make_no_objects_while_the_robot_drives():
    drive = simulate(preset("demo", frames=200, false=0.0, localization=None, odometry=Odometry()), 3)
    some = np.arange(0, len(drive.cameras[0].detections), 2)
    session = feed(Session(load_settings(None, ("mode=joint",)), patient=True).start(), with_parts(drive, some))
    found = evaluate(session.snapshot().map, drive.truth, align="se2").objects
    assert len(found.matches) == len(drive.truth.objects)
    assert not found.false
    dropped = session.stop().summary["dropped"][PARTS]
    assert 0.8 * len(some) < dropped <= 1.1 * len(some)  # The boxes of things that stand close together may count as parts.
