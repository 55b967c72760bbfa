"""The end of a session gives objects the sigmas that an offline run gives them."""

from dataclasses import replace

import numpy as np
import pytest
from driving import feed
from mapping.hiding_drives import hiding_drive
from mapping.test_checks import drive
from mapping.test_depth_axis import driven, with_power
from mapping.test_moved_camera import turned
from quick import NOTHING_BESIDE
from wrong_inputs import MISTAKES

from objslam.config import load_settings
from objslam.errors import SolveError
from objslam.live.session import finalize
from objslam.live.session.session import Session
from objslam.mapping.stages import described
from objslam.simulation import preset, simulate

ODD, TIMES = 1, 4.0
QUIET = ("output.recording=false", *NOTHING_BESIDE)


@pytest.fixture(scope="module")
def ended():
    """The result of a session in which the rays of object `ODD` do not agree, and what its last stages got and returned."""
    made = {}

    def noted(name):
        given = getattr(described, name)

        def stage(first, *arguments, **named):
            made[name] = first, given(first, *arguments, **named)
            return made[name][1]

        return stage

    def disagreeing(objects, *more):
        found = find_misfits(objects, *more)
        odd = np.arange(len(objects)) == ODD
        return replace(found, odd=odd, times=np.where(odd, TIMES, found.times))

    find_misfits = described.find_misfits
    settings = load_settings(None, ("mode=joint", "noise.localization=false", *NOTHING_BESIDE))
    session = feed(Session(settings, patient=True).start(), hiding_drive(0, frames=150))
    with pytest.MonkeyPatch.context() as patch:
        for name in ("with_bodies", "with_box_offsets", "describe"):
            patch.setattr(described, name, noted(name))
        patch.setattr(described, "find_misfits", disagreeing)
        patch.setattr(described, "with_box_heights", lambda objects, *_: objects)
        return session.stop(), made


def test_positions_by_rays_of_hidden_boxes_are_less_sure(ended):
    _, made = ended
    (_, before), (after, _) = made["with_bodies"], made["with_box_offsets"]
    used = (before.association.object >= 0) & (before.estimate.weight > 0)
    more = np.trace(after.estimate.covariance - before.estimate.covariance, axis1=1, axis2=2)
    hidden = [before.hidden[used & (before.association.object == j)].any() for j in range(before.association.count)]
    assert any(hidden)
    assert ((more > 0) == hidden).all()


def test_an_object_whose_rays_do_not_agree_has_a_larger_sigma(ended):
    result, made = ended
    (described, _) = made["describe"][1]
    for j, (before, after) in enumerate(zip(described.objects, result.map.objects, strict=True)):
        assert (before.covariance is None) == (after.covariance is None)
        if before.covariance is not None:
            np.testing.assert_allclose(after.covariance, before.covariance * (TIMES**2 if j == ODD else 1.0))
    assert described.objects[ODD].covariance is not None


def test_the_map_of_a_session_is_level_as_that_of_a_run():
    log = simulate(preset("demo", frames=120, objects=12, classes=12, localization=None), 3)
    settings = load_settings(None, ("mode=joint", "bodies.use=false", *NOTHING_BESIDE))
    up = feed(Session(settings, patient=True).start(), log).stop().map_T_base[:, :3, 2].mean(axis=0)
    np.testing.assert_allclose(up / np.linalg.norm(up), [0, 0, 1], atol=1e-9)


@pytest.mark.parametrize(("power", "words"), [(0, ""), (-1, "distances along the ray")])
def test_the_end_names_depths_that_are_distances_along_the_ray(power, words):
    """An offline run names them too (`test_depth_axis`)."""
    log = with_power(driven(localization=None), power)
    settings = load_settings(None, ("mode=joint", "bodies.use=false", *NOTHING_BESIDE))
    result = feed(Session(settings, patient=True).start(), log).stop()
    assert [one["name"] for one in result.summary["wrong_input"]] == ["depth axis"] * bool(words)
    assert any(words in line for line in result.summary["warnings"]) or not words


@pytest.mark.long
def test_the_end_trusts_no_object_of_a_camera_that_somebody_turned():
    log = simulate(preset("demo", frames=160, objects=12, classes=12, localization=None), 3)
    settings = load_settings(None, ("mode=joint", "bodies.use=false", *NOTHING_BESIDE))
    for degrees, names in ((0.0, []), (10.0, ["camera moved"])):
        result = feed(Session(settings, patient=True).start(), turned(log, 0, degrees)).stop()
        assert [one["name"] for one in result.summary["wrong_input"]] == names
        assert bool(result.map.resolved()) == (not names)


@pytest.mark.parametrize(
    ("mistake", "name"),
    [("image mirrored", "image mirrored"), ("none", None)],
)
def test_the_end_names_wrong_input(mistake, name):
    log = drive("fixed", frames=150)
    result = feed(
        Session(load_settings(None, QUIET), patient=True).start(), MISTAKES.get(mistake, lambda log: log)(log)
    ).stop()
    found = [one["name"] for one in result.summary["wrong_input"] if one["spoils_positions"]]
    assert [one.split(",")[0] for one in found] == ([] if name is None else [name])
    assert bool(result.map.resolved()) == (name is None)


def test_a_session_whose_poses_allow_no_map_says_why(monkeypatch):
    def fail(*given):
        raise SolveError("no object has a position")

    monkeypatch.setattr(finalize, "solve", fail)
    session = feed(
        Session(load_settings(None, QUIET), patient=True).start(),
        MISTAKES["x and y of poses swapped"](drive("fixed", frames=150)),
    )
    with pytest.raises(SolveError):
        session.stop()
    assert any("x and y of the poses are swapped" in line for line in session.counters.ledger.warnings)
