"""Mode auto at a localisation without odometry: if it errs for seconds, the rays alone tell the poses."""

from dataclasses import replace

import numpy as np
import pytest
from lasting_localization import with_lasting
from test_phantoms import two_objects

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.noise import NoiseFactors
from objslam.core.types import Log
from objslam.mapping import joint_solve, pipeline
from objslam.mapping.moves.phantoms import UNTOLD, check_neighbours
from objslam.mapping.stages import second_solve
from objslam.simulation import PoseNoise, preset, simulate

QUIET = ("bodies.use=false", "output.recording=false")


def drive(jumps: bool) -> Log:
    """Three and a half minutes among twelve things of three labels. The localisation errs for four seconds at a time, or
    steps to a new error every four seconds, as a particle filter does that follows wheels and then corrects itself."""
    log = simulate(
        preset(
            "demo",
            odometry=None,
            objects=12,
            classes=3,
            frames=200,
            false=0.0,
            pixel_sigma=1.0,
            localization=PoseNoise(xy=0.005, yaw=0.001),
        ),
        3,
    )
    if not jumps:
        return with_lasting(log, 5.0, 4.0, 3)
    path, rng = log.localization, np.random.default_rng(6)
    part = ((path.stamps - path.stamps[0]) // 4).astype(np.int64)
    off = rng.normal(0, 0.15, (part.max() + 1, 2))[part]
    poses = path.poses.copy()
    poses[:, :2, 3] += off
    return replace(log, localization=replace(path, poses=poses))


def mapped(log: Log, *overrides: str) -> tuple[str, tuple[int, int, int]]:
    """The mode of a run, which chooses it by default, and the numbers of right, false and missed things. A right object is
    within 0.2 m, and within its sigmas: the squared Mahalanobis distance is below 16.3, the quantile of 99.9 %."""
    result = pipeline.run(log, load_settings(None, (*QUIET, *overrides)), Ledger())
    free, right = list(log.truth.objects), 0
    for item in result.map.resolved():
        off = {t.id: item.position - t.position for t in free if t.label == item.label}
        near = min(off, key=lambda i: np.linalg.norm(off[i]), default=None)
        if near is None or np.linalg.norm(off[near]) > 0.2:
            continue
        if off[near] @ np.linalg.solve(item.covariance, off[near]) < 16.3:
            right, free = right + 1, [t for t in free if t.id != near]
    return result.summary["mode"], (right, len(result.map.resolved()) - right, len(free))


@pytest.mark.parametrize("jumps", [False, True])
def test_poses_that_err_for_seconds_are_solved_without_odometry(jumps, monkeypatch):
    """A log whose localisation steps often has the finding that it jumps. The steps are errors that last for seconds.

    The first association was at poses that err, so it begins anew at the solved poses. The search for phantoms needs the
    motions that odometry measures."""
    calls, anew = [], joint_solve._anew
    monkeypatch.setattr(joint_solve, "_anew", lambda state: calls.append(state) or anew(state))
    monkeypatch.setattr(joint_solve, "without_phantoms", lambda state: pytest.fail("phantoms were searched"))
    mode, numbers = mapped(drive(jumps))
    assert mode == "joint"
    assert numbers == (12, 0, 0)  # In fixed mode (6, 6, 6) and (7, 5, 5).
    (state,) = calls
    assert max(state.errors.noise.lasting_factors) > 1


def test_given_poses_stay_if_no_solve_may_find_their_noise():
    """The findings are the same, but the sizes of the errors are not estimated."""
    assert mapped(drive(jumps=False), "noise.localization=false")[0] == "fixed"


@pytest.mark.parametrize(("heading", "labels", "told"), [(1.0, [0, 0], True), (3.0, [0, 0], False), (1.0, [0, 1], False)])
def test_errors_that_only_the_given_poses_show_are_named(heading, labels, told):
    """Two objects of one label may be one thing, and hide the errors. Two labels hide nothing."""
    solution = two_objects(labels, NoiseFactors(heading=heading), odometry=False)
    settings, earlier = load_settings(None, ()), (0.008, 0.02)
    found = check_neighbours(solution, None, settings, earlier)
    assert (found is not None and found.name == UNTOLD) == told
    assert check_neighbours(solution, None, settings) is None


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("mostly_doubtful", "many objects at the localised poses are doubtful"),
        ("maps_things_twice", "many things are in the map twice at the localised poses"),
    ],
)
def test_auto_solves_the_poses_too_if_the_map_at_them_is_doubtful(name, reason, monkeypatch):
    """Localised poses that err slowly show each thing at another place in each visit. The boxes of a visit agree."""
    log = simulate(preset("demo"), 3)
    log = replace(log, odometry=None)
    ledger = Ledger()
    assert pipeline.run(log, load_settings(None, QUIET), ledger).summary["mode"] == "fixed"
    monkeypatch.setattr(second_solve, name, lambda result: result.summary["mode"] == "fixed")
    solved = pipeline.run(log, load_settings(None, QUIET), ledger)
    assert solved.summary["mode"] == "joint"
    assert any(reason in one for one in ledger.lines())
    held = load_settings(None, (*QUIET, "mode=fixed"))
    assert pipeline.run(log, held, Ledger()).summary["mode"] == "fixed"


def test_an_interrupted_solve_of_the_poses_leaves_the_map_at_the_given_poses(monkeypatch):
    log = replace(simulate(preset("demo"), 3), odometry=None)
    settings = load_settings(None, QUIET)
    first = pipeline.run(log, settings, Ledger())
    monkeypatch.setattr(second_solve, "mostly_doubtful", lambda result: result.summary["mode"] == "fixed")

    def interrupted(stage: str, done: int, total: int) -> None:
        if stage.startswith("poses too"):
            raise KeyboardInterrupt

    ledger = Ledger()
    result = pipeline.run(log, settings, ledger, interrupted)
    assert result.summary["mode"] == "fixed"
    assert [one.position.tolist() for one in result.map.objects] == [one.position.tolist() for one in first.map.objects]
    assert any("interrupted, so this is the map at the given poses" in one for one in ledger.lines())
