"""Judge whether each label belongs to a single object."""

from collections.abc import Callable

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.calibration import kind
from objslam.core.diagnostics import Ledger
from objslam.core.estimate import Estimate
from objslam.core.noise import NOMINAL
from objslam.core.types import Association, Rays
from objslam.frontend.shared_errors import SharedErrors

MANY, SECOND = 5, 0.25
"""A label has a second object if at least this number, and more than this share, of its rays disagree with the first one.
Larger values accept fewer second objects."""
_JUDGEMENTS = 2
"""How often labels are judged again with the noise of the last solve. Rejected rays hide noise, so the second judgement
finds more noise. More judgements are slower."""
_SAME_NOISE = 0.1
"""The relative change of the noise below which labels are not judged again. A larger value ends sooner."""

_CLOCKS = (-1.0, 1.0, -2.0, 2.0)
"""The tried clock offsets, in standard deviations of their prior. A solve finds a clock within one standard deviation, so
closer values are slower and find nothing new. Farther values find clocks that the prior excludes."""
_SHORT = 500
"""Clock offsets are tried only for a log with at most this many keyframes. Longer logs determine the clock by themselves."""

_LARGER = 1.5
"""A warning names noise that is larger than the settings by more than this factor. A larger factor names less."""


def may_be_by_label(settings: Settings, rays: Rays) -> bool:
    """Return whether to try one object for each label.

    association.method decides. With `auto`, the answer is yes if no keyframe has two rays of one label.
    """
    if settings.association.method != "auto":
        return settings.association.method == "by_label"
    pairs = np.stack([rays.keyframe, rays.label])
    return np.unique(pairs, axis=1).shape[1] == pairs.shape[1]


def labels_tell(association: Association, estimate: Estimate) -> bool:
    """Return whether every label is one object, because no label has many rejected rays.

    A label whose object has no position is ignored, because its rays may have too little parallax. False if no object has a
    position.
    """
    placed = np.isfinite(estimate.positions[:, 0])
    held = association.object >= 0
    number = np.bincount(association.object[held], minlength=association.count)
    rejected = np.bincount(association.object[held & (estimate.weight == 0)], minlength=association.count)
    return bool(placed.any()) and not (placed & (rejected >= MANY) & (rejected > SECOND * number)).any()


def clock_explains(association: Association, errors: SharedErrors, solve: Callable[[Floats], Estimate]) -> Floats | None:
    """Return shared errors (P,) from which a solve of a short log ends with one object for each label. None if none do.

    With a wrong clock, the start of a solve rejects true rays. A short log has too few other rays to find the clock. So a
    solve starts from each clock of a coarse grid. solve: solves once, from shared errors.
    """
    clocks = np.array([kind(name) == "clock" for name in errors.names], dtype=bool)
    if not clocks.any() or len(errors.keyframes) > _SHORT:
        return None
    for share in _CLOCKS:
        theta = errors.mean + share * np.where(clocks, np.sqrt(np.diagonal(errors.prior)), 0.0)
        theta = np.clip(theta, -errors.bounds, errors.bounds)
        if labels_tell(association, solve(theta)):
            return theta
    return None


def noise_explains(
    association: Association, estimate: Estimate, errors: SharedErrors, solve: Callable[[SharedErrors], Estimate]
) -> Estimate | None:
    """Return the solution with one object for each label if larger noise makes all labels agree. None if it does not.

    With too little noise in the settings, poses cannot move far enough. Then rays of one object look like rays of several
    objects. So all noise is estimated, even if the settings fix it, and the labels are judged with this noise.

    estimate: the solution in which labels disagree. errors: the shared errors at the start of the first solve. solve: solves
    once.
    """
    errors = errors.with_unknown_noise()
    before = NOMINAL if estimate.noise is None else estimate.noise
    for _ in range(_JUDGEMENTS):
        estimate = solve(errors)
        if labels_tell(association, estimate):
            return estimate
        if estimate.noise is None or estimate.noise.like(before, _SAME_NOISE):
            return None
        before = estimate.noise
        errors = errors.with_noise(before)
    return None


def warn_of_noise(errors: SharedErrors, estimate: Estimate, ledger: Ledger) -> None:
    """Warn if the settings have less noise than an estimate in which the labels agree."""
    said = errors.with_unknown_noise().unknown_noise - errors.unknown_noise
    if estimate.noise is None or not said:
        return
    factors = ", ".join(f"{kind} {factor:.2g}" for kind, factor in estimate.noise.to_dict(None).items() if factor > _LARGER)
    if factors:
        ledger.warn(
            f"the settings say too little noise for this log (factors found: {factors}), and many boxes are rejected; "
            f"leave the noise out of the settings, or set {', '.join(f'noise.{kind}=true' for kind in sorted(said))}"
        )
