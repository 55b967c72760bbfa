"""Decide from a map at given poses whether the poses should be solved too."""

from objslam.core.result import RunResult
from objslam.mapping.doubts.find import maps_things_twice, mostly_doubtful
from objslam.mapping.fixed.map_at_poses import MapAtPoses
from objslam.mapping.moves.odometry_witness import odometry_contradicts
from objslam.mapping.stages.described import DescribedDrive


def reason_to_solve(of: DescribedDrive, result: RunResult) -> str:
    """Return why the poses should be solved once more, "" if they should not. result: the result of the described drive."""
    drive, solution = of.found.drive, of.found.solution
    if of.late is not None:
        return "the localisation errs for seconds"
    if of.noisy is not None and drive.log.odometry is not None:
        return "the localisation errs by more than its settings say"
    if drive.joint:
        return ""
    if solution.keyframes.localized_every and not drive.diagnosis.findings and not of.objects.resolved():
        return "no object has a place at the localised poses"
    # A joint solve may refute what boxes show.
    if not drive.chosen or not drive.settings.checks.use or drive.diagnosis.certain:
        return ""
    if result.summary["assessment"]["level"] != "good" and odometry_contradicts(drive.given, drive.settings):
        return "the odometry shows that the localisation errs for seconds"
    if mostly_doubtful(result):
        return "many objects at the localised poses are doubtful"
    return "many things are in the map twice at the localised poses" if maps_things_twice(result) else ""


def shows_noise(found: MapAtPoses, result: RunResult) -> bool:
    """Return whether a map at localised poses shows that they err, so that a joint solve may find their noise without an
    odometry. found: what the map tells a joint solve."""
    return found.lasting is not None or mostly_doubtful(result) or maps_things_twice(result)


def for_second_solve(of: DescribedDrive, result: RunResult) -> MapAtPoses:
    """Return what a map at given poses tells a joint solve."""
    solution = of.found.solution
    trusted = of.trusted and not mostly_doubtful(result)
    lasting = None if of.late is None else of.lasting
    return MapAtPoses(lasting, solution.rays, solution.whole or solution.association, trusted)
