"""Objects with a wide sigma are named, and keep their status."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_result import clusters, synthetic_result

from objslam.config import load_settings
from objslam.core.bodies.body import Body
from objslam.core.diagnostics import Ledger
from objslam.core.object_map import ObjectMap
from objslam.core.result import Doubt, RunResult
from objslam.mapping.doubts.find import with_doubts
from objslam.mapping.pipeline import run
from objslam.simulation import preset, simulate


def result_of(*sigmas: float, shared: float = 0.0) -> RunResult:
    """A result of a good map whose first objects have these own sigmas, m, and all the same shift as an error."""
    result, _ = synthetic_result(*clusters(), keyframes=20)
    common = np.zeros((7, 7))
    common[:3, :3] = shared**2 * np.eye(3)
    objects = [
        replace(
            o, covariance=np.diag([1e-4, 1e-4, (sigmas[i] if i < len(sigmas) else 0.1) ** 2]) + common[:3, :3], status="ok"
        )
        for i, o in enumerate(result.map.objects)
    ]
    objects_map = ObjectMap(tuple(objects), shared_covariance=common if shared else None)
    good = {"level": "good", "reasons": ["The map is good."]}
    return with_doubts(replace(result, map=objects_map, summary={**result.summary, "assessment": good}))


def unsure(result: RunResult) -> list[Doubt]:
    return [one for one in result.doubts if one.kind == "unsure"]


def test_the_least_sure_object_comes_first_and_the_verdict_names_it() -> None:
    result = result_of(0.6, 1.2)
    first, second = unsure(result)
    assert [one.objects for one in (first, second)] == [(result.map[1].id,), (result.map[0].id,)]
    assert "has a sigma of 1.20 m" in first.text
    assert abs(first.numbers["sigma_m"] - 1.2) < 1e-3
    assert {o.status for o in result.map} == {"ok"}
    assert result.summary["doubts"]["unsure"] == 2
    (_, told) = result.summary["assessment"]["reasons"]
    assert told.startswith("2 positions have a sigma above 0.5 m: ")
    assert f"{result.map[1].label} #{result.map[1].id} (1.20 m)" in told


def test_the_error_that_all_objects_share_makes_none_unsure() -> None:
    assert unsure(result_of(0.4, shared=3.0)) == []
    assert len(unsure(result_of(0.6, shared=3.0))) == 1


@pytest.mark.parametrize(
    ("observable", "frame", "doubts"), [(False, "odometry", 0), (True, "odometry", 1), (False, "localization", 1)]
)
def test_a_scale_that_the_log_does_not_show_makes_no_far_object_unsure(observable: bool, frame: str, doubts: int) -> None:
    """A path that bends with the scale hides a part of it from the shared covariance. In the frame of a localisation, the
    odometry's scale does not move the map."""
    result = result_of()
    shared = np.zeros((7, 7))
    shared[6, 6] = 0.02**2
    far = replace(result.map[0], position=np.array([30.0, 20.0, 0.5]))
    far = replace(far, covariance=0.03**2 * np.outer(far.position, far.position) + 0.01 * np.eye(3))
    objects = ObjectMap((far, *result.map.objects[1:]), shared_covariance=shared)
    scale = {"parameters": {"odometry.scale": {"observable": observable, "sigma": 0.03}}}
    summary = {**result.summary, "calibration": scale, "map_frame": frame}
    assert len(unsure(with_doubts(replace(result, map=objects, summary=summary)))) == doubts


def test_a_map_most_of_whose_objects_are_unsure_needs_a_look() -> None:
    count = len(result_of().map)
    some, most = result_of(*[0.6] * (count // 2)), result_of(*[0.6] * (count // 2 + 1))
    assert some.summary["assessment"]["level"] == "good"
    assert most.summary["assessment"]["level"] == "check"
    assert most.summary["assessment"]["reasons"][0].startswith(f"{count // 2 + 1} positions have a sigma above 0.5 m")


@pytest.mark.parametrize(
    ("parallax", "frame", "depth_sigma", "told"),
    [
        (12.0, "localization", 0.1, "Drive around it, or past it nearby."),
        (80.0, "localization", 0.1, "A better localisation helps, and more views do not."),
        (80.0, "odometry", 0.1, "Come back from there to things that were seen before."),
        (80.0, "odometry", 1.1, "Drive to where another side of it shows, or set its size: bodies.sizes={"),
    ],
    ids=["little parallax", "noisy poses", "a path that drifts", "a body whose depth does not show"],
)
def test_the_advice_is_of_use_against_the_cause(parallax: float, frame: str, depth_sigma: float, told: str) -> None:
    result = result_of(0.6)
    body = Body("cuboid", np.array([1.0, 0.2, 0.5]), 0.3, np.array([0.1, depth_sigma, 0.1]), 0.1)
    turn = np.array([[np.cos(0.3), -np.sin(0.3), 0], [np.sin(0.3), np.cos(0.3), 0], [0, 0, 1]])
    wide = turn @ np.diag([1e-4, 0.36, 1e-4]) @ turn.T
    one, *others = result.map.objects
    one = replace(one, covariance=wide, body=body, parallax_deg=parallax)
    summary = {**result.summary, "map_frame": frame}
    result = with_doubts(replace(result, map=ObjectMap((one, *others)), summary=summary))
    assert told in unsure(result)[0].text


@pytest.mark.parametrize(
    ("poses", "told"), [("localization", "A better localisation helps"), ("odometry", "Come back from there")]
)
def test_the_advice_of_a_run_fits_its_poses(poses: str, told: str) -> None:
    log = simulate(preset("demo"), 0)
    every = ("output.recording=false", "mode=joint", f"poses.use={poses}", "triangulation.sure_sigma=0.001")
    texts = [one.text for one in unsure(run(log, load_settings(None, every), Ledger()))]
    wide = [text for text in texts if "Drive" not in text]
    assert wide
    assert all(told in text for text in wide)
