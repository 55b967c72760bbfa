"""Association and joint solve in turns: what allows for drift, and what the rays decide."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse, lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import Association
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.mapping.joint import relocalization
from objslam.mapping.joint.joint_alternation import Effort, JointState
from objslam.mapping.joint.relocalization import relocalized
from objslam.mapping.pipeline import run
from objslam.mapping.solution import objects_changed, seen_something
from objslam.simulation import DepthNoise, preset, simulate


def test_the_end_of_a_drive_finds_its_objects_again_after_a_turn_of_the_odometry():
    settings = load_settings(None, ("mode=joint", "output.recording=false", "calibration.use=false", "noise.odometry=false"))
    loose = {name: 6 * getattr(settings.odometry, name) for name in ("x_per_m", "y_per_m", "yaw_per_m", "yaw_per_rad")}
    settings = settings.model_copy(update={"odometry": settings.odometry.model_copy(update=loose)})
    log = simulate(preset("demo", objects=8, classes=2, frames=120, localization=None, odometry=Odometry(), false=0.0), 3)
    odometry, middle = log.odometry, np.median(log.odometry.stamps)
    late = odometry.stamps > middle
    pivot = odometry.poses[late][0]
    turned = odometry.poses.copy()
    turned[late] = pivot @ lift_se2(np.array([0.0, 0.0, 0.1])) @ inverse(pivot) @ turned[late]
    frames = build_keyframes(replace(log, odometry=Trajectory(odometry.stamps, turned)), settings, Ledger())
    rays = build_rays(log, frames, settings, Ledger())
    mine, mine_rays = seen_something(frames, rays)
    cameras = tuple(one.camera for one in log.cameras)
    state = JointState(frames, rays, mine, mine_rays, cameras, settings, Ledger(), lambda *_: None, None, None)

    early = mine.stamps[mine_rays.keyframe] <= middle
    first = state.alternated(mine.map_T_base, None).association
    cut = state.solve("association", replace(first, object=np.where(early, first.object, -1)))
    plain = cut.alternated(cut.estimate.map_T_base, (cut.association, cut.estimate.positions))
    followed = relocalized(cut)
    assert followed.association.count == 8
    assert followed.agree.all()
    assert plain.agree.mean() < 0.95


def taking_turns(monkeypatch, turns, errors=None):
    """A state whose rounds find these associations, and the list of whether each of its solves held the shared errors."""
    rays = SimpleNamespace(sigma=np.full(30, 0.01))
    keyframes = SimpleNamespace(base_T_camera=np.eye(4)[None])
    settings = load_settings(None, ("mode=joint", "output.recording=false"))
    begin = JointState(keyframes, rays, keyframes, rays, (), settings, Ledger(), lambda *_: None, None, errors)
    held = []

    def solve(state, why, association, start):
        held.append(state.hold)
        held_rays = int((association.object >= 0).sum())
        placed = {"positions": np.zeros((2, 3)), "covariance": np.stack([np.eye(3)] * 2), "solved": np.ones(2, dtype=bool)}
        estimate = SimpleNamespace(log_evidence=held_rays, map_T_base=np.eye(4)[None], **placed)
        return replace(state, association=association, estimate=estimate)

    monkeypatch.setattr(JointState, "associated", lambda state, *_, rough: turns[len(state.rounds)])
    monkeypatch.setattr(JointState, "merged", lambda state: state)
    monkeypatch.setattr(JointState, "solve", solve)
    return replace(begin, association=Association(np.full(30, -1), np.zeros(0, dtype=np.int64))), held


@pytest.fixture
def two():
    """Two associations of 30 rays, of which the second has an object more."""
    shared = np.zeros(20, dtype=np.int64)
    return [Association(np.append(shared, np.full(10, more)), shared[: 1 + (more > 0)]) for more in (-1, 1)]


@pytest.mark.parametrize("first", [0, 1])
def test_of_associations_that_take_turns_the_one_that_explains_more_rays_counts(monkeypatch, two, first):
    """Which one returns first is chance."""
    begin, _ = taking_turns(monkeypatch, [two[first], two[1 - first], two[first]])
    chosen = begin.alternated(np.eye(4)[None], None)
    assert chosen.unsettled == 0
    assert chosen.association is two[1]
    assert [one["rays_changed"] for one in chosen.rounds[1:]] == [10, 10]


@pytest.mark.parametrize(("turns", "expected"), [([0, 1], 1), ([0, 0], 0), ([1], 2)])
def test_rounds_that_end_too_early_count_the_objects_that_the_last_one_changed(monkeypatch, two, turns, expected):
    begin, _ = taking_turns(monkeypatch, [two[i] for i in turns])
    few = begin.settings.model_copy(update={"joint": begin.settings.joint.model_copy(update={"max_rounds": len(turns)})})
    assert replace(begin, settings=few).alternated(np.eye(4)[None], None).unsettled == expected


@pytest.mark.parametrize(("shift", "expected"), [(0.5, 0), (1.5, 1)])
def test_an_object_counts_as_changed_if_it_moves_by_more_than_its_sigma(shift, expected):
    """A ray goes from one object to the other, and the objects change their numbers."""
    sigma, places = 0.1, np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    covariance, solved = np.stack([sigma**2 * np.eye(3)] * 2), np.ones(2, dtype=bool)
    label = np.zeros(2, dtype=np.int64)
    moved = places[::-1] + np.array([[0.0, 0.0, 0.0], [0.0, shift * sigma, 0.0]])
    first, second = Association(np.array([0, 0, 0, 1, 1, -1]), label), Association(np.array([1, 1, 0, 0, 0, -1]), label)
    before, after = (
        SimpleNamespace(positions=positions, covariance=covariance, solved=solved) for positions in (places, moved)
    )
    assert objects_changed((first, before), (second, after)) == expected


@pytest.mark.parametrize(
    ("turns", "expected"),
    [
        ([1, 1], [False]),
        ([0, 1, 1, 1], [False, True, False]),
        ([0, 1, 0, 0, 1], [False, True, False]),
    ],
    ids=["found at once", "settles", "takes turns"],
)
def test_the_last_solve_estimates_the_shared_errors(monkeypatch, two, turns, expected):
    """The first solve estimates them. Later ones hold them, until the rounds end."""
    begin, held = taking_turns(monkeypatch, [two[i] for i in turns], errors=SimpleNamespace())
    monkeypatch.setattr(JointState, "explained", property(lambda state: (state.association.object >= 0).sum()))
    chosen = begin.alternated(np.eye(4)[None], None)
    assert chosen.unsettled == 0
    assert not chosen.hold
    assert held == expected


@pytest.mark.parametrize(("last", "expected"), [(201.0, 0), (199.0, 1)])
def test_a_last_round_that_ruins_a_map_does_not_count(monkeypatch, two, last, expected):
    """last: what the first of two rounds explains more than the second, and more than the last solve."""
    begin, held = taking_turns(monkeypatch, [two[0], two[1], two[1], two[1]], errors=SimpleNamespace())
    value = {one.count: evidence for one, evidence in zip(two, (1000.0, 1000.0 - last), strict=True)}
    monkeypatch.setattr(JointState, "explained", property(lambda state: value[state.association.count]))
    chosen = begin.alternated(np.eye(4)[None], None)
    assert chosen.association is two[expected]
    assert not chosen.hold
    assert held == [False, True, False] + [False] * (1 - expected)
    assert len(chosen.rounds) == 4


@pytest.fixture
def along_paths(monkeypatch):
    """A function that makes a state whose rounds along the most likely path find associations with these log evidences."""

    def make(evidences):
        names = [Association(np.full(30, i), np.zeros(i + 1, dtype=np.int64)) for i in range(len(evidences))]
        begin, held = taking_turns(monkeypatch, [], errors=SimpleNamespace())
        solve, value = JointState.solve, {one.count: evidence for one, evidence in zip(names, evidences, strict=True)}
        monkeypatch.setattr(JointState, "explained", property(lambda state: value[state.association.count]))
        monkeypatch.setattr(JointState, "_explained_like", lambda state, other: state.explained)
        monkeypatch.setattr(JointState, "associated", lambda state, *_, rough: names[state.association.count])
        monkeypatch.setattr(JointState, "alternated", lambda state, *_: state)
        search = SimpleNamespace(found=lambda: (np.eye(4)[None], None))
        monkeypatch.setattr(relocalization.Relocalization, "of", lambda _: search)
        monkeypatch.setattr(relocalization, "rays_moved", lambda *_: 30)
        keyframes = SimpleNamespace(base_T_camera=np.eye(4)[None], odom_T_base=np.eye(4)[None], localized_every=0.0)
        return solve(replace(begin, keyframes=keyframes, rays=range(30)), "association", names[0], None), held

    return make


@pytest.mark.parametrize(
    ("evidences", "expected", "solves"),
    [
        ([5, 6, 7, 1, 2, 9], 7, [False, True, False, True, False]),
        ([5, 1, 7, 8, 2, 3, 9], 8, [False, True, False, True, False]),
        ([5, 4, 3, 9], 5, [False, True]),
    ],
    ids=["held", "through a worse round", "none"],
)
def test_rounds_along_the_path_end_after_two_worse_ones_and_the_best_counts(along_paths, evidences, expected, solves):
    """Every second round holds the shared errors. They are estimated once more if the best round held them."""
    begin, held = along_paths(evidences)
    held.clear()
    found = relocalized(begin)
    assert found.explained == expected
    assert not found.hold
    assert held == solves
    spent = replace(begin, effort=Effort(begin.settings.joint.max_solves))
    assert relocalized(spent) is spent
    assert held == solves


@pytest.mark.parametrize(
    ("mine", "other", "wins"),
    [
        ((100.0, 111.0), (99.0, 110.0), False),
        ((100.0, 108.0), (102.0, 110.0), True),
        ((100.0, 30.0), (80.0, 60.0), False),
        ((60.0, 80.0), (100.0, 30.0), True),
    ],
    ids=[
        "wins at its own noise only",
        "wins",
        "is better at a noise at which both are bad",
        "is bad at the noise of the other",
    ],
)
def test_each_map_counts_at_the_noise_at_which_it_explains_more(monkeypatch, mine, other, wins):
    """mine, other: what each of two maps explains at the noise of the first and of the second map."""
    one = Association(np.zeros(30, dtype=np.int64), np.zeros(1, dtype=np.int64))
    errors = [SimpleNamespace(at=lambda theta, name=name: (None, name, None), name=name) for name in ("quiet", "noisy")]
    settings = load_settings(None)
    states = []
    for own, evidence in zip(errors, (mine[0], other[1]), strict=True):
        state = JointState(None, None, None, None, (), settings, Ledger(), None, None, own, np.zeros(1))
        states.append(replace(state, association=one, estimate=SimpleNamespace(log_evidence=evidence)))
    present, attempt = states
    told = {"quiet": SimpleNamespace(log_evidence=other[0]), "noisy": SimpleNamespace(log_evidence=mine[1])}
    monkeypatch.setattr(JointState, "solved_poses", None)
    monkeypatch.setattr(JointState, "solve_once", lambda state, association, errors, start: told[state.rays])
    assert (present.better(attempt) is not present) == wins


def test_an_odometry_far_noisier_than_the_settings_say_makes_no_second_map():
    """The first exploration gates by the noise of the settings, and finds some objects twice."""
    default = Odometry()
    noisy = {name: 4 * getattr(default, name) for name in type(default).model_fields if not name.startswith("floor")}
    changes = {"objects": 8, "classes": 2, "frames": 150, "frame_rate": 2.0, "pixel_sigma": 3.0, "missed": 0.0, "false": 0.0}
    changes |= {"odometry": default.model_copy(update=noisy), "depth": DepthNoise(), "localization": None}
    log = simulate(preset("demo", **changes), 7)
    told = ("mode=joint", "output.recording=false", "checks.use=false", "bodies.use=false", "calibration.use=false")
    result = run(log, load_settings(None, told), Ledger())
    score = evaluate(result.map, log.truth, result.path_after, align="se2", radius=1.0).to_dict()
    assert (score["matched"], score["false"]) == (8, 0)
    assert score["ate"] < 0.15
