"""A running robot whose boxes have class numbers."""

import numpy as np
import pytest
from robot import Recorder

from objslam.config import Settings
from objslam.core.camera import Camera
from objslam.errors import ConfigError
from objslam.live.class_names import UNNAMED, NamedSink
from objslam.live.counters import Counters
from objslam.live.interface import Sink
from objslam.live.session.session import Session


def test_boxes_get_names_and_the_rest_passes():
    recorder, counters = Recorder(), Counters()
    sink: Sink = NamedSink(recorder, "coco", counters)
    boxes = np.zeros((4, 4))
    for _ in range(2):
        assert sink.push_detections(1.0, "front", boxes, ["39", "80", "81", "lamp"], np.ones(4), whole=True)
    assert sink.push_odometry(1.0, np.eye(4))
    assert recorder.detections[0][3] == ["bottle", "80", "81", "lamp"]
    assert len(recorder.odometry) == 1
    assert counters.accepted()[UNNAMED] == 4
    assert counters.ledger.warnings == ["coco does not name class 80: such boxes keep their number"]


@pytest.mark.parametrize("labels", [None, [39], ["39", None], [39, "lamp"], 39])
def test_labels_that_are_none_are_left_to_the_session(labels):
    """It counts them as without names, and nothing is raised."""

    def dropped(through):
        session = Session(Settings())
        session.push_camera(Camera("front", 640, 480, np.diag([500.0, 500.0, 1.0])))
        boxes = np.tile([1.0, 2.0, 3.0, 4.0], (2, 1))
        return through(session).push_detections(1.0, "front", boxes, labels, np.ones(2)), session.counters.dropped()

    taken, reasons = dropped(lambda session: session)
    assert reasons
    assert dropped(lambda session: NamedSink(session, "coco", session.counters)) == (taken, reasons)


def test_a_missing_file_is_said_before_the_session_begins():
    with pytest.raises(ConfigError, match="no names file"):
        NamedSink(Recorder(), "missing.txt", Counters())
