"""A session maps as if it had never received the boxes of ignored labels."""

import numpy as np
from driving import feed
from more_boxes import with_boxes
from quick import HELD

from objslam.config import Odometry, load_settings
from objslam.frontend.boxes.ignored_labels import IGNORED_LABELS
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate


def test_a_session_leaves_out_ignored_labels_and_counts_their_boxes():
    drive = simulate(preset("demo", frames=120, localization=None, odometry=Odometry()), 3)
    count = len(drive.cameras[0].detections.frame_stamps)
    left = np.linspace(20, 300, count)
    crowded = with_boxes(drive, np.arange(count), np.column_stack([left, left, left + 80, left + 160]), "person")
    settings = load_settings(None, ("mode=joint", *HELD, "rays.ignore_labels=[person, prson]"))
    plain, result = (feed(Session(settings, patient=True).start(), log).stop() for log in (drive, crowded))
    assert len(plain.map.objects) > 3
    assert [one.label for one in result.map.objects] == [one.label for one in plain.map.objects]
    for one, other in zip(result.map.objects, plain.map.objects, strict=True):
        assert np.allclose(one.position, other.position, atol=1e-9)
    assert result.summary["dropped"][IGNORED_LABELS] == count
    for missing, ended in (("person or prson", plain), ("prson", result)):  # A mistyped label is said.
        (said,) = [one for one in ended.summary["warnings"] if one.startswith("no box has the label")]
        assert said.startswith(f"no box has the label {missing} of rays.ignore_labels; labels of the log: ")
