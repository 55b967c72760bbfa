"""In a session, a label that is no name of one thing at rest loses its own name only."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from driving import feed
from driving_cart import with_cart_that_drives

from objslam.config import Odometry, load_settings
from objslam.live.adapters.replay import events
from objslam.live.label_kinds import LabelKinds
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate

SETTINGS = load_settings(None, ("mode=joint", "output.recording=false", "checks.use=false", "bodies.use=false"))
CARTS = ("cart 0", "cart 1", "cart 2")
JUDGED = "labels of things that move"


def drive(**changes):
    """Twelve things with names of their own, and only odometry."""
    noise = {"pixel_sigma": 1.0, "odometry": Odometry(), "localization": None, "false": 0.0}
    shape = {"objects": 12, "classes": 12, "frames": 300, "laps": 2, "room": (8.0, 6.0)}
    return simulate(preset("demo", **{**noise, **shape, **changes}), 1)


@pytest.fixture(scope="module")
def log():
    """The drive among three carts, each with a name of its own."""
    log = drive()
    for number, name in enumerate(CARTS):
        log = with_cart_that_drives(log, 10 + number, name)
    return log


@pytest.fixture(scope="module")
def whole(log, tmp_path_factory):
    """The session after its last message."""
    session = Session(SETTINGS, tmp_path_factory.mktemp("whole") / "journal", patient=True).start()
    yield feed(session, log)
    session.abort()


def kinds_of(session):
    """The names of the labels of each kind."""
    m = session._mapper.state
    return [{m.labels[i] for i in labels} for labels in (m.kinds.several, m.kinds.moving)]


def test_carts_are_no_objects_while_the_robot_drives_and_the_others_keep_their_names(log, whole):
    assert kinds_of(whole) == [set(), set(CARTS)]
    assert whole._mapper.state.kinds.are_names
    found = whole.snapshot().map.resolved()
    assert Counter(o.label for o in found) == Counter(o.label for o in log.truth.objects)
    assert whole.counters.accepted()[JUDGED] == len(CARTS)
    m = whole._mapper.state
    assert np.isin(m.rays.owner[m.rays.owner >= 0], m.landmarks.id).all()


def test_a_name_that_boxes_contradict_is_not_resolved_before_it_is_judged(log):
    settings = SETTINGS.model_copy(update={"live": SETTINGS.live.model_copy(update={"search_from": 0})})
    session = feed(Session(settings, patient=True).start(), log)
    found = session.snapshot().map
    session.abort()
    several, moving = kinds_of(session)
    names = set(CARTS) - several  # The places of the other cart passed for two things.
    assert not moving
    assert len(names) == 2
    status = {o.label: o.status for o in found}
    assert all(status[name] == "unresolved" for name in names)
    assert sum(one == "ok" for label, one in status.items() if label not in CARTS) >= 11


def test_a_session_killed_after_a_judgement_goes_on_to_the_same_map(log, whole, tmp_path):
    session = Session(SETTINGS, tmp_path / "killed", patient=True).start()
    pushes = list(events(log))
    for number, push in enumerate(pushes):
        feed(session, log, number, pushes=[push])
        if JUDGED in session.counters.accepted():
            break
    session.abort()
    again = Session(SETTINGS, tmp_path / "killed", resume=True, patient=True).start()
    feed(again, log, number + 1, pushes=pushes[number + 1 :])
    one, other = again.snapshot().map.objects, whole.snapshot().map.objects
    again.abort()
    assert kinds_of(again) == kinds_of(whole)
    assert [(o.id, o.label) for o in one] == [(o.id, o.label) for o in other]
    np.testing.assert_allclose([o.position for o in one], [o.position for o in other], atol=1e-6)


def test_two_things_of_one_label_are_two_objects_and_the_others_keep_their_names():
    log = drive(frames=150, laps=1)
    (camera,) = log.cameras
    boxes = camera.detections
    place = {o.label: o.position for o in log.truth.objects}
    names = list(boxes.label_names)
    one, other = max(((a, b) for a in names for b in names), key=lambda two: np.linalg.norm(place[two[0]] - place[two[1]]))
    label = np.where(boxes.label == names.index(other), names.index(one), boxes.label)
    log = replace(log, cameras=(replace(camera, detections=replace(boxes, label=label)),))
    session = feed(Session(SETTINGS, patient=True).start(), log)
    found = session.snapshot().map.resolved()
    session.abort()
    assert kinds_of(session) == [{one}, set()]
    assert session._mapper.state.kinds.are_names
    assert Counter(o.label for o in found) == Counter(one if name == other else name for name in names)


def test_one_class_leaves_names_and_a_few_classes_leave_none():
    kinds = LabelKinds(True, seen=set(range(10)))
    assert kinds.all_names
    kinds.add_moving(9)
    kinds.add_class(0)
    label = np.array([0, 5, 9])
    assert not kinds.all_names
    np.testing.assert_array_equal(kinds.name(label), [False, True, False])
    np.testing.assert_array_equal(kinds.classes(label), [True, False, False])
    kinds.add_class(1, judged=True)  # A solve has shown that the others are names.
    assert kinds.are_names
    kinds.add_class(2)
    np.testing.assert_array_equal(kinds.name(label), [False, False, False])
    np.testing.assert_array_equal(kinds.classes(label), [True, True, False])
    assert not LabelKinds(False).all_names
