"""Things in a row whose flanks are hidden by what stands between them: their depth does not show."""

from __future__ import annotations

import numpy as np
import pytest
from mapping.hiding_drives import Solid, hiding_drive

from objslam.config import Settings, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.object_map import ObjectMap
from objslam.core.types import Log
from objslam.evaluation.evaluate import INSIDE_95_3D, evaluate
from objslam.mapping import pipeline
from objslam.mapping.bodies import fitting

SETTINGS = load_settings(None, ("mode=fixed", "output.recording=false", "checks.use=false"))
CRATES, SPACING = 8, 1.4
HALF = np.array([0.55, 0.4, 0.4])


def rack(*, panels: bool, depth: float = 1.0) -> list[Solid]:
    """Crates in a row, 3 m beside the path. panels: whether boards without a box, as deep as a crate, stand between them.
    depth: of the crates, as a share of the usual depth. Their fronts stay in line."""
    half = HALF * [1.0, depth, 1.0]
    y = 3.0 - HALF[1] + half[1]
    solids = [Solid("cuboid", "crate", np.array([SPACING * k, y, HALF[2]]), half, 0.0) for k in range(CRATES)]
    board = np.array([0.04, HALF[1], 1.2])
    if panels:
        solids += [Solid("cuboid", None, np.array([SPACING * (k - 0.5), 3.0, 1.2]), board, 0.0) for k in range(CRATES + 1)]
    return solids


def past_it(frames: int = 90) -> np.ndarray:
    """Poses (F, 3): past the rack, with a camera that looks ahead and aside, and back in the same way."""
    x = np.linspace(-3.0, SPACING * CRATES + 2.0, frames)
    there = np.column_stack([x, np.zeros(frames), np.full(frames, np.radians(50))])
    return np.concatenate([there, np.column_stack([x[::-1], np.full(frames, 0.1), np.full(frames, np.radians(130))])])


def mapped(log: Log, settings: Settings = SETTINGS) -> tuple[ObjectMap, np.ndarray]:
    """The map, and the squared Mahalanobis errors of its objects."""
    result = pipeline.run(log, settings, Ledger())
    return result.map, np.array([m.squared_3d for m in evaluate(result.map, log.truth, radius=1.0).objects.matches])


def without_flanks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitting, "hidden_flanks", lambda edges, axes: np.zeros((len(axes), 6, 6)))


def test_crates_whose_flanks_are_hidden_are_as_unsure_as_they_may_be_deep(monkeypatch: pytest.MonkeyPatch) -> None:
    log = hiding_drive(3, noise=1.0, solids=rack(panels=True), plane=past_it())
    _, squared = mapped(log)
    assert len(squared) == CRATES
    assert (squared <= INSIDE_95_3D).mean() >= 0.8
    without_flanks(monkeypatch)
    _, squared = mapped(log)
    assert (squared <= INSIDE_95_3D).mean() <= 0.7


def test_crates_whose_flanks_show_are_as_sure_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    log = hiding_drive(3, noise=1.0, solids=rack(panels=False)[::2], plane=past_it())
    found, squared = mapped(log)
    assert (squared <= INSIDE_95_3D).mean() >= 0.8
    without_flanks(monkeypatch)
    before, _ = mapped(log)
    for a, b in zip(found.objects, before.objects, strict=True):
        np.testing.assert_allclose(a.covariance, b.covariance)


def test_a_flat_thing_by_itself_is_a_flat_thing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing beside it could hide its flanks."""
    log = hiding_drive(3, noise=1.0, solids=rack(panels=False, depth=0.15)[::4], plane=past_it())
    found, squared = mapped(log)
    assert (squared <= INSIDE_95_3D).all()
    without_flanks(monkeypatch)
    before, _ = mapped(log)
    for a, b in zip(found.objects, before.objects, strict=True):
        np.testing.assert_allclose(a.covariance, b.covariance)


def test_a_flat_thing_that_was_seen_from_behind_is_flat(monkeypatch: pytest.MonkeyPatch) -> None:
    there = past_it()
    behind = there * [1.0, 1.0, -1.0] + [0.0, 6.0, 0.0]
    log = hiding_drive(3, noise=1.0, solids=rack(panels=False, depth=0.15), plane=np.concatenate([there, behind]))
    found, _ = mapped(log)
    without_flanks(monkeypatch)
    before, _ = mapped(log)
    for a, b in zip(found.objects, before.objects, strict=True):
        np.testing.assert_allclose(a.covariance, b.covariance)


def test_a_flat_thing_of_a_known_size_has_no_hidden_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    log = hiding_drive(3, noise=1.0, solids=rack(panels=True, depth=0.15), plane=past_it())
    size = {"crate": tuple((2 * HALF * [1.0, 0.15, 1.0]).tolist())}
    known = SETTINGS.model_copy(update={"bodies": SETTINGS.bodies.model_copy(update={"sizes": size})})
    found, squared = mapped(log, known)
    assert (squared <= INSIDE_95_3D).mean() >= 0.8
    unknown, _ = mapped(log)
    without_flanks(monkeypatch)
    before, _ = mapped(log, known)
    for a, b, c in zip(found.objects, before.objects, unknown.objects, strict=True):
        assert a.covariance is not None
        assert c.covariance is not None
        np.testing.assert_allclose(a.covariance, b.covariance)
        assert np.trace(a.covariance) < np.trace(c.covariance)
