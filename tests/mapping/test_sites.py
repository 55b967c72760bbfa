"""The map of a site over many days: what is there, what moved, what is gone, and which sessions belong together."""

from dataclasses import replace

import numpy as np
import pytest
from mapping.site_days import DAY, Day, Place, month, session, there
from scipy.optimize import least_squares

from objslam.association.registration.object_maps import register
from objslam.core.geometry import align, inverse, lift_se2
from objslam.core.maps.shared_covariance import jacobian
from objslam.core.object_map import ObjectMap
from objslam.mapping.sites.compare import compare
from objslam.mapping.sites.merge import merge_sessions


def test_thirty_days_of_changes():
    """A tenth of the objects moves, comes or goes each week. Two visits later the map knows it, and no phantom is left."""
    found = month(0)
    assert found.right.mean() >= 0.95
    assert found.phantoms == 0  # Nothing that one session saw and two missed is left.
    assert np.square(found.last_week).mean() <= np.square(found.first_week).mean()
    assert found.confirmed.mean() >= 0.9


def quiet(place, day):
    return session(place, day, wrong_label=0.0, missed=0.0, phantoms=0.0)


class Sees(Day):
    """A session that had every place in view."""

    def looks(self, objects, positions, session_T_map):
        return np.full(len(objects), 60)


def all_in_view(place, day):
    seen, own = quiet(place, day)
    back = inverse(own)
    model = seen.objects[0]
    found = tuple(
        replace(
            model, id=k, label=label, position=back[:3, :3] @ at + back[:3, 3], labels=None,
            first_seen=day * DAY, last_seen=day * DAY + 600,
        )
        for k, (label, at) in place.truth.items()
    )  # fmt: skip
    return Sees(f"day {day}", ObjectMap(found)), own


def test_what_became_of_each_object_is_told():
    place = Place(np.random.default_rng(1), count=20)
    a, _ = all_in_view(place, 0)
    gone = place.truth.pop(3)
    label, start = place.truth[5]
    place.truth[5] = (label, place.spot())
    lone = next(k for k, (name, _) in place.truth.items() if name not in (gone[0], label))
    place.truth[99] = (place.truth[lone][0], place.spot())
    b, own = all_in_view(place, 1)
    b = Sees(b.name, ObjectMap(tuple(replace(o, id=o.id + 1000) for o in b.objects)))
    found = compare(a, b)
    assert found.registration.accepted
    for one in found.changes:  # Each map is asked for its own ids.
        known = next(iter(one.item.labels or {one.item.label: 1.0}))
        assert all(o.label == known for o, number in ((a, one.id_a), (b, one.id_b)) for o in o.objects if o.id == number)
    ids = {(one.outcome, one.id_a, one.id_b) for one in found.changes if one.outcome != "confirmed"}
    assert ids == {("moved", 5, 1005), ("gone", 3, None), ("new", None, 1099)}
    assert all(one.id_b == one.id_a + 1000 for one in found.of("confirmed"))
    np.testing.assert_allclose(found.a_T_b, own, atol=1e-6)
    assert len(found.of("confirmed")) == 18
    assert {one.item.id for one in found.of("confirmed")} == set(range(20)) - {3, 5}
    (moved,) = found.of("moved")
    assert moved.item.id == 5
    np.testing.assert_allclose(moved.item.position, place.truth[5][1], atol=1e-6)
    np.testing.assert_allclose(moved.item.life.moved_from, start, atol=1e-6)
    assert [one.item.id for one in found.of("gone")] == [3]
    assert found.of("gone")[0].probability > 0.5
    (new,) = found.of("new")
    np.testing.assert_allclose(new.item.position, place.truth[99][1], atol=1e-6)


def test_a_map_without_views_says_of_nothing_that_it_is_gone():
    place = Place(np.random.default_rng(2), count=20)
    a, _ = all_in_view(place, 0)
    del place.truth[3]
    b, _ = all_in_view(place, 1)
    from objslam.mapping.sites.session import Session

    found = compare(a, Session("objects alone", b.objects))
    assert not found.of("gone")
    assert [one.item.id for one in found.of("unconfirmed")] == [3]
    assert found.has_views == (False, False)


class SeesHalf(Sees):
    """A session whose cameras saw only one half of the place, in its own frame."""

    def looks(self, objects, positions, session_T_map):
        here = positions @ session_T_map[:3, :3].T + session_T_map[:3, 3]
        return np.where(here[:, 0] < 6.0, 60, 0)


def test_a_merge_and_a_comparison_say_the_same_of_each_object():
    """Both days saw one half of the place, with a thing taken and a thing put there in each half."""
    place = Place(np.random.default_rng(21), count=24)
    halves = [[k for k, (_, at) in place.truth.items() if (at[0] < 6.0) == near] for near in (True, False)]
    views = object()  # Its content is not read: the test says what was in view.
    lone = [halves[0][0], halves[1][0]]
    for k in lone:
        place.truth[k] = ("clock", place.truth[k][1])  # Only these two are clocks, and they are taken.
    a = SeesHalf("day 0", all_in_view(place, 0)[0].objects, views)
    taken = [place.truth.pop(k) for k in lone]
    beside = np.array([0.3, 0.0, 0.4])
    place.truth |= {200 + k: ("globe", at + beside) for k, (_, at) in enumerate(taken)}
    seen, own = all_in_view(place, 1)
    found_there = tuple(replace(o, position=own[:3, :3] @ o.position + own[:3, 3]) for o in seen.objects)
    b = SeesHalf("day 1", ObjectMap(found_there), views)
    found = compare(a, b)
    assert {(one.outcome, one.item.label, one.id_a, one.id_b) for one in found.changes if one.outcome != "confirmed"} == {
        ("gone", "clock", lone[0], None),
        ("unconfirmed", "clock", lone[1], None),
        ("new", "globe", None, 200),
        ("unconfirmed", "globe", None, 201),
    }
    (island,) = merge_sessions([a, b])
    states = {o.id: o.life.state for o in (*island.objects, *island.objects.gone)}
    assert states == {one.item.id: one.outcome for one in found.changes}
    (alone,) = merge_sessions([a])
    assert {o.life.state for o in alone.objects} == {"unconfirmed"}


def test_what_was_gone_before_is_no_change():
    place = Place(np.random.default_rng(22), count=20)
    a, _ = all_in_view(place, 0)
    taken = place.truth.pop(4)
    b, _ = all_in_view(place, 1)
    site = Sees("site", merge_sessions([a, b])[0].objects)
    assert [o.id for o in site.objects.gone] == [4]
    assert {one.outcome for one in compare(site, b).changes} == {"confirmed"}
    place.truth[4] = taken
    c, _ = all_in_view(place, 2)
    (back,) = [one for one in compare(site, c).changes if one.outcome != "confirmed"]
    assert (back.outcome, back.id_a, back.id_b) == ("new", None, 4)


def test_an_object_that_comes_back_is_the_same_one():
    place = Place(np.random.default_rng(3), count=20)
    a, _ = all_in_view(place, 0)
    taken = place.truth.pop(4)
    b, _ = all_in_view(place, 1)
    site = merge_sessions([a, b])[0].objects
    assert [o.id for o in site.gone] == [4]
    place.truth[4] = taken
    c, _ = all_in_view(place, 2)
    (island,) = merge_sessions([Sees("site", site), c])
    again = there(island.objects, taken[1])
    assert again.id == 4
    assert again.life.state == "confirmed"
    assert not island.objects.gone


def test_sessions_of_two_places_are_two_islands():
    one, two = Place(np.random.default_rng(4), count=20), Place(np.random.default_rng(5), count=20)
    sessions = [quiet(one, 0)[0], quiet(two, 1)[0], quiet(one, 2)[0], quiet(two, 3)[0], quiet(one, 4)[0]]
    islands = merge_sessions(sessions)
    assert [island.sessions for island in islands] == [(0, 2, 4), (1, 3)]
    for island, place in zip(islands, (one, two), strict=True):
        if place is one:
            assert all(there(island.objects, at) for _, at in place.truth.values())
        assert len(island.objects) <= 20
    assert not compare(sessions[0], sessions[1]).changes


def test_all_at_once_is_as_good_as_one_after_the_other():
    place = Place(np.random.default_rng(6), count=25)
    days = [quiet(place, day) for day in range(5)]
    (at_once,) = merge_sessions([day for day, _ in days])
    site = days[0][0]
    for day, _ in days[1:]:
        site = Day("site", merge_sessions([site, day])[0].objects)
    for objects in (at_once.objects, site.objects):
        off = [np.linalg.norm(there(objects, at).position - at) for _, at in place.truth.values()]
        assert len(objects) == 25
        assert np.sqrt(np.mean(np.square(off))) < 0.045  # A session alone has 0.052 m, of which 0.02 m are its frame.
    own = np.array([frame for _, frame in days])
    np.testing.assert_allclose(at_once.site_T_session[:, :3, 3], own[:, :3, 3], atol=0.15)
    assert (np.diagonal(at_once.covariance, axis1=1, axis2=2)[1:] > 0).all()


def test_an_empty_session_stays_alone():
    place = Place(np.random.default_rng(7), count=12)
    islands = merge_sessions([quiet(place, 0)[0], Day("nothing", ObjectMap(()))])
    assert sorted(len(island.objects) for island in islands)[0] == 0


@pytest.mark.parametrize("sigma", [0.01, 0.05])
def test_a_covariance_is_never_below_that_of_the_best_session(sigma):
    place = Place(np.random.default_rng(8), count=20)
    days = []
    for day in range(3):
        seen, _ = quiet(place, day)
        cov = sigma**2 * np.eye(3) * (1 + day)
        days.append(Day(seen.name, ObjectMap(tuple(replace(o, covariance=cov) for o in seen.objects))))
    for o in merge_sessions(days)[0].objects:
        assert o.sigma >= 0.999 * sigma


def as_large_as(day, size, sigma):
    """A session whose map is too large by this share, and says that its size has this standard deviation."""
    shared = np.diag([0.05, 0.05, 0.02, 1e-3, 1e-3, 0.01, sigma]) ** 2
    moves = jacobian(day.objects.positions * (1 + size))
    spread = day.objects.covariances + moves @ shared @ np.swapaxes(moves, 1, 2)
    found = zip(day.objects, day.objects.positions * (1 + size), spread, strict=True)
    objects = tuple(replace(o, position=at, covariance=cov) for o, at, cov in found)
    return Day(day.name, replace(day.objects, objects=objects, shared_covariance=shared))


def test_a_site_takes_the_size_of_the_session_that_knows_it():
    """Two sessions are 3 % and 1 % too large, as they say they may be. A third knows its size, and joins their site."""
    place = Place(np.random.default_rng(9), count=25)
    days = [quiet(place, day)[0] for day in range(3)]
    first = [as_large_as(days[0], 0.03, 0.02), as_large_as(days[1], 0.01, 0.02)]
    last = as_large_as(days[2], 0.0, 0.001)

    def size(objects):
        found = [there(objects, at, 0.6).position for _, at in place.truth.values()]
        return align(np.array([at for _, at in place.truth.values()]), np.array(found), "sim2")[1]

    (site,) = merge_sessions(first)
    assert size(site.objects) == pytest.approx(1.02, abs=0.004)
    sigma = np.sqrt(site.objects.shared_covariance[6, 6])
    assert 0.0195 < sigma < 0.022  # One robot may repeat its error, so two sessions are not surer than one.
    for sessions in ([Day("site", site.objects), last], [*first, last]):
        (island,) = merge_sessions(sessions)
        assert size(island.objects) == pytest.approx(1.0, abs=0.004)
        assert np.sqrt(island.objects.shared_covariance[6, 6]) < 0.005
        for o in island.objects:
            part = jacobian(o.position) @ island.objects.shared_covariance @ jacobian(o.position).T
            assert np.linalg.eigvalsh(o.covariance - part).min() > -1e-9


def test_sessions_in_any_order_give_one_site():
    """Only the frame differs, which is that of the first session."""
    place = Place(np.random.default_rng(10), count=20)
    days = [session(place, day)[0] for day in range(6)]
    (site,) = merge_sessions(days)
    for order in ([5, 4, 3, 2, 1, 0], [3, 0, 5, 1, 4, 2]):
        (other,) = merge_sessions([days[k] for k in order])
        pose = site.site_T_session[order[0]]
        again = other.objects.positions @ pose[:3, :3].T + pose[:3, 3]
        for _, at in place.truth.values():
            here = there(site.objects, at).position
            assert np.linalg.norm(again - here, axis=1).min() < 1e-5


def test_a_session_costs_one_registration(monkeypatch):
    from objslam.mapping.sites import placement

    place, calls = Place(np.random.default_rng(11), count=15), []
    days = [quiet(place, day)[0] for day in range(6)]
    monkeypatch.setattr(placement, "register", lambda a, b: calls.append(1) or register(a, b))
    assert len(merge_sessions(days)) == 1
    assert len(calls) == len(days) - 1


def test_a_bridge_joins_what_was_seen_before_it():
    """Two sessions of the two ends of a hall share nothing. A third one saw its middle."""
    place, days = Place(np.random.default_rng(12), count=60, size=16.0), []
    for day, (low, high) in enumerate([(0, 7), (9, 16), (3, 13)]):
        whole = place.truth
        place.truth = {k: one for k, one in whole.items() if low <= one[1][0] <= high}
        days.append(quiet(place, day))
        place.truth = whole
    apart = merge_sessions([day for day, _ in days[:2]])
    assert [len(island.sessions) for island in apart] == [1, 1]
    (island,) = merge_sessions([day for day, _ in days])
    assert island.sessions == (0, 1, 2)
    own = np.array([frame for _, frame in days])
    np.testing.assert_allclose(island.site_T_session[:, :3, 3], own[:, :3, 3], atol=0.15)
    assert np.isnan(island.log_odds).tolist() == [True, False, False]


def test_a_session_of_a_place_that_looks_alike_does_not_bend_the_site():
    """A session of another place has eight objects that stand to each other as eight of the site do, and is placed there."""
    place = Place(np.random.default_rng(13), count=25)
    days = [quiet(place, day)[0] for day in range(4)]
    (alone,) = merge_sessions(days)
    other, rng = Place(np.random.default_rng(14), count=20, size=40.0), np.random.default_rng(15)
    corner = sorted(place.truth.values(), key=lambda one: float(np.hypot(*one[1][:2])))[:8]
    for label, at in corner:
        other.truth[100 + len(other.truth)] = (label, at + rng.normal(0, 0.03, 3))
    (island,) = [one for one in merge_sessions([*days, quiet(other, 4)[0]]) if 0 in one.sessions]
    assert island.sessions == (0, 1, 2, 3, 4)  # No evidence is against it: it saw eight objects where they should be.
    moved = [there(island.objects, at).position - there(alone.objects, at).position for _, at in place.truth.values()]
    assert np.sqrt(np.mean(np.sum(np.square(moved), axis=1))) < 0.01  # A third of the noise of one session.


def test_a_merge_is_one_graph_of_all_measurements():
    """Each session measures objects from several poses, in units of its own that its robot knows to 0.4 %. One least-squares
    problem over all these measurements gives the same map."""
    rng, again = np.random.default_rng(16), 0.01  # m, what each map adds to the errors of its objects.
    place, views, sigma, size_sigma = Place(rng, count=12, size=6.0), 5, 0.02, 0.004
    ids, truth = list(place.truth), np.array([at for _, at in place.truth.values()])
    raw, days = [], []
    for day in range(3):
        whole, own = all_in_view(place, day)
        frame, size = inverse(own), [0.006, -0.002, 0.003][day]
        at = np.linspace([0, 0, 0], [4, 2, 0], views)  # The path in the session's own units: no error but its size.
        local = (truth @ frame[:3, :3].T + frame[:3, 3]) * (1 + size)
        seen = local + rng.normal(0, sigma / 20, (views, len(ids), 3)) - at[:, None]
        raw.append((at, seen, inverse(frame)))
        place_of = (seen + at[:, None]).mean(axis=0)
        shared = np.zeros((7, 7))
        shared[6, 6] = size_sigma**2
        spread = sigma**2 / views * np.eye(3) + size_sigma**2 * place_of[:, :, None] * place_of[:, None, :]
        found = (replace(o, position=p, covariance=c) for o, p, c in zip(whole.objects, place_of, spread, strict=True))
        days.append(Sees(whole.name, ObjectMap(tuple(found), shared_covariance=shared)))

    def residuals(z):
        points, sizes, frames = z[:36].reshape(12, 3), z[36:39], np.vstack([np.zeros(4), z[39:].reshape(2, 4)])
        parts = [sizes / size_sigma]
        for (at, seen, _), size, (x, y, h, yaw) in zip(raw, sizes, frames, strict=True):
            pose = lift_se2(np.array([x, y, yaw]))
            inside = (points - [x, y, h]) @ pose[:3, :3] * (1 + size)
            parts.append(((inside - at[:, None] - seen) / np.hypot(sigma, np.sqrt(views) * again)).ravel())
        return np.concatenate(parts)

    starts = [[*own[:3, 3], np.arctan2(own[1, 0], own[0, 0])] for _, _, own in raw[1:]]
    batch = least_squares(residuals, np.concatenate([truth.ravel(), np.zeros(3), *starts]), xtol=1e-12, ftol=1e-12)
    expected = batch.x[:36].reshape(12, 3)
    (island,) = merge_sessions(days)
    got = np.array([island.objects.by_id(k).position for k in ids])
    np.testing.assert_allclose(got, expected, atol=3e-4)
    moved = np.linalg.norm(got - days[0].objects.positions, axis=1)
    assert moved.max() > 0.02  # The sizes move the objects a hundred times as far as that tolerance.
