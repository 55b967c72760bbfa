"""Remove findings about wrong input that a joint solve refutes.

A finding comes from a quick check before the solve (`mapping/checks`). The check takes odometry and calibration as exact
within windows of some seconds. So the check also reports errors that the joint solve corrects, such as a camera that is
turned by some degrees and late by 0.1 s. This module therefore tests each finding again on the solved map."""

from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools
from objslam.core.diagnostics import Ledger
from objslam.core.types import Log, Rays
from objslam.errors import ObjslamError, SolveError
from objslam.frontend.bearings import build_rays
from objslam.frontend.corrected_log import take_out
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors
from objslam.mapping.alternation import solve
from objslam.mapping.checks.agreement import agreement, bounded_part
from objslam.mapping.checks.diagnosis import Diagnosis
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.hypotheses.lens import LENS
from objslam.mapping.checks.hypotheses.trials import clear
from objslam.mapping.checks.parts.halves import check_halves, seen_in_both
from objslam.mapping.checks.parts.mixture import find_mixture
from objslam.mapping.checks.ranges import check_ranges
from objslam.mapping.joint.labels import may_be_by_label
from objslam.mapping.progress import Progress
from objslam.mapping.solution import Solution, seen_something

_EXPLAINED = 0.85
"""The least share of rays that agree with their objects, in each half of a log, for a solve that explains the boxes. A
larger share refutes fewer findings. Clean simulated logs have at least 0.92, logs with one of 20 faults at most 0.76."""
_NOISE = 2.0
"""The largest noise of rays and odometry in a solve that explains the boxes, as a multiple of the noise in the settings.
With more noise, wrong boxes fit too. A larger value refutes more findings. Corrected simulated logs have at most 1.6."""
_MORE = 0.05
"""The share of all rays by which a solve without the fault must explain more, so that a finding stands. A larger share
refutes more findings."""
_QUIETER = 0.5
"""The largest share of a solve's noise that the corrected log may need, so that a finding stands. It counts if the solve
explains the boxes only with much noise. A larger share refutes fewer findings. Two logs of an MRCLAM robot with a fault are
examples. In one, the images were mirrored, so that the path must turn the other way. The corrected log needs 0.17 of the
noise. In the other, base_T_camera was the identity. The corrected log needs 0.15 of the noise, which is still 2.9 times the
noise in the settings."""
_USUAL_NOISE = 1.1
"""The largest factor on the noise of rays and odometry at which a solve shows that the lens is right. The factor is 1.3 to
2.1, or far more, in simulated logs whose boxes have another lens. It is at most 1.0 in right logs. A larger factor saves
more solves, and finds fewer wrong lenses."""
_SHARPER, _QUIETER_LENS = 1.0, 0.75
"""The largest shares of the noise that may be left with another lens, so that the other lens counts as the right one. The
first share is of the noise of rays. The second is of the larger one of two noises: that of rays and that of odometry. In 18
simulated logs, the right lens has 0.4 to 1.0 and 0.2 to 0.9. A wrong lens has 1.1 or more in both. With larger shares, more
lenses count as wrong."""
_IN_BOTH = 0.55
"""The least share of rays on common objects in two halves of a log that agree. Common objects are seen in both halves. The
share is among the explained rays of each half (`seen_in_both`). A larger share refutes fewer findings. Clean simulated logs
have 0.63 and more. 32 logs were each put together from two recordings. They have at most 0.49 if the noise of rays is usual
and similar shares of both halves are explained. The largest shares are from logs with one label, where a bent path fits more
objects by chance."""

_OF_RANGES = ("odometry.scale", "range_scale", "range_offset", "surface")
"""The names of the shared errors that would explain ranges in a wrong scale. The test of this scale must not take these
errors out."""


def with_known_labels(diagnosis: Diagnosis, log: Log, rays: Rays, settings: Settings, progress: Progress) -> Settings:
    """Return the settings for the solve. They say that labels are names if the log shows this after a suspected fault is
    corrected.

    rays: of the unchanged log.

    With wrong input, the rays of a label agree on no object. A solve then doubts the labels, and associates the boxes
    without them. For a real robot of 15 minutes whose base_T_camera was inverted, this took 18 minutes, and found nothing.
    So the corrected log is solved with one object for each label, which takes seconds. If this solve explains the boxes,
    labels are names in the given log too.
    """
    findings = {one.name for one in diagnosis.findings if one.spoils and one.basis == "boxes"}
    named = [t.hypothesis for t in diagnosis.trials if t.hypothesis is not None and t.hypothesis.name in findings]
    if settings.association.method != "auto" or not named or not may_be_by_label(settings, rays):
        return settings
    by_label = settings.model_copy(update={"association": settings.association.model_copy(update={"method": "by_label"})})
    try:
        return by_label if _fits(_solved(named[0].put_right(log), by_label, progress)) else settings
    except ObjslamError:
        return settings


def without_refuted(diagnosis: Diagnosis, solution: Solution, log: Log, settings: Settings, progress: Progress) -> Diagnosis:
    """Return the diagnosis of a log without the findings about boxes that a joint solve refutes.

    solution: the solution of the unchanged log. A solution explains boxes only if the noise of rays that it finds is at most
    `_NOISE` times the noise in the settings.

    The test of a finding depends on its basis:

    - "boxes": the finding is wrong if the solution explains the boxes without noisy odometry. Otherwise the log is solved
      again without the fault, and `_refuted` compares the two solutions.
    - "halves": the finding is wrong if the solution explains the boxes of both halves, or if both halves have the same
      objects.
    - "frames": the finding is wrong if the solution explains similar shares of the rays in all frames.
    - "lens": the finding is wrong if a solve with the other lens does not need far less noise of rays.
    - "ranges": the solution has errors of clocks, turns and mounts. The finding is wrong if the ranges fit the odometry
      after these errors are taken out of the log.
    """
    kept = tuple(
        one
        for one in diagnosis.findings
        if not (one.basis != "log" and _refuted(one, diagnosis, solution, log, settings, progress))
    )
    return replace(diagnosis, findings=kept)


def _refuted(
    finding: Finding, diagnosis: Diagnosis, solution: Solution, log: Log, settings: Settings, progress: Progress
) -> bool:
    """Return whether a finding is wrong, as `without_refuted` says.

    For the basis "boxes", the first solution is that of the log, and the second is that of the log without the fault:

    - If the second solution does not explain the boxes, the solves show nothing. The finding then stands if the quick check
      is clear.
    - If both solutions explain the boxes, the finding stands if the second one needs far less noise.
    - If only the second solution explains the boxes, it must explain clearly more rays than the first. Its noise must also
      be near the settings, or far less than that of the first. Then the finding stands.
    """
    quiet = _noise(solution, rays_only=True) <= _NOISE
    if finding.basis == "frames":
        return quiet and find_mixture(solution.rays.keyframe, _explained(solution)) is None
    if finding.basis == "ranges":
        return quiet and not _ranges_differ(log, solution, settings)
    if finding.basis == "lens":
        return not _other_lens(diagnosis, solution, log, settings, progress)
    explained = quiet and _least_explained(solution) >= _EXPLAINED
    if finding.basis == "halves":
        # After rounds of association, an object may be in the map twice, once for each half.
        return (explained and not solution.rounds) or (quiet and _halves_agree(solution))
    loud = _noise(solution) > _NOISE
    if explained and not loud:
        return True
    named = [t.hypothesis for t in diagnosis.trials if t.hypothesis is not None and t.hypothesis.name == finding.name]
    if not named:
        return explained
    unclear = not clear(diagnosis.trials, finding.name)
    try:
        other = _solved(named[0].put_right(log), settings, progress)
    except ObjslamError:
        return unclear
    if not _fits(other):
        return unclear  # A solve may also fail at right boxes, for example if it takes two things for one.
    quieter = _noise(other) <= _QUIETER * _noise(solution)
    if explained:  # A path that is free to bend explains boxes of a mirrored image too.
        return not quieter
    more = _explained(other).mean() >= _explained(solution).mean() + _MORE
    exact = _noise(other, rays_only=True) <= _QUIETER * _noise(solution, rays_only=True)
    return not (more and (exact or quieter or _noise(other) <= _NOISE))


def _other_lens(diagnosis: Diagnosis, solution: Solution, log: Log, settings: Settings, progress: Progress) -> bool:
    """Return whether a solve with the suspected other lens shows that the boxes of a log have this lens."""
    named = next(t.hypothesis for t in diagnosis.trials if t.hypothesis is not None and t.hypothesis.name == LENS)
    if _noise(solution) <= _USUAL_NOISE:
        return False
    try:
        other = _solved(named.put_right(log), settings, progress)
    except ObjslamError:
        return False
    sharper = _noise(other, rays_only=True) <= _SHARPER * _noise(solution, rays_only=True)
    return sharper and _noise(other) <= _QUIETER_LENS * _noise(solution)


def _fits(solution: Solution) -> bool:
    """Return whether a solution explains the boxes without noisy rays."""
    return _least_explained(solution) >= _EXPLAINED and _noise(solution, rays_only=True) <= _NOISE


def _solved(log: Log, settings: Settings, progress: Progress) -> Solution:
    ledger = Ledger()
    frames = build_keyframes(log, settings, ledger)
    rays = build_rays(log, frames, settings, ledger)
    if not len(rays):
        raise SolveError("no box gives a usable ray", where=log.name)
    errors = shared_errors(log, *seen_something(frames, rays), settings)
    cameras = tuple(one.camera for one in log.cameras)
    quiet = settings.model_copy(update={"output": settings.output.model_copy(update={"recording": False})})
    return solve(frames, rays, cameras, quiet, ledger, progress, errors=errors)


def _explained(solution: Solution) -> Bools:
    """Return a mask (R,) of the rays that agree with their object."""
    return np.asarray((solution.estimate.weight > 0) & (solution.association.object >= 0))


def _late(solution: Solution) -> Bools:
    """Return a mask (R,) of the later half of the rays."""
    stamps = solution.keyframes.stamps[solution.rays.keyframe]
    return np.asarray(stamps > np.median(stamps))


def _least_explained(solution: Solution) -> float:
    """Return the share of explained rays in that half of the log where it is smaller."""
    explained, late = _explained(solution), _late(solution)
    return float(min(explained[mask].mean() if mask.any() else 0.0 for mask in (late, ~late)))


def _noise(solution: Solution, *, rays_only: bool = False) -> float:
    """Return the largest factor on the noise of rays and odometry. With `rays_only`, return the factor on the noise of
    rays."""
    found = solution.estimate.noise
    if found is None:
        return 1.0
    return found.rays if rays_only else max(found.rays, found.along, found.turning)


def _ranges_differ(log: Log, solution: Solution, settings: Settings) -> bool:
    """Return whether the scales of ranges and odometry differ after the other shared errors of the solution are taken
    out."""
    found = solution.estimate.calibration
    if found is None:
        return True
    values = dict(zip(found.names, found.values.tolist(), strict=True))
    other = {name: value for name, value in values.items() if name not in _OF_RANGES}
    part = bounded_part(take_out(log, other), settings)
    measured = agreement(part, part.log, settings)
    return measured is not None and check_ranges(measured, part) is not None


def _halves_agree(solution: Solution) -> bool:
    """Return whether the rays of both halves fit the solved objects, and both halves see the same objects."""
    explained, late = _explained(solution), _late(solution)
    if check_halves(late, explained) is not None:
        return False
    return seen_in_both(late, explained, solution.association.object) >= _IN_BOTH
