"""Findings that the solve refutes: a joint solve may correct what a quick look at the boxes takes for wrong input.

The quick look holds odometry and calibration as they are, for some seconds each. A camera that is turned by some degrees and
late by a tenth of a second lets few boxes fit then, and few boxes fit many hypotheses by chance. Objects that are seen under
little parallax in one half of a log get no point there. So the solved map answers the same question again.
"""

from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools
from objslam.core.diagnostics import Ledger
from objslam.core.types import Log
from objslam.errors import ObjslamError, SolveError
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.shared_errors import shared_errors
from objslam.mapping.alternation import Solution, seen_something, solve
from objslam.mapping.checks.diagnosis import Diagnosis
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.halves import check_halves, seen_in_both
from objslam.mapping.checks.mixture import find_mixture
from objslam.mapping.progress import Progress

_EXPLAINED = 0.85
"""The share of the rays in each half of a log from which on a solve explains the boxes. A larger share refutes fewer
findings. Clean simulated logs have 0.92 and more, those with one of 20 kinds of wrong boxes or cameras at most 0.76."""
_NOISE = 2.0
"""The largest noise of rays and odometry, times that of the settings, with which the log put right must be explained. With
enough noise everything fits. Simulated logs that are put right have at most 1.6."""
_MORE = 0.05
"""How much more of the rays the log put right must explain. A larger share refutes more findings."""
_IN_BOTH = 0.4
"""The share of the explained rays of a half that must belong to objects seen in both halves (`seen_in_both`), for the halves
to agree. A larger share refutes fewer findings. Simulated clean logs with such a finding have 0.63 and more. Those of two
recordings have at most 0.23 if the solve explains the rays of both."""


def without_refuted(diagnosis: Diagnosis, solution: Solution, log: Log, settings: Settings, progress: Progress) -> Diagnosis:
    """Return the diagnosis of a log without the findings that rest on the boxes alone, and that a joint solve refutes.

    solution: of the log as it is. If it explains the boxes, they are right. Else the log is put right as a finding says, and
    solved. If this explains the boxes no better, the finding is wrong.
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
    quiet = _noise(solution, rays_only=True) <= _NOISE
    if finding.basis == "frames":
        return quiet and find_mixture(solution.rays.keyframe, _explained(solution)) is None
    explained = quiet and _least_explained(solution) >= _EXPLAINED
    if finding.basis == "halves":
        # Where labels do not name the objects, an object that is there twice would explain the boxes of both halves.
        return (explained and not solution.rounds) or (quiet and _halves_agree(solution))
    if explained:
        return True
    named = [t.hypothesis for t in diagnosis.trials if t.hypothesis is not None and t.hypothesis.name == finding.name]
    if not named:
        return False
    try:
        other = _solved(named[0].put_right(log), settings, progress)
    except ObjslamError:
        return True
    explains = _least_explained(other) >= _EXPLAINED and _noise(other) <= _NOISE
    return not explains or _explained(other).mean() < _explained(solution).mean() + _MORE


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
    """(R,) the rays that agree with their object."""
    return np.asarray((solution.estimate.weight > 0) & (solution.association.object >= 0))


def _late(solution: Solution) -> Bools:
    """(R,) the rays in the second half of the log."""
    stamps = solution.keyframes.stamps[solution.rays.keyframe]
    return np.asarray(stamps > np.median(stamps))


def _least_explained(solution: Solution) -> float:
    """The share of explained rays in the half that has fewer of them."""
    explained, late = _explained(solution), _late(solution)
    return float(min(explained[mask].mean() if mask.any() else 0.0 for mask in (late, ~late)))


def _noise(solution: Solution, *, rays_only: bool = False) -> float:
    """The largest factor on the noise of rays and odometry."""
    found = solution.estimate.noise
    if found is None:
        return 1.0
    return found.rays if rays_only else max(found.rays, found.along, found.turning)


def _halves_agree(solution: Solution) -> bool:
    """Return whether the rays of both halves fit the solved objects, and these are the same objects."""
    explained, late = _explained(solution), _late(solution)
    if check_halves(late, explained) is not None:
        return False
    return seen_in_both(late, explained, solution.association.object) >= _IN_BOTH
