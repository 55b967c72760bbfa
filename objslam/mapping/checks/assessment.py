"""The judgement of a result, in a few sentences. It depends on numbers only, so it is the same for every driver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from objslam.core.snapshot import RARE_POSES, TOO_SLOW
from objslam.frontend.bearings import CUT_OFF
from objslam.frontend.keyframes import OFF_PATH, UNCOVERED
from objslam.frontend.log_part import part_in_words
from objslam.io.detections_jsonl import MALFORMED
from objslam.mapping.checks.finding import NEIGHBOURS, NOISIER

Level = Literal["good", "check", "bad"]

HEADLINES: dict[Level, str] = {"good": "Good.", "check": "Look closer.", "bad": "Do not use this map."}
"""What the report and the picture of a map say for each level, before the reasons."""

_MISSES = 1.5
"""A result needs a look if its residuals exceed this multiple of their expected noise. At 1.5, more than half of their
variance is unexplained. A larger value gives fewer warnings."""
_CUT, _CUT_NAMED = 1 / 2, 1 / 3
"""A result needs a look if the image's edge cuts off more than the share `_CUT` of the boxes: the map then lacks most of
what the detector saw. From the share `_CUT_NAMED` on, the assessment names the share. A share of a tenth is usual in the
demo's rooms, and of a third in homes, where a robot passes things closely. Dropped boxes bend no map. Larger values give
fewer warnings."""
_OFF_PATH = 1 / 3
"""A result needs a look if more than this share of the boxes have no pose of the robot. Recordings often begin before the
localisation, and end after it. A larger value gives fewer warnings."""
_UNEXPLAINED = 0.25
"""A result needs a look if more than this share of the rays belong to no object or miss their object. A tenth is usual,
because of false boxes and moving things. A larger value gives fewer warnings."""
_LOOSE = 9.0
"""A result needs a look if the noise of the odometry is this multiple of the settings, or more. Right maps of recorded
robots have up to 8.1. If the multiple is larger, the fault is often not in the odometry: a camera that turns on the robot
causes the same noise. A larger value gives fewer warnings."""
_LOOSE_POSES = 9.0
"""A result of the joint mode needs a look if the noise of the localisation is this multiple of the settings, or more.
Simulated robots with AMCL or a scan matcher have up to 5.3. Wrong maps of rows of pallets that hide each other, which bent
an exact path, have 10 to 15. A larger value gives fewer warnings."""
_NAMED = 3.0
"""An assessment names the noise of the odometry if it is at least this multiple of the settings. The settings then explain
only a ninth of its variance. The cause may be wheels that slip, or a path that was bent to make one object of two things. A
larger value names the noise less often."""
_BENT = 1.8
"""A result from bearings alone, with several objects for a label, needs a look if the noise of the odometry is at least this
multiple of the settings. Right maps of simulated robots have at most 1.7. Wrong maps of robots with a wheel that slips have
1.9 and 3.3. Wrong maps of recorded robots have 5 and more. With ranges, a right map of a recorded robot has 5.0. A larger
value gives fewer warnings."""
_FEW = 60
"""A result needs a look if it has fewer rays than this number. With fewer boxes, the checks of the input give no verdict. A
larger value gives more warnings."""


_MALFORMED = 0.05
"""The input needs a look if more than this share of the frames of boxes is malformed. A log that was cut off while it was
written has one such frame. A larger value gives fewer warnings."""
_LATE = 0.1
"""A live result needs a look if more than this share of its camera frames came too late for the map. At 0.1, nine of ten
views of each object remain. A larger value gives fewer warnings."""


@dataclass(frozen=True)
class Evidence:
    """The numbers that a judgement depends on.

    resolved, unresolved: the numbers of objects with and without a position. boxes: the number of boxes of the log. cut: the
    number of boxes that the image's edge cuts off. rays: the number of used boxes. unexplained: the number of used boxes
    without an object. rejected: the number of used boxes that miss their object so far that they do not count. misses: the
    median residual as a multiple of its expected noise, NaN without objects. odometry_frame: whether the map has the frame
    of the odometry. fixed: whether the run kept the given poses. findings: the names of the faults of the input. spoilt:
    whether these faults make positions unreliable. frames: the number of camera frames of a log or session. late: the number
    of frames that a live session dropped because they came too late. journal: the file with all messages of a live session,
    "" without one. doubted: the labels that may name one object or several. unsettled: the number of objects that the last
    round of association still changed. unfinished: whether the search for a clear map took all its solves
    (joint.max_solves) or was interrupted. copied: the number of objects in the largest part of the map that shows the same
    things as another part. several: whether a label has several objects. uncalibrated: whether the estimation of the shared
    errors failed.
    odometry: the largest noise of the odometry that the log shows, as a multiple of the settings. poses: the same for the
    localisation. scale: the standard deviation of the scale of the odometry, as a share, None if the log shows the scale.
    depths: whether boxes have depths. part: the limits of a log that is a part of a recording, as in `Log`. malformed: the
    number of malformed frames of boxes. unused: the names of the robot's paths that could not be used. off_path: the number
    of boxes without a pose of the robot or of its camera.
    odometry_unused: whether the mode was left to the log, and a `fixed` run did not use its odometry.
    """

    resolved: int
    unresolved: int
    boxes: int
    cut: int
    rays: int
    unexplained: int
    rejected: int
    misses: float
    odometry_frame: bool = False
    fixed: bool = False
    findings: tuple[str, ...] = ()
    spoilt: bool = False
    frames: int = 0
    late: int = 0
    journal: str = ""
    doubted: tuple[str, ...] = ()
    unsettled: int = 0
    unfinished: bool = False
    copied: int = 0
    several: bool = False
    uncalibrated: bool = False
    odometry: float = 1.0
    poses: float = 1.0
    scale: float | None = None
    depths: bool = False
    part: tuple[float | None, float | None] = (None, None)
    odometry_unused: bool = False
    malformed: int = 0
    unused: tuple[str, ...] = ()
    off_path: int = 0


@dataclass(frozen=True)
class Assessment:
    """A level and its reasons, one sentence each.

    good: use the map. check: look at the reasons first. bad: do not use the map.
    """

    level: Level
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        return " ".join([f"{self.level}.", *self.reasons])

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of summary.json."""
        return {"level": self.level, "reasons": list(self.reasons)}


def evidence_of(summary: dict[str, Any], misses: float) -> Evidence:
    """Return the evidence from the summary of a run. misses: as in `Evidence`."""
    counts, findings = summary["counts"], summary.get("wrong_input", [])
    return Evidence(
        resolved=counts["objects"] - counts["unresolved"],
        unresolved=counts["unresolved"],
        boxes=counts.get("detections", 0),
        cut=summary["dropped"].get(CUT_OFF, 0),
        rays=counts["rays"],
        unexplained=counts["rays_unexplained"],
        rejected=counts["rays_rejected"],
        misses=misses,
        odometry_frame=summary["map_frame"] == "odometry",
        fixed=summary["mode"] == "fixed",
        findings=tuple(finding["name"] for finding in findings),
        spoilt=any(finding["spoils_positions"] for finding in findings),
        frames=counts["detection_frames"],
        late=sum(summary["dropped"].get(reason, 0) for reason in (TOO_SLOW, RARE_POSES)),
        journal=summary["log_path"] or "",
        doubted=tuple(summary["doubted_labels"]),
        unsettled=summary.get("unsettled_objects", 0),
        unfinished=summary.get("unfinished_search", False),
        copied=summary.get("copied_objects", 0),
        several=summary.get("several_objects_a_label", False),
        uncalibrated=summary.get("uncalibrated", False),
        odometry=max((summary.get("noise") or {}).get(name, 1.0) for name in ("along", "across", "turning")),
        poses=max((summary.get("noise") or {}).get(name, 1.0) for name in ("heading", "place")),
        scale=untold_scale(summary),
        depths="range_scale" in (summary.get("calibration") or {}).get("parameters", {}),
        part=(summary["part"]["begin"], summary["part"]["end"]) if "part" in summary else (None, None),
        odometry_unused=summary.get("odometry_unused", False),
        malformed=malformed_frames(summary["dropped"]),
        unused=tuple(summary.get("unused_paths", ())),
        off_path=sum(n for reason, n in summary["dropped"].items() if reason.startswith((*OFF_PATH, UNCOVERED))),
    )


def malformed_frames(dropped: dict[str, int]) -> int:
    """Return how many frames of boxes were dropped because they are malformed. dropped: the counts by reason."""
    return sum(count for reason, count in dropped.items() if reason.startswith(MALFORMED))


def lost_input(unused: Sequence[str], malformed: int, frames: int) -> list[str]:
    """Return a sentence for each part of the input that a map lacks although the log has it.

    unused: the names of the robot's paths that could not be used. malformed, frames: the numbers of malformed and of other
    frames of boxes.
    """
    found = [f"The map is made without {name}, which cannot be used: the warnings say why." for name in unused]
    if malformed > _MALFORMED * (malformed + frames):
        share = 100 * malformed / (malformed + frames)
        found.append(f"{share:.0f} % of the frames of boxes were dropped, because they are malformed.")
    return found


def untold_scale(summary: dict[str, Any]) -> float | None:
    """Return the standard deviation of the odometry's scale, as a share. None if the log shows it or no run estimated it."""
    scale = (summary.get("calibration") or {}).get("parameters", {}).get("odometry.scale")
    return None if scale is None or scale["observable"] else scale["sigma"]


def assess(e: Evidence) -> Assessment:
    """Judge a result. The first reasons weigh most."""
    bad, check = _bad(e), _check(e)
    level: Level = "bad" if bad else "check" if check else "good"
    good = f"{_objects(e.resolved)}, whose boxes agree to within the expected noise."
    about = [] if bad else _about(e)
    return Assessment(level, (*(bad or check or [good]), *about))


def _about(e: Evidence) -> list[str]:
    """Return sentences about the map that do not change the level: a better mode, the part of the recording, the frame, the
    noise of the odometry, and the scale."""
    found = []
    if e.odometry_unused:
        better = "usually more exact for objects seen from several sides"
        found.append(f"Hint: the log has odometry too. --mode joint uses both: {better}.")
    if _CUT_NAMED * e.boxes < e.cut <= _CUT * e.boxes:
        found.append(_cut_off(e))
    if part := part_in_words(e.part):
        found.append(f"The map is of a part of the recording: {part}.")
    if e.odometry_frame:
        found.append("The map lies in the frame of the odometry, which begins where the robot began.")
    if _NAMED <= e.odometry < _LOOSE and not _may_be_bent(e):
        found.append(
            f"The odometry counts as {e.odometry:.1f} times as noisy as the settings say: its wheels slip, or the path is "
            "bent to make one object of two things."
        )
    if e.scale is not None:
        without = "Depths or fiducials of known size would show it."
        found.append(
            "The log does not show the scale of the odometry: all distances may be too long or too short by one factor, "
            f"with a sigma of {100 * e.scale:.2g} %. "
            + ("The depths tell it no better. Fiducials of known size would." if e.depths else without)
        )
    return found


def _bad(e: Evidence) -> list[str]:
    if e.spoilt:
        return ["The input is wrong, and the warnings say how."]
    if not e.resolved and e.unexplained > _UNEXPLAINED * e.rays:
        return [
            f"No object has a place, because {100 * e.unexplained / e.rays:.0f} % of the used boxes agree on none: check "
            "the input, and drive around things."
        ]
    if not e.resolved:
        return ["No object has a place. Drive around things, so that they are seen from more than one side."]
    return []


def _check(e: Evidence) -> list[str]:
    found = []
    if e.fixed and e.odometry_frame:
        # Drift splits an object into parts, and the rays of each part fit it well. So the residuals do not show drift.
        found.append("The poses come from the odometry, so the map has its drift: --mode joint corrects it.")
    errors = [name for name in e.findings if name not in (NOISIER, NEIGHBOURS)]
    if NEIGHBOURS in e.findings:
        found.append("Equal things stand nearer to each other than the poses err, so their boxes may be exchanged.")
    if NOISIER in e.findings:
        found.append("The poses or depths are far noisier than the settings say, and the warnings say how noisy.")
    if errors:
        found.append(f"The input has an error that the warnings explain ({', '.join(errors)}).")
    elif not e.findings and e.misses > _MISSES:
        found.append(
            f"The rays miss their objects {e.misses:.1f} times as far as the settings say, so poses, clock, calibration or "
            "boxes are worse than the settings."
        )
    elif e.odometry >= _LOOSE:
        found.append(
            f"The boxes agree only if the odometry is {e.odometry:.0f} times as noisy as the settings say: it may slip, or "
            "the camera may turn on the robot (camera_poses)."
        )
    if not e.fixed and e.poses >= _LOOSE_POSES:
        found.append(
            f"The boxes agree only if the localisation is {e.poses:.0f} times as noisy as the settings say: it may be, or "
            "boxes of equal things that hide each other bend the path." + _depths_would_show(e)
        )
    found += lost_input(e.unused, e.malformed, e.frames)
    if e.boxes and e.off_path > _OFF_PATH * e.boxes:
        found.append(
            f"{100 * e.off_path / e.boxes:.0f} % of the boxes have no pose of the robot or its camera, so the map does "
            "without them: the warnings say why."
        )
    if _may_be_bent(e):
        found.append(
            f"The boxes agree only if the odometry is {e.odometry:.1f} times as noisy as the settings say, and labels do "
            "not tell which box shows which object. So the path may be bent, and an object may be two things."
            + _depths_would_show(e)
        )
    if e.unsettled:
        found.append(
            "It is not settled which boxes show which object: the last round of association still changed "
            f"{_objects(e.unsettled)}."
        )
    if e.unfinished:
        found.append(
            "The search for a map that explains the boxes ended early, after its solves (joint.max_solves) or at Ctrl-C. So "
            "the best map may be wrong. Depths, more labels or a better odometry would help."
        )
    if e.copied:
        found.append(
            f"A part of the map with {_objects(e.copied)} looks like another part, at another place: the place repeats "
            "itself, or the robot came back there unnoticed. In the second case the path is bent, and the map shows things "
            "twice." + _depths_would_show(e)
        )
    if e.uncalibrated:
        found.append("The errors that all measurements share could not be estimated, so the sigmas lack them.")
    if e.doubted:
        found.append(
            f"It is not clear whether {', '.join(e.doubted)} name one object each, or several. Drive past them and others "
            "again, so that the path between them is known."
        )
    if e.cut > _CUT * e.boxes:
        found.append(_cut_off(e))
    if e.late > _LATE * e.frames:
        more = f": `objslam run {Path(e.journal).parent}` uses them all" if e.journal else ""
        found.append(f"{100 * e.late / e.frames:.0f} % of the camera frames were dropped, because they came too late{more}.")
    if e.unexplained > _UNEXPLAINED * e.rays:
        found.append(f"{100 * e.unexplained / e.rays:.0f} % of the used boxes belong to no object.")
    elif e.unexplained + e.rejected > _UNEXPLAINED * e.rays:
        none, missed = (100 * part / e.rays for part in (e.unexplained, e.rejected))
        those = "of the used boxes"
        alone = f"{missed:.0f} % {those} miss their object."
        both = f"{none:.0f} % {those} belong to no object, and {missed:.0f} % miss their object."
        found.append((both if e.unexplained else alone) + (" An object may be two." if e.rejected > e.unexplained else ""))
    if e.unresolved > e.resolved:
        found.append(f"Only {e.resolved} of {e.resolved + e.unresolved} objects have a place. Drive around the others.")
    if e.rays < _FEW:
        found.append(f"Only {e.rays} boxes were used, which is too few to notice wrong input.")
    return found


def _cut_off(e: Evidence) -> str:
    return f"{100 * e.cut / e.boxes:.0f} % of the boxes were dropped, because the image's edge cuts them off."


def _depths_would_show(e: Evidence) -> str:
    """Return the advice to add depths, if the log has none."""
    return "" if e.depths else " Depths would show it."


def _may_be_bent(e: Evidence) -> bool:
    """Return whether the path may be bent to fit a wrong association. Depths, or one object for each label, prevent this."""
    return e.scale is not None and e.several and _BENT <= e.odometry < _LOOSE


def _objects(count: int) -> str:
    return f"{count} object{'' if count == 1 else 's'}"
