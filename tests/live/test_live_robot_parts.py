"""A session drops the boxes of the robot's arm."""

from driving import feed
from quick import HELD, NOTHING_BESIDE
from robot_arm import ARM, with_arm

from objslam.association.observations import overlap
from objslam.config import Odometry, load_settings
from objslam.core.types import Log
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.boxes.robot_parts import ROBOT_PARTS, SAME_BOX
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate


def outcome(log: Log, *more: str) -> tuple[int, int, int, int]:
    """The numbers of objects that are found and false at the end of a session, of rays to the arm, and of dropped boxes."""
    session = feed(Session(load_settings(None, ("mode=joint", *more)), patient=True).start(), log)
    result = session.stop()
    found = evaluate(result.map, log.truth, align="se2").objects
    rays = int((overlap(ARM, result.rays.box) >= SAME_BOX).sum())
    return len(found.matches), len(found.false), rays, result.summary["dropped"].get(ROBOT_PARTS, 0)


def test_the_map_of_a_session_has_no_rays_to_an_arm():
    drive = simulate(preset("demo", frames=200, false=0.0, localization=None, odometry=Odometry()), 3)
    log = with_arm(drive, drive.cameras[0].detections.label_names[0])
    boxes = len(log.cameras[0].detections) - len(drive.cameras[0].detections)
    things = len(drive.truth.objects)
    *found, dropped = outcome(log, *NOTHING_BESIDE)
    assert found == [things, 0, 0]
    assert 0.9 * boxes < dropped <= boxes  # The first boxes are dropped at the end. Frames between keyframes give no rays.
    *_, rays, dropped = outcome(log, "rays.robot_parts=false", *HELD)
    assert rays > 0.8 * boxes
    assert dropped == 0
