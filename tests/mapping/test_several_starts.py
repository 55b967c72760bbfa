"""The search from several starts: which of them are searched, and when it ends."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from log_parts import without_names

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.noise import NoiseFactors
from objslam.core.types import Association
from objslam.errors import SolveError
from objslam.mapping import joint_solve, pipeline, several_starts
from objslam.mapping.joint.by_label import Named
from objslam.mapping.joint.joint_alternation import JointState
from objslam.mapping.several_starts import _Found
from objslam.simulation import preset, simulate

OTHER = (0, 0, 0, 1)
"""The objects of four rays, other than those of a `Map` by default."""


@dataclass(frozen=True)
class Map:
    """A map with its log evidence, the objects of its rays, the noise of its rays, and whether they agree."""

    explained: float
    spent: bool = False
    objects: tuple[int, ...] = (0, 0, 1, 1)
    noise: float = 1.0
    agrees: bool = True

    @property
    def association(self):
        return Association(np.array(self.objects), np.zeros(2, dtype=np.int64))

    @property
    def rays(self):
        return self.objects

    @property
    def agree(self):
        return np.full(len(self.objects), self.agrees)

    @property
    def errors(self):
        return SimpleNamespace(noise=NoiseFactors(rays=self.noise))

    keyframes = None

    def gain(self, other):
        return other.explained - self.explained

    def better(self, other):
        return other if self.gain(other) > 0 else self


@pytest.mark.parametrize(
    ("first", "searched", "expected"),
    [(90.0, None, (100.0, 150.0)), (110.0, 140.0, (110.0, 150.0)), (110.0, 160.0, (110.0, 160.0))],
    ids=["a worse start is not searched", "a search that leads to less", "a search that leads to more"],
)
def test_only_a_start_with_a_better_first_map_is_searched(monkeypatch, first, searched, expected):
    """Two first maps are compared. The map after the first search has more evidence than both."""
    search = (lambda one: pytest.fail("it was searched")) if searched is None else (lambda one: Map(searched))
    monkeypatch.setattr(several_starts, "_searched", search)
    start = Map(first, objects=OTHER)
    found = _Found(Map(100.0), Map(150.0)).after(lambda: start)
    assert (found.first.explained, found.state.explained) == expected
    assert found.left == ((start,) if searched is None else ())


def test_a_start_with_the_objects_of_the_best_map_is_never_searched(monkeypatch):
    """A search from there would lead to the same map."""
    monkeypatch.setattr(several_starts, "_searched", lambda one: pytest.fail("it was searched"))
    monkeypatch.setattr(several_starts, "_unclear", lambda one, confirmed: True)
    found = _Found(Map(100.0), Map(150.0)).after(lambda: Map(90.0))
    assert found.confirmed
    assert found.with_the_others().state.explained == 150.0


def test_the_other_starts_are_searched_at_last(monkeypatch):
    """The best of them is searched first. The search of a start that cannot be solved loses no map. A first map that
    explains far less than the best map is hopeless."""
    searched = []

    def search(one):
        searched.append(one.explained)
        if one.explained == 130.0:
            raise SolveError("the loop bends the path too far")
        return Map(one.explained + 10)

    monkeypatch.setattr(several_starts, "_searched", search)
    monkeypatch.setattr(several_starts, "_unclear", lambda one, confirmed: True)
    found = _Found(Map(148.0), Map(150.0))
    for explained in (125.0, 145.0, 130.0, 119.0):
        found = found.after(lambda explained=explained: Map(explained, objects=OTHER))
    assert not searched
    assert found.with_the_others().state.explained == 155.0
    assert searched == [145.0, 130.0, 125.0]


@pytest.mark.parametrize(
    ("noise", "objects", "agrees", "unclear"),
    [
        (1.7, (0, 0, 1, 1), True, False),
        (1.7, (1, 1, 0, 0), True, False),
        (1.7, OTHER, True, True),
        (3.6, (0, 0, 1, 1), True, True),
        (1.0, (0, 0, 1, 1), False, True),
    ],
    ids=["the same objects", "in another order", "other objects", "wrong maps have such noise", "rays that do not agree"],
)
@pytest.mark.parametrize("by_names", [True, False])
def test_a_noisy_map_is_clear_if_another_start_finds_its_objects(monkeypatch, noise, objects, agrees, unclear, by_names):
    """The other start is the map by names, or a start whose first map is no better."""
    monkeypatch.setattr(several_starts, "associate_tracks", lambda keyframes, rays: Association(np.full(4, -1), np.zeros(0)))
    monkeypatch.setattr(several_starts, "largest_copy_in", lambda state: 0)
    found = _Found(Map(100.0), Map(150.0, noise=noise, agrees=agrees))
    assert found.unclear
    other = Map(90.0, objects=objects)
    found = found.compared(other) if by_names else found.after(lambda: other)
    assert found.unclear == unclear


@pytest.mark.parametrize(("objects", "unclear"), [((0, 0, 1, 1), False), (OTHER, True)], ids=["the same", "others"])
@pytest.mark.parametrize("explained", [140.0, 160.0], ids=["it explains less", "it explains more"])
def test_a_noisy_map_is_clear_if_the_search_of_another_start_ends_at_its_objects(monkeypatch, explained, objects, unclear):
    """The first map of the start is better than that of the first exploration, so it is searched at once."""
    monkeypatch.setattr(several_starts, "associate_tracks", lambda keyframes, rays: Association(np.full(4, -1), np.zeros(0)))
    monkeypatch.setattr(several_starts, "largest_copy_in", lambda state: 0)
    monkeypatch.setattr(several_starts, "_searched", lambda first: replace(first, explained=explained))
    found = _Found(Map(100.0), Map(150.0, noise=1.7)).after(lambda: Map(110.0, noise=1.7, objects=objects))
    assert found.state.explained == max(150.0, explained)
    assert found.unclear == unclear


@dataclass(frozen=True)
class Begin:
    """A log before its first association."""

    ledger: Ledger
    effort: object = None

    def attempt(self):
        return self

    def replaced(self, other):
        return other


@pytest.mark.parametrize(("moves", "tried"), [(False, True), (True, False)])
def test_an_exploration_that_fails_loses_no_map_of_a_known_start(monkeypatch, moves, tried):
    """Without a known start, the failure is an error. Where things move, other starts are not tried."""
    ledger, explorations = Ledger(), []

    def fail(state):
        explorations.append(state)
        ledger.drop("boxes of the exploration")
        raise SolveError("the path is torn")

    monkeypatch.setattr(several_starts, "with_errors_of_tracks", fail)
    monkeypatch.setattr(several_starts, "from_start", lambda state, known: known)
    monkeypatch.setattr(several_starts, "_searched", lambda one: one)
    monkeypatch.setattr(several_starts, "_unclear", lambda one, confirmed: True)
    monkeypatch.setattr(several_starts, "_has_things_that_move", lambda one: moves)
    ended = Map(100.0)
    assert several_starts.from_several_starts(Begin(ledger), ended) == ended
    assert bool(explorations) == tried
    assert not ledger.dropped
    with pytest.raises(SolveError, match="torn"):
        several_starts.from_several_starts(Begin(ledger))


def test_a_search_ends_after_its_solves(monkeypatch):
    """A log whose map stays unclear is tried from all starts, or until the solves are taken."""
    monkeypatch.setattr(several_starts, "_unclear", lambda state, confirmed: True)
    solves, solve_once = [], JointState.solve_once
    monkeypatch.setattr(JointState, "solve_once", lambda state, *of, **by: solves.append(1) or solve_once(state, *of, **by))
    log = without_names(simulate(preset("demo", objects=6, frames=80, localization=None, odometry=Odometry(), false=0.0), 1))
    taken, told = [], []
    for most in (1000, 3):
        solves.clear()
        settings = load_settings(
            None, ("mode=joint", "output.recording=false", "bodies.use=false", f"joint.max_solves={most}")
        )
        summary = pipeline.run(log, settings, Ledger()).summary
        taken.append(len(solves))
        told.append(
            (summary["unfinished_search"], any("joint.max_solves" in one for one in summary["assessment"]["reasons"]))
        )
    assert told == [(False, False), (True, True)]
    assert taken[1] < taken[0]


@pytest.mark.parametrize("stage", ["most likely path", "explore", "association"])
def test_an_interrupted_search_leaves_the_best_map_so_far(monkeypatch, stage):
    """The interrupt comes in the first search, in a further exploration, or in the rounds of a further start."""
    monkeypatch.setattr(several_starts, "_unclear", lambda state, confirmed: True)
    log = without_names(simulate(preset("demo", objects=6, frames=80, localization=None, odometry=Odometry(), false=0.0), 1))
    settings = load_settings(None, ("mode=joint", "output.recording=false", "bodies.use=false"))
    seen, stages = [], []

    def interrupted(said: str, done: int, total: int) -> None:
        stages.append(said)
        if said.startswith("most likely path"):
            seen.append(said)
        if seen and said.startswith(stage) and not any(one.startswith("interrupted") for one in stages):
            raise KeyboardInterrupt

    result = pipeline.run(log, settings, Ledger(), interrupted)
    at = next(number for number, said in enumerate(stages) if said.startswith("interrupted"))
    assert not any(said.startswith(("explore", "most likely path")) for said in stages[at:])
    assert result.summary["unfinished_search"]
    assert any("Ctrl-C" in reason for reason in result.summary["assessment"]["reasons"])
    found = result.map.positions
    truth = np.stack([one.position for one in log.truth.objects])
    near = np.linalg.norm(found[:, None] - truth, axis=2).min(axis=1)
    assert len(found) == 6
    assert (near < 0.5).all()  # The odometry of the short drive is all that holds the map.


def test_a_second_interrupt_ends_the_run(monkeypatch):
    monkeypatch.setattr(several_starts, "_unclear", lambda state, confirmed: True)
    log = without_names(simulate(preset("demo", objects=6, frames=80, localization=None, odometry=Odometry(), false=0.0), 1))
    settings = load_settings(None, ("mode=joint", "output.recording=false", "bodies.use=false"))

    def interrupted(said: str, done: int, total: int) -> None:
        if said.startswith(("most likely path", "interrupted")):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pipeline.run(log, settings, Ledger(), interrupted)


def test_a_search_begins_without_the_errors_of_a_map_by_names(monkeypatch):
    """One object for several things bends the path, and its noise and turn scale would bend the path of the search."""
    begun, search, solved = [], joint_solve.from_several_starts, joint_solve.by_label

    def wrong(state):
        named = solved(state).state
        return Named(replace(named, errors=named.errors.with_noise(replace(named.errors.noise, turning=20.0))), False)

    monkeypatch.setattr(joint_solve, "by_label", wrong)
    monkeypatch.setattr(joint_solve, "from_several_starts", lambda state, *more: begun.append(state) or search(state, *more))
    log = simulate(preset("demo", objects=4, frames=80, localization=None, odometry=Odometry(), false=0.0), 1)
    assert len({one.label for one in log.truth.objects}) == 4
    settings = load_settings(None, ("mode=joint", "output.recording=false", "bodies.use=false"))
    pipeline.run(log, settings, Ledger())
    assert [state.errors.noise.turning for state in begun] == [1.0]
    assert begun[0].estimate is begun[0].association is None
