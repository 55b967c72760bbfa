"""Boxes of rectified images beside a camera with distortion, and boxes of raw images beside one without."""

import pytest
from mapping.test_checks import drive, findings
from wrong_inputs import MISTAKES

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.mapping import pipeline
from objslam.mapping.checks.hypotheses.lens import LENS
from objslam.simulation import make_camera

SAID = {"boxes of rectified images": "--rectified", "boxes of raw images": "--raw"}


@pytest.mark.parametrize("name", SAID)
def test_boxes_of_another_distortion_are_named_at_given_poses(name):
    (found,) = findings(MISTAKES[name](drive("fixed")), "fixed")
    assert found.name == LENS
    assert SAID[name] in found.message


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.3, 0.1, 0.0, 0.0, 0.0), (0.1, -0.15, 0.0, 0.0, 0.03)])
def test_boxes_of_the_right_distortion_are_not(distortion):
    assert not findings(drive.__wrapped__("fixed", cameras=(make_camera(distortion=distortion),)), "fixed")


@pytest.mark.usefixtures("one_start")
@pytest.mark.parametrize("name", ["boxes of rectified images", None])
def test_with_odometry_alone_a_solve_with_the_other_lens_decides(name):
    log = drive("joint", seed=1, frames=200)
    result = pipeline.run(
        log if name is None else MISTAKES[name](log), load_settings(None, ("mode=joint", "output.recording=false")), Ledger()
    )
    assert [one["name"] for one in result.summary["wrong_input"]] == ([] if name is None else [LENS])
    assert name is None or result.summary["assessment"]["level"] == "check"
