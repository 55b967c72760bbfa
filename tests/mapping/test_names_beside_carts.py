"""Labels that are names, in logs where another robot has a label too: it drives, so no place agrees with its boxes."""

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from driving_cart import with_cart_that_drives

from objslam.config import Odometry, load_settings
from objslam.core.arrays import Bools
from objslam.core.diagnostics import Ledger
from objslam.core.types import Association, Log
from objslam.errors import SolveError
from objslam.graph import batch_solver
from objslam.mapping import joint_solve, pipeline, several_starts
from objslam.mapping.joint import by_label, doubted_labels
from objslam.simulation import preset, simulate

pytestmark = pytest.mark.usefixtures("one_start")
QUIET = ("mode=joint", "output.recording=false", "checks.use=false", "bodies.use=false", "calibration.use=false")
"""Without what does not decide which boxes belong together."""


@cache
def drive(seed: int) -> Log:
    """Twelve things with names of their own, and a cart that drives around."""
    noise = {"pixel_sigma": 1.0, "odometry": Odometry(), "localization": None, "false": 0.0}
    shape = {"objects": 12, "classes": 12, "frames": 200, "laps": 2, "room": (8.0, 6.0)}
    return with_cart_that_drives(simulate(preset("demo", **noise, **shape), seed), seed)


def mapped(log: Log) -> pipeline.RunResult:
    return pipeline.run(log, load_settings(None, QUIET), Ledger())


def with_some(log: Log, left: Bools) -> Log:
    """The log with some of its boxes (B,)."""
    camera = log.cameras[0]
    return replace(log, cameras=(replace(camera, detections=camera.detections.take(left)),))


def seldom_detected(log: Log, label: int, number: int) -> Log:
    """The log with a few boxes of a label, in frames spread over the drive."""
    found = log.cameras[0].detections
    mine = np.flatnonzero(found.label == label)
    kept = mine[np.linspace(0, len(mine) - 1, number).round().astype(int)]
    return with_some(log, (found.label != label) | np.isin(np.arange(len(found.label)), kept))


def things(log: Log) -> Counter[str]:
    return Counter(o.label for o in log.truth.objects)


def found(result: pipeline.RunResult) -> Counter[str]:
    return Counter(o.label for o in result.map.resolved())


def recorded_names(monkeypatch: pytest.MonkeyPatch) -> list[Association | None]:
    """The labels that runs find to be names, in a list that grows with each run."""
    names, ask = [], by_label.known_names

    def recorded(solved):
        names.append(ask(solved))
        return names[-1]

    monkeypatch.setattr(by_label, "known_names", recorded)
    return names


def test_things_that_are_seldom_detected_keep_their_names() -> None:
    """Their boxes agree with one place each, but a search expects far more boxes of a thing."""
    log = seldom_detected(seldom_detected(drive(0), 0, 6), 1, 6)
    assert found(mapped(log)) == things(log)


def test_frames_that_show_only_the_cart_are_not_in_the_graph_that_grows(monkeypatch: pytest.MonkeyPatch) -> None:
    """They would count as steps of its growth, and so lead it elsewhere than without the cart."""
    boxes = drive(2).cameras[0].detections
    cart = boxes.label == boxes.label_names.index("cart")
    alone = np.unique(boxes.frame[cart])[::3]
    log = with_some(drive(2), cart | ~np.isin(boxes.frame, alone))
    grown, grow = [], batch_solver.initialize_known

    def recorded(measured, *given):
        grown.append(len(measured.keyframes))
        return grow(measured, *given)

    monkeypatch.setattr(batch_solver, "initialize_known", recorded)
    assert found(mapped(log)) == things(log)
    named = len(np.unique(boxes.frame[~cart & ~np.isin(boxes.frame, alone)]))
    assert named + len(alone) in grown
    assert min(grown) == named


def test_a_doubt_does_not_take_the_names_from_labels_without_clear_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the doubted labels, nothing shows the path. The comparison with an exploration fails here."""

    def every(rays, association, *_):
        return association.label

    def fail(*_):
        raise SolveError("the linear system has no single solution")

    for module in (by_label, doubted_labels):
        monkeypatch.setattr(module, "doubted_labels", every)
    monkeypatch.setattr(several_starts, "explored", fail)
    result = mapped(drive(0))
    assert found(result) == things(drive(0))
    assert set(result.summary["doubted_labels"]) == set(things(drive(0)))


@pytest.mark.parametrize("clear", [False, True])
def test_clear_evidence_decides_about_doubted_labels(clear: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One label is doubted, so the path is known without it. The rounds look for its objects."""
    monkeypatch.setattr(by_label, "doubted_labels", lambda rays, association, *_: association.label[association.label == 3])
    odds = 100.0 if clear else -100.0
    chosen, choose = [], joint_solve._with_several_a_label

    def recorded(state, named, other):
        chosen.append((choose(state, named, other), named, other))
        return chosen[-1][0]

    monkeypatch.setattr(joint_solve, "has_several", lambda other, named: True)
    monkeypatch.setattr(joint_solve, "evidence_against", lambda named, other: odds)
    monkeypatch.setattr(joint_solve, "_with_several_a_label", recorded)
    result = mapped(drive(0))
    ((state, named, other),) = chosen
    assert 3 in named.names.label
    assert 3 not in other.names.label
    assert state.names is (other if clear else named).names
    assert found(result) == things(drive(0))


def test_labels_are_no_names_if_one_of_them_shows_two_things(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its second thing has few boxes, in frames that show the first one too. Rounds may then give labels several objects."""
    names = recorded_names(monkeypatch)
    mapped(drive(0))
    assert names.pop().count == 12
    boxes = drive(0).cameras[0].detections
    seen = np.zeros((len(boxes.frame_stamps), len(boxes.label_names)), dtype=bool)
    seen[boxes.frame, boxes.label] = True
    together = (seen.T.astype(int) @ seen)[:12, :12]
    np.fill_diagonal(together, 0)
    keep, other = (int(i) for i in np.unravel_index(np.argmax(together), together.shape))
    both = np.flatnonzero(seen[:, keep] & seen[:, other])
    left = (boxes.label != other) | np.isin(boxes.frame, both[:: max(len(both) // 7, 1)])
    camera = drive(0).cameras[0]
    label = np.where(boxes.label == other, keep, boxes.label)
    log = with_some(replace(drive(0), cameras=(replace(camera, detections=replace(boxes, label=label)),)), left)
    mapped(log)
    assert names == [None]


def test_a_label_of_a_few_boxes_is_no_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Among so few, a box with a wrong name would hardly be noticed."""
    names = recorded_names(monkeypatch)
    mapped(seldom_detected(drive(0), 1, 4))
    cart = 5  # Labels are in the order of the alphabet.
    assert set(range(13)) - set(names[0].label.tolist()) == {1, cart}
