"""A session associates its whole drive again while the robot drives."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from driving import feed

from objslam.config import load_settings
from objslam.evaluation.evaluate import evaluate
from objslam.live.adapters.replay import events
from objslam.live.label_kinds import LabelKinds
from objslam.live.mapper.landmark_table import LandmarkTable
from objslam.live.mapper.tables import RayTable
from objslam.live.reassociation.adoption import plan_of
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate
from objslam.sources.journal.corrections import AssociationMessage

GLIMPSE, APART = 4, 9.0
"""An object is seen in this number of images, fewer than live.min_rays, and then not for this time, s, longer than
live.forget."""


def settings_of(*more):
    return load_settings(None, ("mode=joint", "output.recording=false", "checks.use=false", "bodies.use=false", *more))


@pytest.fixture(scope="module")
def log():
    """A drive of two minutes. The detector sees half of the objects only for moments."""
    changes = {"frames": 400, "classes": 12, "false": 0.0, "localization": None, "laps": 3}
    whole = simulate(preset("demo", **changes), 5)
    found = whole.cameras[0].detections
    keep = np.ones(len(found.frame), dtype=bool)
    for label in range(0, len(found.label_names), 2):
        begin = left = -np.inf
        for i in np.flatnonzero(found.label == label).tolist():
            stamp = found.frame_stamps[found.frame[i]]
            if stamp - begin > APART:
                begin, left = stamp, GLIMPSE
            keep[i], left = left > 0, left - 1
    labels = np.arange(len(found.label_names))  # Two of the objects that are seen for moments have one label.
    labels = np.where(labels % 2 == 0, 2 * (labels // 4), labels)
    names = tuple(f"thing {i}" for i in range(len(labels)))
    columns = {name: getattr(found, name)[keep] for name in ("frame", "boxes", "scores", "depths", "track_ids")}
    thin = replace(found, **columns, label=labels[found.label[keep]], label_names=names)
    shared = {label: names[labels[i]] for i, label in enumerate(found.label_names)}
    objects = tuple(replace(o, label=shared[o.label]) for o in whole.truth.objects if o.label in shared)
    truth = replace(whole.truth, objects=objects)
    return replace(whole, cameras=(replace(whole.cameras[0], detections=thin),), truth=truth)


def drive(log, settings, **more):
    return feed(Session(settings, patient=True, **more).start(), log)


def judged(snapshot, log):
    found = evaluate(snapshot.map, log.truth, align="se2", radius=0.8).objects
    return found, np.array([one.squared_3d for one in found.matches])


@pytest.fixture(scope="module")
def searched(log, tmp_path_factory):
    """A session that searches, after its last message."""
    session = drive(log, settings_of(), journal=tmp_path_factory.mktemp("whole") / "journal")
    yield session
    session.abort()


def test_objects_seen_for_moments_are_in_the_map_while_the_robot_drives(log, searched):
    session = drive(log, settings_of("live.search_from=0"))
    without, _ = judged(session.snapshot(), log)
    session.abort()
    found, squared = judged(searched.snapshot(), log)
    assert len(without.missed) >= 4
    assert len(found.missed) <= 1
    assert not found.false
    assert (squared < 14.2).all()  # three sigmas
    assert searched.counters.accepted()["objects found in earlier boxes"] >= 4
    m = searched._mapper.state
    tracked = [ray[0] for track in m.tracks for ray in track.rays]
    assert not np.isin(m.rays.number[m.rays.owner >= 0], tracked).any()


def test_a_session_killed_after_a_search_goes_on_to_the_same_map(log, searched, tmp_path):
    session = Session(settings_of(), tmp_path / "killed", patient=True).start()
    pushes = list(events(log))
    for number, push in enumerate(pushes):
        feed(session, log, number, pushes=[push])
        if "objects found in earlier boxes" in session.counters.accepted():
            break
    session.abort()
    again = Session(settings_of(), tmp_path / "killed", resume=True, patient=True).start()
    feed(again, log, number + 1, pushes=pushes[number + 1 :])
    one, other = again.snapshot().map.objects, searched.snapshot().map.objects
    again.abort()
    assert [(o.id, o.label) for o in one] == [(o.id, o.label) for o in other]
    np.testing.assert_allclose([o.position for o in one], [o.position for o in other], atol=1e-6)


@pytest.mark.long
def test_landmarks_of_people_who_walk_leave_the_map_while_the_robot_drives():
    room = {"frames": 200, "classes": 4, "false": 0.0, "localization": None, "moving": 8, "missed": 0.0}
    log = simulate(preset("demo", **room), 9)
    false = []
    for start in (0, 75):
        session = drive(log, settings_of(f"live.search_from={start}"))
        found, _ = judged(session.snapshot(), log)
        false.append(len(found.false))
        if start:
            assert len(found.matches) >= 11
            assert session.counters.accepted()["landmarks that are no objects"] >= 1
        m = session._mapper.state
        assert np.isin(m.rays.owner[m.rays.owner >= 0], m.landmarks.id).all()
        session.abort()
    assert false[1] < false[0] / 2


@pytest.mark.long
def test_things_without_names_that_come_back_are_no_new_objects():
    """`tools/bench_live.py --parts unnamed` drives ten such rooms."""
    room = {"frames": 300, "classes": 1, "objects": 12, "false": 0.0, "localization": None, "laps": 3}
    log = simulate(preset("demo", **room), 3)
    session = drive(log, settings_of("live.search_from=0"))
    without, _ = judged(session.snapshot(), log)
    session.abort()
    session = drive(log, settings_of())
    found, squared = judged(session.snapshot(), log)
    m = session._mapper.state
    assert np.isin(m.rays.owner[m.rays.owner >= 0], m.landmarks.id).all()
    assert (np.diff(m.landmarks.id) > 0).all()
    session.abort()
    assert len(without.false) >= 10
    assert len(found.matches) == 12
    assert len(found.false) <= 3
    assert (squared < 14.2).all()  # three sigmas


def table(ids, owner, next_landmark):
    """The parts of a map that a plan reads: landmarks with these ids, and rays 0, 1, 2, ... with these landmarks."""
    landmarks, rays, owner = LandmarkTable(), RayTable(), np.array(owner)
    landmarks.add(id=ids)
    rays.add(number=np.arange(len(owner)), owner=owner, used=owner >= 0)
    return SimpleNamespace(
        landmarks=landmarks,
        rays=rays,
        next_id=SimpleNamespace(landmark=next_landmark),
        kinds=LabelKinds(are_names=False),
        rows_of=lambda some: np.searchsorted(landmarks.id, some),
    )


def answer(rays, free):
    """An association of objects with these rays."""
    places = np.zeros((len(rays), 3))
    return AssociationMessage(0, tuple(map(np.array, rays)), places, np.array(free), np.zeros(0), np.zeros((0, 4, 4)))


def test_later_rays_follow_the_landmark_that_theirs_became():
    #             rays  0  1  2  3  4  5  6   7  8 | 9 10 11 12  13 came later
    m = table([3, 5, 8, 9], [3, 3, 3, 5, 5, 8, 8, -1, -1, 5, 8, 9, 3, -1], 12)
    plan = plan_of(m, answer([[0, 1, 2, 3, 4], [7, 8]], [5, 6]))
    assert plan.ids.tolist() == [3, 12]  # Landmark 5 is landmark 3, and two rays without a landmark are a new one.
    assert plan.new.tolist() == [False, True]
    assert plan.owner.tolist() == [3, 3, 3, 3, 3, -1, -1, 12, 12, 3, -1, 9, 3, -1]
    assert plan.used.tolist() == [j >= 0 for j in plan.owner.tolist()]
    assert plan.heirs == {3: 3, 5: 3, 8: -1}
    assert plan.gone.tolist() == [5, 8]  # Landmark 8 is no object. The association does not know landmark 9.


def test_a_landmark_of_two_objects_is_parted_and_rays_that_left_the_map_do_not_count():
    m = table([3], [3, 3, 3, 3, 3, 3], 4)
    m.rays.used[4] = False
    plan = plan_of(m, answer([[0, 1], [2, 3, 4], [77, 78]], []))
    assert plan.objects.tolist() == [0, 1]
    assert plan.ids.tolist() == [4, 3]  # The object with more rays keeps the id.
    assert plan.owner.tolist() == [4, 4, 3, 3, 3, 3]
    assert plan.used.all()
    assert not len(plan.gone)


def test_an_association_of_no_object_leaves_no_landmark_that_it_knows():
    m = table([3, 4], [3, 3, 4], 5)
    plan = plan_of(m, answer([], [0, 1]))
    assert plan.owner.tolist() == [-1, -1, 4]
    assert plan.gone.tolist() == [3]


def test_a_landmark_of_which_hardly_a_ray_is_explained_is_no_object():
    m = table([3, 7], [3] * 20 + [7] * 20, 8)
    plan = plan_of(m, answer([[*range(20), 20, 21]], [*range(22, 40)]))
    assert plan.heirs == {3: 3, 7: -1}
    assert plan_of(m, answer([[*range(20), 20, 21, 22]], [*range(23, 40)])).heirs == {3: 3, 7: 3}


def test_an_association_leaves_labels_alone_that_are_no_classes_any_more():
    m = table([3, 7], [3, 3, 7, -1], 8)
    m.rays.label[2:] = 5
    m.kinds.add_moving(5)
    plan = plan_of(m, answer([[0, 1, 2, 3]], []))
    assert plan.owner.tolist() == [3, 3, 7, -1]
    assert not len(plan.gone)
