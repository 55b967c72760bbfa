"""Second labels of things make no objects in a session."""

import numpy as np
from driving import feed
from more_boxes import with_second_labels
from quick import HELD

from objslam.config import Odometry, load_settings
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.boxes.second_labels import SECOND_LABELS
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate


def test_second_labels_make_no_objects_in_a_session():
    drive = simulate(preset("demo", frames=120, false=0.0, localization=None, odometry=Odometry()), 3)
    some = np.arange(0, len(drive.cameras[0].detections), 2)
    session = feed(
        Session(load_settings(None, ("mode=joint", *HELD)), patient=True).start(), with_second_labels(drive, some)
    )
    result = session.stop()
    found = evaluate(result.map, drive.truth, align="se2").objects
    assert len(found.matches) == len(drive.truth.objects)
    assert not found.false
    assert 0.9 * len(some) < result.summary["dropped"][SECOND_LABELS] <= len(some)
