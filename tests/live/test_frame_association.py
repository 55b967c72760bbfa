"""Who a box may be of: near what was seen just now, and after a long way only where no other could be meant."""

from types import SimpleNamespace

import numpy as np
import pytest

from objslam.association.observations import Observations
from objslam.config import load_settings
from objslam.core.geometry import adjoint, exp_se3, inverse, make_pose
from objslam.live.counters import Counters
from objslam.live.mapper.frame_association import FrameRays, match
from objslam.live.mapper.landmark_table import LandmarkTable, predict_landmarks
from objslam.live.mapper.maintenance import _one, _second_objects
from objslam.live.mapper.pose_uncertainty import PoseUncertainty
from objslam.live.mapper.track_promotion import prune_tracks, try_promote
from objslam.live.mapper.tracks import Track, update_positions

AHEAD = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
SIGMA = 0.004


def landmarks(positions, labels):
    known = LandmarkTable()
    for i, (position, label) in enumerate(zip(positions, labels, strict=True)):
        known.add(
            id=[i], position=[position], information=[np.eye(3) * 1e4], label=[label], drift=np.zeros((1, 6, 6)),
            first=[0.0], last=[0.0], seen=[30], expected=[30], far=[6.0], squared=[60.0], rejected=[0],
        )  # fmt: skip
    return known


def rays(targets, label=0, size=0.0):
    """Rays to targets (n, 3), m. size: m, of the things in their boxes, 0 if the camera sees no sizes."""
    local = np.asarray(targets) @ AHEAD[:3, :3]
    count = len(local)
    nothing, one = np.full(count, np.nan), np.ones(count)
    away = np.linalg.norm(local, axis=1, keepdims=True)
    sizes, labels = np.tile(np.reshape(size, (-1, 1)), 2) / away, np.full(count, label)
    return FrameRays(
        local / away, one * SIGMA, nothing, nothing, labels, one, np.zeros((count, 4)), sizes, np.full(count, -1)
    )


def uncertainty(heading, place=np.nan):
    """heading: the sigma (rad) of the drift since the landmarks were seen. place: that (m, rad) of the pose in the map."""
    drift = np.diag([1e-8, 1e-8, heading**2, 1e-6, 1e-6, 1e-8])
    return PoseUncertainty(drift, adjoint(inverse(AHEAD)), np.eye(6) * place**2)


def found(known, target, heading, place=np.nan, tracks=()):
    targets = [target] if np.ndim(target) == 1 else target
    return match(rays(targets), AHEAD, predict_landmarks(known, tracks), uncertainty(heading, place), 2, 0.99, {}).tolist()


def match_of(known, seen, tracks=()):
    """The indices of the landmarks and tracks of rays, where the pose is certain."""
    return match(seen, AHEAD, predict_landmarks(known, tracks), uncertainty(1e-4), 2, 0.999, {}).tolist()


HALL = [(5.0, 0.0, 0.5), *((x, y, 0.5) for x in (-8.0, 0.0, 8.0, 14.0) for y in (-8.0, -5.0, 5.0, 8.0))]


def test_a_landmark_seen_just_now_is_matched_among_many():
    assert found(landmarks(HALL, [0] * len(HALL)), (5.0, 0.05, 0.5), 0.02) == [0]


def sized(known, sizes):
    """Give landmarks usual sizes (n,), m."""
    known.sized[:], known.ln_size[:], known.size_variance[:] = 30, np.log(np.reshape(sizes, (-1, 1))), 0.1**2
    return known


@pytest.mark.parametrize("first", [0.0, 0.02])
def test_a_box_between_two_landmarks_is_of_the_one_of_its_size(first):
    """A large thing behind a small one, whose centres the noise of bearings hides. first: m, which one the bearing is at."""
    places, sizes = np.array([(4.0, 0.0, 0.5), (6.0, 0.03, 0.75)]), (0.15, 0.8)
    known, off = landmarks(places, [0, 0]), np.array([0.0, first, 0.0])
    blind = match_of(known, rays([places[0] + off], size=0.15))
    assert blind == [int(first > 0)]  # No landmark has a size yet.
    sized(known, sizes)
    assert match_of(known, rays([places[0] + off], size=0.15)) == [0]
    assert match_of(known, rays([places[0] + off], size=0.8 * 4 / 6)) == [1]  # `size` is that at 4 m.
    assert match_of(known, rays([places[0] + off])) == blind  # The camera sees no sizes.


def test_a_size_alone_takes_no_box_from_its_landmark():
    """Neither a track, which has no size, nor a new landmark gets the box, though half the thing is hidden."""
    known, one = sized(landmarks([(5.0, 0.0, 0.5)], [0]), [0.8]), track(np.zeros((6, 6)))
    one.position = np.array([5.0, 0.05, 0.5])
    for hidden in (0.8, 0.2, 0.02):
        assert match_of(known, rays([(5.0, 0.01, 0.5)], size=hidden), [one]) == [0]


def turned(points, angle):
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(points) @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def test_after_a_long_way_only_where_nothing_unknown_could_be_meant():
    many, few = landmarks(HALL, [0] * len(HALL)), landmarks(HALL, [0] + [1] * (len(HALL) - 1))
    off = turned(HALL[0], 0.05)
    assert found(many, off, 0.15) == [-1]
    assert found(many, off, 0.15, place=0.01) == [-1]  # the pose is certain, and this is too far off
    assert found(many, HALL[0], 0.15, place=0.01) == [0]
    assert found(few, off, 0.15) == [0]
    assert found(few, off, 1.5) == [-1]  # so large a drift may also hide unknown objects


def test_several_that_one_drift_explains_are_trusted_together():
    near = [(5.0, 0.0, 0.5), (4.0, 1.5, 0.9), (4.5, -1.5, 0.2)]
    known = landmarks([*near, *HALL[1:]], [0] * (len(HALL) + 2))
    off = turned(near, 0.05)
    assert found(known, off, 0.15) == [0, 1, 2]
    off[1] = turned(near[1], -0.2)
    assert found(known, off, 0.15) == [0, -1, 2]  # the odd one is something else


def track(drift):
    one = Track(0, 0, False, 0.0, 0.0, drift)
    one.position, one.covariance = np.array([5.0, 0.0, 0.5]), np.eye(3) * 1e-4
    one.rays = [(0, 0, np.zeros(3), SIGMA, np.nan, np.nan)]
    return one


def test_a_track_is_given_up_after_a_long_way_unless_the_camera_knows_where_it_is():
    known, one = landmarks([], []), track(np.zeros((6, 6)))
    assert found(known, (5.0, 0.01, 0.5), 0.01, tracks=[one]) == [0]
    assert found(known, (5.0, 0.01, 0.5), 0.07, tracks=[one]) == [-1]
    assert found(known, (5.0, 0.01, 0.5), 0.07, place=0.01, tracks=[one]) == [0]


class Still:
    """Keyframes on a line across the view, 1 cm apart."""

    def pose(self, k):
        return np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.01 * k], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@pytest.mark.parametrize(("width", "count", "born"), [(45, 45, True), (15, 15, False), (45, 4, False), (100, 20, True)])
def test_a_track_becomes_a_landmark_as_soon_as_it_is_sure(width, count, born):
    """At 5 m, a baseline of 1 cm gives 0.11 degrees. 45 cm give 5 degrees, which is less than joint.min_parallax_deg."""
    graph, rng = Still(), np.random.default_rng(0)
    one = Track(0, 0, False, 0.0, 0.0, np.zeros((6, 6)))
    for number, k in enumerate(np.linspace(0, width, count).astype(int).tolist()):
        pose = graph.pose(k)
        local = pose[:3, :3].T @ (np.array([5.0, 0.2, 0.3]) - pose[:3, 3]) / 5.0 + rng.normal(0, SIGMA, 3)
        one.extend((number, k, local / np.linalg.norm(local), SIGMA, np.nan, np.nan), pose, 0.0, one.drift)
    met = try_promote(one, graph, load_settings(None, ()), rng)
    assert (met is not None) == born
    if met is not None:
        off = met.position - [5.0, 0.2, 0.3]
        assert off @ np.linalg.solve(met.covariance, off) < 25


def test_the_place_of_a_track_is_honest_where_frames_were_predicted_badly():
    """The graph corrects a pose when its frame has a localisation, or boxes of landmarks."""
    graph, rng, squared = Still(), np.random.default_rng(0), list[float]()
    for _ in range(20):
        one = Track(0, 0, False, 0.0, 0.0, np.zeros((6, 6)))
        for k in range(0, 60, 5):
            true, noise = graph.pose(k), rng.normal(0, SIGMA, 3)
            local = true[:3, :3].T @ (np.array([4.0, 0.2, 0.3]) - true[:3, 3]) / 4.0 + noise
            predicted = true @ exp_se3(np.array([0, rng.normal(0, 5 * SIGMA), 0, 0, 0, 0]))
            one.extend((k, k, local / np.linalg.norm(local), SIGMA, np.nan, np.nan), predicted, 0.0, one.drift)
            update_positions([one], graph)
        off = one.position - [4.0, 0.2, 0.3]
        squared.append(off @ np.linalg.solve(one.covariance, off))
    assert np.mean(squared) < 5  # 3, for as many variables
    assert max(squared) < 16.27


def test_landmarks_are_one_where_they_are_near_and_few():
    spread = np.eye(3) * 0.1**2
    assert _one(np.array([0.1, 0.0, 0.0]), spread, 0.03)
    assert not _one(np.array([0.1, 0.0, 0.0]), spread, 3.0)
    assert not _one(np.array([0.5, 0.0, 0.0]), spread, 0.03)
    assert not _one(np.array([0.5, 0.0, 0.0]), spread * 100, 0.5)


def lines(targets, sigma=0.004, reach=6.0):
    """One ray to each of the targets (n, 3), from a place on the way from -reach to reach along y, with noise."""
    rng = np.random.default_rng(0)
    origin = np.column_stack([np.zeros(len(targets)), np.linspace(-reach, reach, len(targets)), np.zeros(len(targets))])
    to = np.asarray(targets) - origin
    direction = to / np.linalg.norm(to, axis=1, keepdims=True) + rng.normal(scale=sigma, size=to.shape)
    nothing = np.full(len(to), np.nan)
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return Observations.of_lines(origin, unit, np.full(len(to), sigma), nothing, nothing)


def two(s, support, at, drift=1.0):
    """Whether rays, at a keyframe each, show two objects. support: which rays fit the object at `at`, (3,) m.

    drift: the standard deviation, m, that the path accumulates from one keyframe to the next.
    """
    count = len(support)
    number = np.arange(count)
    keyframes = SimpleNamespace(
        id=number,
        stamp=number.astype(float),
        drift=drift**2 * number[:, None, None] * np.diag([0.0, 0, 0, 1, 1, 1]),
        camera_T_start=np.tile(np.eye(4), (count, 1, 1)),
    )
    session = SimpleNamespace(
        landmarks=landmarks([at], [0]),
        keyframes=keyframes,
        rays=SimpleNamespace(keyframe=number),
        graph=SimpleNamespace(pose=lambda k: make_pose(np.eye(3), s.origin[k])),
        settings=load_settings(None, ()),
        rng=np.random.default_rng(0),
    )
    row, named = np.zeros(count, dtype=np.int64), np.ones(1, dtype=bool)
    assert not _second_objects(session, s, number, row, np.array(support), ~named)
    found = _second_objects(session, s, number, row, np.array(support), named)
    for second in found:
        assert second.row == 0
        np.testing.assert_array_equal(second.rays, np.flatnonzero(~np.array(support)))
    return bool(found)


def test_a_label_has_two_objects_where_what_disagrees_makes_another_one():
    one, other = (3.0, 0.0, 0.5), (5.0, 2.0, 0.5)
    in_turns = np.arange(40) // 5 % 2 == 0
    turns = [one if here else other for here in in_turns]
    assert two(lines(turns), in_turns, one)
    assert not two(lines([one] * 20 + [other] * 20), np.arange(40) < 20, one)  # not in turns: the path may have drifted
    assert not two(lines(turns, reach=0.1), in_turns, one)  # from one place it has no distance: the first may be wrong
    strays = np.random.default_rng(1).uniform([1, -8, -8], [17, 8, 8], (40, 3))
    assert not two(lines(np.where(in_turns[:, None], one, strays)), in_turns, one)


@pytest.mark.parametrize(("drift", "parts"), [(0.02, True), (0.1, True), (0.3, False)])
def test_a_label_has_two_objects_where_no_drift_explains_their_distance(drift, parts):
    """The objects are 2.8 m apart, and each is seen once. Five times 0.3 m explain that."""
    one, other = (3.0, 0.0, 0.5), (5.0, 2.0, 0.5)
    assert two(lines([one] * 20 + [other] * 20), np.arange(40) < 20, one, drift) == parts


def test_a_crowd_of_candidates_leaves_room_for_those_of_other_labels():
    def candidate(i, label, last, count):
        one = Track(i, label, False, 0.0, last, np.zeros((6, 6)))
        one.rays = [None] * count
        return one

    few = [candidate(i, 0, 1.0, 1) for i in range(20)]
    grown = [candidate(i, 1, 1.0, 9) for i in range(20, 25)]
    crowd = [candidate(i, 1, 2.0, 1) for i in range(25, 425)]
    counters = Counters()
    m = SimpleNamespace(tracks=[*few, *grown, *crowd], settings=load_settings(None, ()), counters=counters)
    prune_tracks(m)
    assert m.tracks[:25] == [*few, *grown]
    assert len(m.tracks) == 150
    assert counters.accepted() == {"tracks given up": 275}
    prune_tracks(m)
    assert len(m.tracks) == 150
    assert counters.accepted() == {"tracks given up": 275}
