"""The growing graph against the batch solve of the same factors."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from drives import ODOMETRY_ALONE, drive_of, make_drive

from objslam.association.observations import Observations
from objslam.association.single_object_fit import fit_point
from objslam.config import Settings, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import exp_se3, inverse
from objslam.errors import SolveError
from objslam.graph.factors.odometry import motions
from objslam.graph.factors.rays import Bearings
from objslam.graph.isam2 import IncrementalGraph
from objslam.graph.optimizers import levenberg_marquardt
from objslam.graph.posterior.marginals import SolvedGraph, largest_sigma, marginal_covariances, seen_covariances
from objslam.graph.variables import X0, landmarks_in, make_values, read_poses
from objslam.simulation import preset, simulate


@pytest.fixture(scope="module")
def drive():
    return make_drive(0, "mode=joint", frames=150, false=0.0, **ODOMETRY_ALONE)


def bearings(drive, which):
    rays, owner = drive.rays.take(which), drive.association.object[which]
    return Bearings(which, rays.keyframe, owner, rays.direction, rays.sigma, rays.range, rays.range_sigma)


def grown(drive):
    """A graph that has taken the drive keyframe by keyframe, landmarks where their rays meet once parallax says where."""
    graph, motion = IncrementalGraph(drive.settings), motions(drive.keyframes, drive.settings)
    waiting, known = {j: [] for j in range(len(drive.points))}, set()
    pose = drive.keyframes.map_T_camera[0]
    for k in range(len(drive.keyframes)):
        if k:
            pose = graph.pose(k - 1) @ motion[0][k - 1]
        graph.add_keyframe(k, pose)
        if k:
            graph.add_motion(k - 1, k, motion[0][k - 1], motion[1][k - 1])
        else:
            graph.add_anchor(0, pose)
        for r in np.flatnonzero(drive.rays.keyframe == k).tolist():
            j = int(drive.association.object[r])
            waiting[j].append(r)
            if j in known:
                graph.add_rays(bearings(drive, np.array([r])))
                continue
            b = bearings(drive, np.array(waiting[j]))
            poses = np.array([graph.pose(i) for i in b.keyframe])
            ahead = np.einsum("rij,rj->ri", poses[:, :3, :3], b.direction)
            s = Observations.of_lines(poses[:, :3, 3], ahead, b.sigma, b.range, b.range_sigma)
            met = fit_point(s, np.random.default_rng(0), 0.02) if len(s) >= 5 else None
            if met is not None and met.parallax > np.radians(8) and met.inlier.all():
                known.add(j)
                graph.add_landmark(j, met.position)
                graph.add_rays(b)
        graph.update()
        graph.prepare(np.array(sorted(known), dtype=np.int64), relinearise=k % 10 == 0)
    assert len(known) >= 10
    assert graph.rebuilds == 0
    return graph, np.array(sorted(known))


def batch(drive, graph, landmarks):
    whole = graph._store.graph()
    values = make_values(drive.keyframes.map_T_camera, drive.points, landmarks)
    return whole, levenberg_marquardt(whole, values, 100, 1e-10).values


def test_it_ends_where_the_batch_solve_does(drive):
    graph, landmarks = grown(drive)
    for _ in range(8):
        graph.prepare(np.arange(0), relinearise=True)
    graph.refresh()
    _, values = batch(drive, graph, landmarks)
    np.testing.assert_allclose(graph.points(landmarks), landmarks_in(values)[1], atol=0.02)
    graph.solve(50)  # to the very minimum
    graph.refresh()
    np.testing.assert_allclose(graph.points(landmarks), landmarks_in(values)[1], atol=2e-3)
    np.testing.assert_allclose(graph.poses(np.arange(len(drive.keyframes))), read_poses(values), atol=2e-3)


def test_single_iterations_end_where_a_solve_does(drive):
    graph, landmarks = grown(drive)
    saved = graph.save()
    graph.solve(50)
    expected = graph.points(landmarks)
    graph.restore(saved)
    fell = [graph.iterate() for _ in range(8)]
    assert fell[0] > fell[-1] >= 0
    np.testing.assert_allclose(graph.points(landmarks), expected, atol=2e-3)
    graph.rebuild()
    graph.refresh()
    np.testing.assert_allclose(graph.points(landmarks), expected, atol=2e-3)


def test_covariances_are_those_of_the_batch_solve(drive):
    graph, landmarks = grown(drive)
    graph.solve(50)
    whole, values = batch(drive, graph, landmarks)
    expected = marginal_covariances(SolvedGraph(whole, values), landmarks, Ledger())
    found = np.array([graph.point_covariance(j) for j in landmarks.tolist()])
    np.testing.assert_allclose(found, expected, rtol=0.05, atol=1e-6)
    held = drive.association.object
    newest = np.array([drive.rays.keyframe[held == j].max() for j in landmarks])
    seen = np.array([graph.seen_covariance(j, k) for j, k in zip(landmarks.tolist(), newest.tolist(), strict=True)])
    told = seen_covariances(SolvedGraph(whole, values), landmarks, newest, Ledger())
    np.testing.assert_allclose(seen, told, rtol=0.05, atol=1e-5)
    assert (largest_sigma(seen) < largest_sigma(found)).any()
    last = len(drive.keyframes) - 1
    assert np.linalg.eigvalsh(graph.pose_covariance(last))[0] > 0
    assert np.trace(graph.pose_covariance(0)) < np.trace(graph.pose_covariance(last))


def test_what_throws_is_rescued_from_the_factors_store(drive):
    graph, landmarks = grown(drive)
    graph.refresh()
    before = graph.points(landmarks)
    last = len(drive.keyframes) - 1
    loose = drive.keyframes.map_T_camera[last]
    graph.add_keyframe(last + 1, loose)  # held by one bearing alone
    one = bearings(drive, np.flatnonzero(np.isin(drive.association.object, landmarks))[-1:])
    graph.add_rays(replace(one, number=np.array([10_000]), keyframe=np.array([last + 1])))
    graph.update()
    assert graph.rebuilds == 1
    graph.refresh()
    np.testing.assert_allclose(graph.points(landmarks), before, atol=0.05)


def test_what_is_dropped_is_gone_and_saved_comes_back(drive):
    graph, landmarks = grown(drive)
    graph.refresh()
    saved, size, points = graph.save(), graph._store.graph().size(), graph.points(landmarks)
    mine = np.flatnonzero(drive.association.object == landmarks[0])
    graph.drop_rays(mine)
    graph.drop_landmarks(landmarks[:1])
    graph.rebuild()
    assert graph._store.graph().size() < size - 5
    graph.restore(saved)
    assert graph._store.graph().size() == size
    graph.refresh()
    np.testing.assert_allclose(graph.points(landmarks), points, atol=0.02)


def test_moved_as_a_whole(drive):
    graph, landmarks = grown(drive)
    graph.refresh()
    points, last = graph.points(landmarks), graph.pose(len(drive.keyframes) - 1)
    moved = exp_se3(np.array([[0.0, 0.0, 0.7, 3.0, -2.0, 0.0]]))[0]
    graph.drop_absolute()
    graph.move(moved)
    graph.add_anchor(0, graph.pose(0))
    graph.rebuild()
    graph.refresh()
    np.testing.assert_allclose(graph.points(landmarks), points @ moved[:3, :3].T + moved[:3, 3], atol=0.02)
    step = inverse(moved @ last) @ graph.pose(len(drive.keyframes) - 1)
    np.testing.assert_allclose(step, np.eye(4), atol=0.02)


def test_built_anew_in_turns_is_built_anew(drive, monkeypatch):
    monkeypatch.setattr("objslam.graph.isam2._AT_ONCE", 50)
    monkeypatch.setattr("objslam.graph.isam2._SLICE", 20)
    graph, landmarks = grown(drive)
    last = len(drive.keyframes) - 1
    gone, rest = np.flatnonzero(drive.association.object == landmarks[0]), landmarks[1:]
    graph.drop_rays(gone)
    graph.drop_landmarks(landmarks[:1])
    whole = IncrementalGraph(drive.settings)
    whole.restore(graph.save())
    whole.rebuild()
    old = graph._isam
    graph.rebuild_in_slices(np.arange(last + 1))
    motion, covariance = motions(drive.keyframes, drive.settings)
    for turn in range(-(-(last + 1) // 20)):  # as the drive goes on, with a keyframe and a ray in the middle of it
        assert graph._isam is old
        if turn == 2:
            step = motion[-1], covariance[-1]
            one = bearings(drive, np.flatnonzero(drive.association.object == rest[0])[-1:])
            for g in (graph, whole):
                g.add_keyframe(last + 1, g.pose(last) @ step[0])
                g.add_motion(last, last + 1, *step)
                g.add_rays(replace(one, number=np.array([10_000])))
                g.update()
        graph.continue_rebuild()
    graph.continue_rebuild()
    assert graph._isam is not old
    assert graph._replaced is not None  # To free the old tree takes time, and the last slice has other work.
    graph.continue_rebuild()
    assert graph._replaced is None
    assert graph._isam.getFactorsUnsafe().size() == whole._store.graph().size()
    for g in (graph, whole):
        for _ in range(3):
            g.prepare(np.arange(0), relinearise=True)
        g.refresh()
    np.testing.assert_allclose(graph.points(rest), whole.points(rest), atol=2e-3)
    every = np.arange(last + 2)
    np.testing.assert_allclose(graph.poses(every), whole.poses(every), atol=2e-3)


def test_what_came_while_built_in_turns_is_there_once(drive, monkeypatch):
    monkeypatch.setattr("objslam.graph.isam2._AT_ONCE", 50)
    monkeypatch.setattr("objslam.graph.isam2._SLICE", 100)
    graph, landmarks = grown(drive)
    last, new = len(drive.keyframes) - 1, int(landmarks[-1]) + 1
    graph.rebuild_in_slices(np.arange(last + 1))
    graph.continue_rebuild()
    assert graph.is_rebuilding
    ahead = replace(bearings(drive, np.flatnonzero(drive.rays.keyframe == last)[:1]), number=np.array([10_000]))
    graph.add_landmark(new, (graph.pose(last) @ [*(3.0 * ahead.direction[0]), 1.0])[:3])
    graph.add_rays(replace(ahead, landmark=np.array([new])))
    graph.continue_rebuild()  # the last, while these are not worked in
    assert not graph.is_rebuilding
    graph.prepare(np.array([new]))
    assert graph.rebuilds == 0
    assert graph._isam.getFactorsUnsafe().size() == graph._store.graph().size()


class Counting:
    """An iSAM2 that counts the variables that an update eliminated again."""

    def __init__(self, isam):
        self._isam, self.count = isam, 0.0

    def update(self, *given):
        result = self._isam.update(*given)
        self.count = result.getVariablesReeliminated() or np.inf  # it says 0 where it was nearly all of them
        return result

    def __getattr__(self, name):
        return getattr(self._isam, name)


def one_more(graph, drive, landmarks):
    """One more keyframe, which shows some landmarks where they are; how many variables it takes."""
    motion, covariance = motions(drive.keyframes, drive.settings)
    last = len(drive.keyframes) - 1
    pose = graph.pose(last) @ motion[-1]
    local = (graph.points(landmarks) - pose[:3, 3]) @ pose[:3, :3]
    some = bearings(drive, np.arange(len(landmarks)))
    graph.add_keyframe(last + 1, pose)
    graph.add_motion(last, last + 1, motion[-1], covariance[-1])
    direction = local / np.linalg.norm(local, axis=1)[:, None]
    number, keyframe = 10_000 + np.arange(len(landmarks)), np.full(len(landmarks), last + 1)
    graph.add_rays(replace(some, number=number, keyframe=keyframe, landmark=landmarks, direction=direction))
    graph._isam = counting = Counting(graph._isam)
    graph.update()
    return counting.count


@pytest.fixture(scope="module")
def round_trip():
    """A drive that comes back to what it has not seen for long."""
    room = {"room": (16.0, 12.0), "path": (2, 3), "objects": 60, "classes": 60, "laps": None, "min_view_share": 0.01}
    changes = {**room, **ODOMETRY_ALONE, "frames": 500, "frame_rate": 10.0, "speed": 0.8, "false": 0.0}
    return drive_of(simulate(preset("large", **changes), 5), load_settings(None, ("mode=joint", "rays.pixel_sigma=2")))


def test_what_is_prepared_for_takes_little(round_trip, monkeypatch):
    """So it does after a rebuild at once, and after one in slices, which is prepared for anew."""
    monkeypatch.setattr("objslam.graph.isam2._AT_ONCE", 50)
    drive = round_trip
    graph, landmarks = grown(drive)
    owner, keyframe, last = drive.association.object, drive.rays.keyframe, len(drive.keyframes) - 1
    latest = np.array([keyframe[owner == j].max() for j in landmarks])
    long_ago = landmarks[np.argsort(latest)[:5]]
    assert latest[np.argsort(latest)[4]] < last - 150
    coming = np.union1d(long_ago, landmarks[latest >= last - 20])

    def count(prepared, shown, rebuilt="not"):
        one = IncrementalGraph(drive.settings)
        one.restore(graph.save())
        if prepared:
            one.prepare(coming, relinearise=True)
        if rebuilt == "at once":
            one.rebuild()
        if rebuilt == "in slices":
            one.rebuild_in_slices(np.arange(last + 1))
            while one.is_rebuilding:
                one.continue_rebuild()
            one.prepare(coming)
        before = one.points(landmarks)
        result = one_more(one, drive, shown)
        np.testing.assert_allclose(one.points(landmarks), before, atol=5e-3)
        return result

    for j in (0, 4):
        assert count(True, long_ago[[j]]) <= len(coming) + 6 < count(False, long_ago[[j]]) / 3
        for rebuilt in ("at once", "in slices"):
            assert count(True, long_ago[[j]], rebuilt) <= len(coming) + 6, rebuilt


def test_a_graph_that_cannot_be_built_says_so_on_one_line(monkeypatch):
    """What GTSAM throws, not made up, has nine lines."""

    def throws(self, graph):
        nothing = gtsam.PriorFactorPose3((X0 + 0), gtsam.Pose3(), gtsam.noiseModel.Diagonal.Sigmas(np.full(6, np.inf)))
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(nothing)
        values = gtsam.Values()
        values.insert((X0 + 0), gtsam.Pose3())
        gtsam.Marginals(graph, values)

    graph = IncrementalGraph(Settings())
    graph.add_keyframe(0, np.eye(4))
    graph.add_anchor(0, np.eye(4))
    monkeypatch.setattr(IncrementalGraph, "_fill", throws)
    with pytest.raises(RuntimeError, match="\n") as thrown:
        throws(None, None)
    assert len(str(thrown.value).strip().splitlines()) > 5
    with pytest.raises(SolveError) as told:
        graph.rebuild()
    assert len(str(told.value).splitlines()) == 1
    assert "x0" in told.value.message
    assert "Thrown when" not in str(told.value)
    assert told.value.hint
