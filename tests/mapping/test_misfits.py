"""Objects whose rays do not agree: against the noise that was put in, and against rays of two things in one object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from doubtful_drives import LEAN, mapped

from objslam.core.result import RunResult
from objslam.mapping.checks.misfits import find_misfits, with_misfits
from objslam.mapping.doubts.disagreeing import disagreeing, in_assessment, misfits_of
from objslam.simulation import preset, simulate


@pytest.fixture(scope="module")
def rooms() -> RunResult:
    return mapped(simulate(preset("rooms", false=0.0, tracks="perfect"), 4))


def off_by(result: RunResult, times: float, object_: int) -> RunResult:
    """The result with the residuals of an object drawn anew, `times` as large as their noise."""
    rng, residual = np.random.default_rng(0), result.residual.copy()
    mine = np.flatnonzero(result.association.object == object_)
    residual[mine] = times * result.rays.sigma[mine] * rng.rayleigh(size=len(mine))
    return replace(result, residual=residual)


def test_the_rays_of_a_clean_drive_agree(rooms):
    found = misfits_of(rooms)
    assert not found.odd.any()
    assert disagreeing(rooms, found) == []
    assert in_assessment([]) == []


@pytest.mark.parametrize("times", [1.2, 5.0])
def test_the_misfit_is_the_noise_as_a_multiple(rooms, times):
    """An angle between two directions with noise sigma in both axes has a Rayleigh distribution."""
    held = np.bincount(rooms.association.object[rooms.association.object >= 0])
    j = int(held.argmax())
    exact = replace(rooms, settings=LEAN.model_copy(update={"mode": "joint"}))  # The rays have their own noise only.
    found = misfits_of(off_by(exact, times, j))
    # Deviations above 6 sigma count as 6. At 5 sigma, 1 - exp(-36 / 50) of the sum of squares is left.
    expected = times * np.sqrt(1 - np.exp(-0.5 * (6 / times) ** 2))
    # A position takes 3 of the degrees of freedom.
    expected *= np.sqrt(2 * held[j] / (2 * held[j] - 3))
    assert found.times[j] == pytest.approx(expected, rel=0.15)
    assert found.odd[j] == (times > 3)


def test_an_object_whose_rays_do_not_agree_has_a_larger_sigma_and_is_named(rooms):
    exact = replace(rooms, settings=LEAN.model_copy(update={"mode": "joint"}))
    result = off_by(exact, 5.0, 1)
    found = misfits_of(result)
    assert np.flatnonzero(found.odd).tolist() == [1]
    wider = with_misfits(result.map, found)
    for j, (before, after) in enumerate(zip(result.map, wider, strict=True)):
        if before.covariance is None:
            continue
        factor = found.times[1] ** 2 if j == 1 else 1.0
        np.testing.assert_allclose(after.covariance, factor * before.covariance)
    (doubt,) = disagreeing(result, found)
    assert (doubt.kind, doubt.reason, doubt.objects) == ("split", "rays disagree", (result.map.objects[1].id,))
    assert doubt.numbers["misfit"] == pytest.approx(found.times[1])
    (told,) = in_assessment([doubt])
    assert f"{doubt.label} #{doubt.objects[0]}" in told


def test_a_log_whose_rays_are_all_noisy_blames_no_object(rooms):
    exact = replace(rooms, settings=LEAN.model_copy(update={"mode": "joint"}))
    noisy = replace(exact, residual=4.0 * exact.residual)
    assert not misfits_of(noisy).odd.any()


def test_no_object_has_no_misfit(rooms):
    nothing = replace(rooms.association, object=np.full(len(rooms.rays), -1))
    held = rooms.keyframes, rooms.rays, nothing
    found = find_misfits(rooms.map, *held, rooms.residual, rooms.weight, rooms.settings)
    assert not found.odd.any()
    assert np.isnan(found.times).all()
