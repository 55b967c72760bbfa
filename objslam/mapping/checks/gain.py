"""The certainty with which a change of a log explains its boxes better."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.mapping.checks.agreement import Agreement

_PARTS = 20
"""The number of parts of a log whose gains are compared. More parts give a more certain answer, but the parts must be longer
than the time in which the errors of boxes stay the same."""


def gain_in_sigmas(before: Agreement, after: Agreement) -> float:
    """Return the gain of the fit of all rays by a change of a log, in standard deviations of this gain.

    before, after: of the log without and with the change. The log is cut into parts in time with equally many rays. The
    errors of neighbouring rays are not independent, so the gain of each part counts as one measurement (batch means).
    """
    edges = np.quantile(_stamps(before), np.arange(1, _PARTS) / _PARTS)
    gains = _fit_of_parts(after, edges) - _fit_of_parts(before, edges)
    sigma = float(gains.std(ddof=1)) * np.sqrt(_PARTS)
    return float(gains.sum()) / sigma if sigma > 0 else 0.0


def _stamps(found: Agreement) -> Floats:
    """Return the stamp of each ray (R,)."""
    return found.keyframes.stamps[found.rays.keyframe]


def _fit_of_parts(found: Agreement, edges: Floats) -> Floats:
    """Return the sum of the fits of the rays in each part. edges: the stamps between the parts."""
    part = np.searchsorted(edges, _stamps(found))
    return np.bincount(part, found.fit, minlength=len(edges) + 1).astype(float)
