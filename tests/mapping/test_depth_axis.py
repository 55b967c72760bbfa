"""Depths along the optical axis, and distances along the ray that were taken for them."""

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.mapping import pipeline
from objslam.simulation import DepthNoise, preset, simulate

pytestmark = pytest.mark.usefixtures("one_start")


def driven(seed=0, **changes):
    return simulate(preset("demo", frames=150, objects=12, classes=12, depth=DepthNoise(), **changes), seed)


def with_power(log, power):
    """The log with its depths multiplied by a power of the cosine of the angle from the optical axis."""
    cameras = []
    for one in log.cameras:
        found, matrix = one.detections, one.camera.matrix
        middle = (found.boxes[:, :2] + found.boxes[:, 2:]) / 2
        away = (middle - matrix[:2, 2]) / np.diagonal(matrix)[:2]
        cosine = 1 / np.sqrt(1 + (away**2).sum(axis=1))
        cameras.append(replace(one, detections=replace(found, depths=found.depths * cosine**power)))
    return replace(log, cameras=tuple(cameras))


def found_in(log, mode):
    ledger = Ledger()
    less = "output.recording=false", "bodies.use=false", "noise.localization=false", "association.method=by_label"
    result = pipeline.run(log, load_settings(None, (f"mode={mode}", *less)), ledger)
    return [one for one in result.summary["wrong_input"] if one["name"] == "depth axis"], ledger.warnings


@pytest.mark.parametrize(("mode", "localization"), [("joint", None), ("fixed", "its own")])
def test_distances_for_depths_are_named_and_depths_are_not(mode, localization):
    log = driven(**({"localization": None} if localization is None else {}))
    for power, words in ((0, ""), (-1, "distances along the ray"), (1, "multiplied by the cosine")):
        found, warnings = found_in(with_power(log, power), mode)
        assert bool(found) == bool(words), power
        assert all(words in one["message"] for one in found)
        assert sum("depth is the distance along the optical axis" in line for line in warnings) == len(found)


def test_few_depths_are_not_judged():
    log = with_power(driven(), -1)
    some = np.zeros(len(log.cameras[0].detections), dtype=bool)
    some[:25] = True
    one = log.cameras[0].detections
    log = replace(
        log, cameras=(replace(log.cameras[0], detections=replace(one, depths=np.where(some, one.depths, np.nan))),)
    )
    assert found_in(log, "joint")[0] == []
