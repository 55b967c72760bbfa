"""The verdict on a result: each reason appears when its cause is there, and only then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from quick import HELD, NOTHING_DRAWN
from small_log import small_log

import objslam
from objslam.config import Odometry, load_settings
from objslam.core.types import Log
from objslam.frontend.bearings import CUT_OFF
from objslam.frontend.log_part import part_of_log
from objslam.mapping.checks.assessment import Evidence, assess
from objslam.simulation import DepthNoise, PoseNoise

GOOD = Evidence(resolved=12, unresolved=1, boxes=1000, cut=100, rays=900, unexplained=90, rejected=20, misses=1.0)
QUIET = {"output": {"recording": False, "picture": False}}
ALONE = load_settings(None, (*HELD, *NOTHING_DRAWN))
"""For verdicts on what went in, which no stage after the association changes."""


def test_a_usual_result_is_good() -> None:
    found = assess(GOOD)
    assert found.level == "good"
    assert str(found) == "good. 12 objects, whose boxes agree to within the expected noise."


@pytest.mark.parametrize(
    ("changes", "level", "reason"),
    [
        ({"spoilt": True, "findings": ("clock",)}, "bad", "The input is wrong, and the warnings say how."),
        ({"resolved": 0}, "bad", "No object has a place. Drive around things"),
        ({"resolved": 0, "unexplained": 900}, "bad", "No object has a place, because 100 % of the used boxes agree on none"),
        ({"findings": ("rays miss",)}, "check", "The input has an error that the warnings explain (rays miss)."),
        ({"findings": ("noise",)}, "check", "The poses or depths are far noisier than the settings say, and the warnings"),
        (
            {"findings": ("equal things nearer than the poses err",)},
            "check",
            "Equal things stand nearer to each other than the poses err",
        ),
        ({"misses": 3.04}, "check", "The rays miss their objects 3.0 times as far as the settings say"),
        ({"copied": 7}, "check", "A part of the map with 7 objects looks like another part, at another place: the place"),
        ({"unsettled": 3}, "check", "It is not settled which boxes show which object: the last round of association still"),
        (
            {"unfinished": True},
            "check",
            "The search for a map that explains the boxes ended early, after its solves (joint.max_solves) or at Ctrl-C",
        ),
        ({"uncalibrated": True}, "check", "The errors that all measurements share could not be estimated"),
        ({"doubted": ("mug", "cup")}, "check", "It is not clear whether mug, cup name one object each, or several."),
        ({"cut": 520}, "check", "52 % of the boxes were dropped, because the image's edge cuts them off."),
        (
            {"frames": 445, "late": 78, "journal": "map/journal.objslam"},
            "check",
            "18 % of the camera frames were dropped, because they came too late: `objslam run map` uses them all.",
        ),
        ({"frames": 445, "late": 78}, "check", "18 % of the camera frames were dropped, because they came too late."),
        ({"unexplained": 450}, "check", "50 % of the used boxes belong to no object."),
        (
            {"rejected": 180},
            "check",
            "10 % of the used boxes belong to no object, and 20 % miss their object. An object may be two.",
        ),
        ({"unexplained": 220, "rejected": 10}, "check", "24 % of the used boxes belong to no object, and 1 % miss their"),
        ({"unexplained": 0, "rejected": 240}, "check", "27 % of the used boxes miss their object. An object may be two."),
        ({"unused": ("localization.txt",)}, "check", "The map is made without localization.txt, which cannot be used"),
        (
            {"frames": 186, "malformed": 114},
            "check",
            "38 % of the frames of boxes were dropped, because they are",
        ),
        ({"poses": 13.7}, "check", "The boxes agree only if the localisation is 14 times as noisy as the settings say"),
        ({"odometry": 10.8}, "check", "The boxes agree only if the odometry is 11 times as noisy as the settings say"),
        ({"unresolved": 20}, "check", "Only 12 of 32 objects have a place. Drive around the others."),
        ({"fixed": True, "odometry_frame": True}, "check", "The poses come from the odometry, so the map has"),
        (
            {"rays": 20, "unexplained": 0, "rejected": 0},
            "check",
            "Only 20 boxes were used, which is too few to notice wrong input.",
        ),
    ],
)
def test_each_cause_has_its_reason(changes: dict[str, object], level: str, reason: str) -> None:
    found = assess(replace(GOOD, **changes))  # type: ignore[arg-type]
    assert found.level == level
    assert len([reason for reason in found.reasons if not reason.startswith("The map lies")]) == 1
    assert found.reasons[0].startswith(reason)


@pytest.mark.parametrize(("cut", "said"), [(320, False), (340, True), (500, True)])
def test_up_to_half_of_the_boxes_may_be_cut_off_in_a_good_map(cut: int, said: bool) -> None:
    found = assess(replace(GOOD, cut=cut))
    assert found.level == "good"
    assert ("the image's edge cuts them off" in found.reasons[-1]) == said


def test_reasons_add_up_and_a_bad_result_says_only_why() -> None:
    both = assess(replace(GOOD, misses=2.0, cut=520))
    assert len(both.reasons) == 2
    assert len(assess(replace(GOOD, misses=2.0, cut=520, spoilt=True)).reasons) == 1


def test_a_map_in_the_frame_of_the_odometry_says_so() -> None:
    found = assess(replace(GOOD, odometry_frame=True))
    assert found.level == "good"
    assert "frame of the odometry" in found.reasons[-1]


@pytest.mark.parametrize(
    ("part", "limits"),
    [((10.0, None), "from stamp 10.000 s"), ((None, 20.5), "to stamp 20.500 s"), ((10.0, 20.5), "10.000 to 20")],
)
def test_a_map_of_a_part_says_which(part: tuple[float | None, float | None], limits: str) -> None:
    found = assess(replace(GOOD, part=part))
    assert found.level == "good"
    assert "The map is of a part of the recording: " in found.reasons[-1]
    assert limits in found.reasons[-1]


def test_a_summary_has_the_part_that_was_used() -> None:
    log = small_log()
    middle = float(np.median(log.robot_path.stamps))
    assert log.part == (None, None)
    result = objslam.run(part_of_log(log, None, middle), ALONE)
    assert result.summary["part"] == {"begin": None, "end": middle}
    assert f"a part of the recording: to stamp {middle:.3f} s." in result.summary["assessment"]["reasons"][-1]


def test_a_scale_that_the_log_does_not_tell_is_no_flaw_but_said() -> None:
    found = assess(replace(GOOD, odometry_frame=True, scale=0.03))
    assert found.level == "good"
    assert found.reasons[-1].startswith(
        "The log does not show the scale of the odometry: all distances may be too long or too"
    )
    assert "with a sigma of 3 %." in found.reasons[-1]
    assert found.reasons[-1].endswith("Depths or fiducials of known size would show it.")
    assert len(assess(replace(GOOD, scale=0.03, spoilt=True)).reasons) == 1


def test_depths_that_do_not_tell_the_scale_are_not_asked_for() -> None:
    assert (
        assess(replace(GOOD, scale=0.02, depths=True))
        .reasons[-1]
        .endswith("The depths tell it no better. Fiducials of known size would.")
    )


@pytest.mark.parametrize("change", [{"poses": 9.0}, {"odometry": 2.5, "several": True, "scale": 0.02}])
def test_depths_are_asked_for_only_if_there_are_none(change: dict[str, object]) -> None:
    assert "Depths would show it" in str(assess(replace(GOOD, **change)))
    assert "Depths would show it" not in str(assess(replace(GOOD, **change, depths=True)))


@pytest.mark.parametrize("depth", [False, True])
def test_boxes_without_depth_do_not_tell_the_scale(depth: bool) -> None:
    """A map and its path can be stretched together, and no box moves. A depth changes."""
    log = small_log(localization=None, odometry=Odometry(), depth=DepthNoise() if depth else None)
    found = objslam.run(log, {**QUIET, "mode": "joint"})
    assert ("does not show the scale" in str(found.assessment)) != depth


@pytest.mark.parametrize(("sigma", "level"), [(2.0, "good"), (0.8, "check")])
def test_a_run_knows_how_far_its_rays_miss(sigma: float, level: str) -> None:
    """The boxes err by 2 px, and the settings say `sigma`. Nothing else errs, so the multiple is known."""
    log = small_log(localization=PoseNoise(xy=1e-6, yaw=1e-6), missed=0.0, false=0.0)
    changes = {"rays.pixel_sigma": sigma, "rays.box_sigma": 0.0, "localization.xy": 1e-4, "localization.yaw": 1e-4}
    changes |= {"association.method": "by_label", "checks.use": False}
    found = objslam.run(log, {**QUIET, **changes})
    np.testing.assert_allclose(found.summary["residual_times"], 2.0 / sigma, rtol=0.1)
    assert found.assessment.level == level


def test_a_run_from_odometry_says_that_the_map_has_its_frame() -> None:
    joint = objslam.run(small_log(), ALONE, mode="joint", poses={"use": "odometry"})
    assert "frame of the odometry" in str(joint.assessment)


def test_fixed_poses_are_good_where_they_are_absolute_and_not_where_they_drift() -> None:
    drifting = objslam.run(small_log(), ALONE, mode="fixed", poses={"use": "odometry"})
    assert drifting.assessment.level == "check"
    assert "the map has its drift" in drifting.assessment.reasons[0]
    absolute = objslam.run(small_log(), ALONE, mode="fixed", poses={"use": "localization"})
    assert "drift is in the map" not in str(absolute.assessment)


def test_boxes_at_the_edge_are_told() -> None:
    cut = objslam.run(small_log(), ALONE, rays={"border": 150})
    dropped, boxes = cut.dropped[CUT_OFF], cut.summary["counts"]["detections"]
    assert dropped > boxes / 3
    assert f"{100 * dropped / boxes:.0f} % of the boxes were dropped" in str(cut.assessment)


def test_a_hint_at_the_mode_that_uses_the_odometry_too_is_no_doubt() -> None:
    """It comes once, and only if the mode was left to a log that has both paths."""
    assert assess(replace(GOOD, odometry_unused=True)).level == "good"
    assert "for objects seen from several sides" in str(assess(replace(GOOD, odometry_unused=True)))
    assert len(assess(replace(GOOD, odometry_unused=True, spoilt=True)).reasons) == 1

    def hints(log: Log, **changes: object) -> int:
        return str(objslam.run(log, ALONE, **changes).assessment).count("--mode joint uses both")

    log = small_log()
    assert hints(log) == 1
    assert hints(log, mode="fixed") == hints(log, mode="joint") == hints(replace(log, odometry=None)) == 0
    assert hints(log, poses={"use": "localization"}) == hints(replace(log, localization=None)) == 0


@pytest.mark.parametrize("change", [{"several": False}, {"scale": None}, {"odometry": 1.7}])
def test_noisy_odometry_is_no_flaw_if_labels_or_depths_hold_the_path(change: dict[str, object]) -> None:
    bent = replace(GOOD, odometry=5.2, several=True, scale=0.03)
    assert assess(bent).level == "check"
    assert assess(bent).reasons[0].startswith("The boxes agree only if the odometry is 5.2 times as noisy")
    assert assess(replace(bent, **change)).level == "good"


def test_boxes_without_a_pose_of_the_robot_are_told() -> None:
    assert assess(replace(GOOD, boxes=300, off_path=99)).level == "good"
    lost = assess(replace(GOOD, boxes=300, off_path=120))
    assert lost.level == "check"
    assert lost.reasons[0].startswith("40 % of the boxes have no pose of the robot")
    log = small_log()
    path = log.localization
    assert path is not None
    half = len(path) // 2
    short = replace(log, localization=type(path)(path.stamps[:half], path.poses[:half]))
    assert "have no pose of the robot" in str(objslam.run(short, ALONE, mode="fixed").assessment)


def test_noisy_odometry_is_said_beside_other_reasons() -> None:
    found = assess(replace(GOOD, odometry=5.2, several=True, scale=0.03, misses=3.0))
    assert found.level == "check"
    assert sum("5.2 times as noisy" in reason for reason in found.reasons) == 1
