"""A joint solve tries what a quick look at the boxes says."""

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.mapping.alternation import solve
from objslam.mapping.checks.diagnosis import Diagnosis
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.hypotheses import Hypothesis
from objslam.mapping.checks.trials import Trial
from objslam.mapping.refuted import without_refuted
from objslam.simulation import preset, simulate
from objslam.simulation.wrong_inputs import MISTAKES

SETTINGS = load_settings(None, ("mode=joint", "output.recording=false", "calibration.use=false"))


def nothing(stage, done, total):
    pass


@pytest.fixture(scope="module")
def clean():
    return simulate(preset("demo", frames=200, objects=8, classes=8, false=0.0, localization=None), 0)


def no_boxes(log):
    camera = log.cameras[0]
    few = camera.detections.take(np.zeros(len(camera.detections), dtype=bool))
    return replace(log, cameras=(replace(camera, detections=few),))


@pytest.mark.parametrize(
    ("wrong", "put_right", "kept"),
    [
        (False, MISTAKES["image mirrored"], False),  # a clean log, which a hypothesis makes wrong
        (True, MISTAKES["image mirrored"], True),  # a mirrored log, which it puts right
        (True, no_boxes, False),  # a hypothesis that leaves nothing to solve
    ],
)
def test_a_finding_stays_only_if_the_log_put_right_is_explained_better(clean, wrong, put_right, kept):
    log = MISTAKES["image mirrored"](clean) if wrong else clean
    frames = build_keyframes(log, SETTINGS, Ledger())
    rays = build_rays(log, frames, SETTINGS, Ledger())
    solution = solve(frames, rays, (log.cameras[0].camera,), SETTINGS, Ledger(), nothing)
    trial = Trial(Hypothesis("mirrored", "the boxes mirrored", "the images are mirrored", put_right), 1.0, 1.0, None)
    others = Finding("depth in mm", "the depths are in mm")
    found = Diagnosis((Finding("mirrored", "it is mirrored", by_boxes=True), others), (trial,))
    left = without_refuted(found, solution, log, SETTINGS, nothing)
    assert [one.name for one in left.findings] == (["mirrored"] if kept else []) + ["depth in mm"]
