"""Equal things in groups at a localisation whose headings err for seconds, so that rays of several things meet."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from lasting_localization import with_lasting

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.noise import NoiseFactors
from objslam.core.types import Association, Log
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import joint_solve, pipeline
from objslam.mapping.checks.finding import NEIGHBOURS
from objslam.mapping.joint.joint_alternation import Effort
from objslam.mapping.moves import phantoms
from objslam.mapping.moves.phantoms import BENT, check_neighbours
from objslam.simulation import DriveSettings, PoseNoise, simulate

ALONE = ("bodies.use=false", "calibration.use=false", "output.recording=false")
"""Nothing here depends on bodies, and the simulated camera has no errors."""
MIDDLES = ((-2.0, 1.5), (2.2, 1.2), (0.3, -2.2), (-0.5, 2.4))


def drive(seed: int) -> Log:
    """Two and a half minutes between four pairs of equal things, each pair 0.25 m apart."""
    rng, placed = np.random.default_rng(100 + seed), []
    for x, y in MIDDLES:
        angle = rng.uniform(0, np.pi)
        placed += [("thing", (x + 0.25 * k * np.cos(angle), y + 0.25 * k * np.sin(angle), 0.3)) for k in range(2)]
    settings = DriveSettings(
        name="pairs",
        room=(8.0, 8.0),
        frames=150,
        frame_rate=1.0,
        speed=0.3,
        objects=0,
        placed=tuple(placed),
        pixel_sigma=2.0,
        missed=0.1,
        odometry=Odometry(),
        localization=PoseNoise(xy=0.01, yaw=0.002),
        max_range=5.0,
    )
    return simulate(settings, seed)


def turned(log: Log, seed: int) -> Log:
    """The log with headings that err by 3 degrees for 20 s at a time. Places stay."""
    path = log.localization
    bad = with_lasting(log, np.radians(3.0) / 0.005, 20.0, seed).localization.poses
    bad[:, :3, 3] = path.poses[:, :3, 3]
    return replace(log, localization=replace(path, poses=bad))


def mapped(log: Log, *overrides: str) -> tuple[tuple[int, int, int], list[str]]:
    """The numbers of right, false and missed objects, and the names of the findings. A right object is within 0.3 m of its
    thing."""
    settings = load_settings(None, ("mode=joint", *ALONE, *overrides))
    result = pipeline.run(log, settings, Ledger())
    told = evaluate(result.map, log.truth, None, align="none", radius=0.3).to_dict()
    return (told["matched"], told["false"], told["missed"]), [one["name"] for one in result.summary["wrong_input"]]


def two_objects(labels: list[int], noise: NoiseFactors, *, odometry: bool) -> SimpleNamespace:
    """What `check_neighbours` reads of a solution with two objects 4 m apart, at a localisation."""
    poses = np.broadcast_to(np.eye(4), (2, 4, 4))
    return SimpleNamespace(
        keyframes=SimpleNamespace(localized_every=1.0, odom_T_base=poses if odometry else None),
        rays=SimpleNamespace(keyframe=np.array([0, 1])),
        association=SimpleNamespace(object=np.array([0, 1]), label=np.array(labels), count=2),
        estimate=SimpleNamespace(
            noise=noise,
            weight=np.ones(2),
            map_T_base=poses,
            positions=np.array([[2.0, 2.0, 0.0], [2.0, -2.0, 0.0]]),
            covariance=np.broadcast_to(1e-4 * np.eye(3), (2, 3, 3)),
        ),
    )


@pytest.mark.long
def test_no_objects_are_left_where_rays_of_several_things_meet(monkeypatch):
    """Without the search for phantoms, the map of this drive has them, although each ray fits its object. Things that are
    nearer than the poses err are named."""
    log = turned(drive(0), 0)
    numbers, findings = mapped(log)
    assert numbers == (8, 0, 0)
    assert NEIGHBOURS in findings
    for name in ("has_lasting_errors", "begins_with_lasting_errors"):
        monkeypatch.setattr(joint_solve, name, lambda state: False)
    assert mapped(log, "checks.use=false")[0][1] > 0


class Begun(Exception):
    """Ends a run where the search for phantoms begins."""


@pytest.fixture(scope="module")
def begun():
    """The state of a run from which the search for phantoms begins."""

    def begin(state):
        raise Begun(state)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(joint_solve, "without_phantoms", begin)
        with pytest.raises(Begun) as ended:
            mapped(turned(drive(0), 0), "checks.use=false")
    return ended.value.args[0]


@pytest.mark.parametrize("coarse", [False, True])
def test_no_object_is_tried_where_the_path_search_is_too_coarse(begun, monkeypatch, coarse):
    tried = []
    monkeypatch.setattr(phantoms, "_without", lambda state, j: tried.append(j))
    if coarse:
        monkeypatch.setattr(phantoms, "_COARSE", -np.inf)
    phantoms.without_phantoms(begun)
    assert len(tried) == (0 if coarse else 8)


@pytest.mark.parametrize("left", [0, 5, 1000])
def test_the_search_ends_with_the_solves_of_the_run(begun, monkeypatch, left):
    """A user limits the time of a run by `joint.max_solves`. The verdict says that the search was not finished."""
    tried, without = [], phantoms._without
    monkeypatch.setattr(phantoms, "_without", lambda state, j: tried.append(j) or without(state, j))
    most = begun.settings.joint.max_solves
    found = phantoms.without_phantoms(replace(begun, effort=Effort(most - left)))
    assert found.unfinished == (left < 1000)
    assert (len(tried) == 0) if left == 0 else (0 < len(tried) < 8) if left == 5 else (len(tried) >= 8)


def test_a_good_localisation_takes_no_time_for_phantoms(monkeypatch):
    def searched(state):
        raise AssertionError("phantoms were searched")

    monkeypatch.setattr(joint_solve, "without_phantoms", searched)
    assert mapped(drive(0)) == ((8, 0, 0), [])


@pytest.mark.parametrize(("turning", "labels", "told"), [(3.5, [0, 0], True), (1.5, [0, 0], False), (3.5, [0, 1], False)])
def test_a_path_that_may_be_bent_to_false_objects_is_named(turning, labels, told):
    """Only if a map at the given poses showed that they err. Things 4 m apart are not exchanged by errors of 0.2 degrees."""
    solution = two_objects(labels, NoiseFactors(turning=turning), odometry=True)
    settings, earlier = load_settings(None, ()), (0.004, 0.017)
    found = check_neighbours(solution, None, settings, earlier)
    assert (found is not None and found.name == BENT) == told
    assert check_neighbours(solution, None, settings) is None


@pytest.mark.parametrize(("lost", "solved"), [(0, True), (2, True), (3, False), (4, False)])
def test_a_map_without_an_object_is_solved_only_if_its_rays_have_others(monkeypatch, lost, solved):
    """Rays without an object explain the log worse, so the object is no phantom."""
    owner = np.array([0, 0, 0, 0, 1, 1, 0])
    state = SimpleNamespace(
        association=Association(owner, np.zeros(2, dtype=np.int64)),
        agree=np.array([True] * 6 + [False]),
    )
    left = np.where((owner == 0) & (np.arange(7) < lost), -1, 1)

    class Search:
        def __init__(self):
            self.state = state

        def found(self, without):
            assert without == 0
            return np.zeros((0, 4, 4)), Association(left, state.association.label)

    monkeypatch.setattr(phantoms, "_solved_along", lambda of, path, association: association)
    found = phantoms._without(Search(), 0)
    assert (found is not None) == solved


@pytest.mark.parametrize("solves", [1000, 3])
def test_the_phantom_with_the_largest_gain_is_dropped_first(monkeypatch, solves):
    """Against a search that tries all objects after each drop. A drop lowers the gains of the objects that share rays."""
    alone = np.array([5.0, -1.0, 9.0, 8.0, 3.0, 8.5, np.nan, 2.0])
    shared = np.zeros((8, 8))
    shared[2, 3] = shared[3, 2] = shared[2, 5] = shared[5, 2] = 8.2
    shared[0, 5] = shared[5, 0] = -0.5
    tried = []

    class State(SimpleNamespace):
        @property
        def spent(self):
            return len(tried) >= solves

    def state(gone):
        explained = sum(alone[i] for i in gone) - sum(shared[i, j] for i in gone for j in gone if i < j)
        place = np.where(np.isin(np.arange(8), list(gone))[:, None] | (np.arange(8) == 7)[:, None], np.nan, np.zeros((8, 3)))
        return State(gone=gone, explained=explained, progress=lambda *_: None, estimate=SimpleNamespace(positions=place))

    def without(search, j):
        tried.append(j)
        return None if np.isnan(alone[j]) else state(search.state.gone | {j})

    monkeypatch.setattr(phantoms, "_without", without)
    monkeypatch.setattr(phantoms.Relocalization, "of", lambda of: SimpleNamespace(state=of))
    begin = state(frozenset())
    found, unfinished = phantoms._without_least_likely(begin, SimpleNamespace(state=begin), np.arange(8))
    assert unfinished == (solves == 3)
    if solves == 3:
        assert len(tried) == 3
        return
    best = begin
    while True:
        others = [state(best.gone | {j}) for j in range(6) if j not in best.gone]
        if (most := max(others, key=lambda one: one.explained)).explained <= best.explained:
            break
        best = most
    assert found.gone == best.gone == {0, 2, 4, 5}
    assert 7 not in tried
    assert len(tried) < 15
