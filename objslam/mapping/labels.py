"""Judge whether each label names a single object. Then the labels alone tell which rays belong together."""

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
"""A label has a second object if at least `MANY` of its rays, and more than the share `SECOND`, are rejected. Larger values
find fewer."""
_JUDGEMENTS = 2
"""How often `noise_explains` solves, each time with the noise that the last solve found. A solve that rejects rays finds too
little noise, so a second one finds more. A larger number is slower."""
_SAME_NOISE = 0.1
"""The relative change of the noise below which `noise_explains` does not solve again. A larger value ends sooner."""

_CLOCKS = (-1.0, 1.0, -2.0, 2.0)
"""The clock offsets that `clock_explains` tries, in standard deviations of their prior. A solve converges from one standard
deviation away, so a denser grid is slower and finds nothing new. A wider grid finds clocks that the prior excludes."""
_SHORT = 500
"""The largest number of keyframes of a log for which `clock_explains` tries clock offsets. A longer log has enough rays to
find its clock in one solve. A larger number is slower."""

_LARGER = 1.5
"""The factor on the noise of the settings above which `warn_of_noise` names it. A larger factor names less noise."""


def may_be_by_label(settings: Settings, rays: Rays) -> bool:
    """Return whether to try one object for each label.

    association.method decides: `by_label` is yes. `auto` is yes if no keyframe has two rays of one label.
    """
    if settings.association.method != "auto":
        return settings.association.method == "by_label"
    pairs = np.stack([rays.keyframe, rays.label])
    return np.unique(pairs, axis=1).shape[1] == pairs.shape[1]


def labels_tell(association: Association, estimate: Estimate) -> bool:
    """Return whether every label is one object: no label has many rejected rays (`MANY`).

    An object without a position is ignored, because its rays may only have too little parallax. False if no object has a
    position.
    """
    placed = np.isfinite(estimate.positions[:, 0])
    held = association.object >= 0
    number = np.bincount(association.object[held], minlength=association.count)
    rejected = np.bincount(association.object[held & (estimate.weight == 0)], minlength=association.count)
    return bool(placed.any()) and not (placed & (rejected >= MANY) & (rejected > SECOND * number)).any()


def clock_explains(association: Association, errors: SharedErrors, solve: Callable[[Floats], Estimate]) -> Floats | None:
    """Return shared errors (P,) from which a solve finds one object for each label. None if there are none.

    A solve that starts with a wrong clock offset rejects true rays. In a short log, too few rays are left to find the clock.
    So the solve is tried from each clock offset in `_CLOCKS`. solve: solves once, from the given shared errors (P,).
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
    """Return an estimate with larger noise in which each label is one object. None if larger noise does not help.

    With too little noise in the settings, poses cannot move far enough. Then the rays of one object look like rays of
    several. So the noise is estimated, even if the settings fix it, and the labels are judged again.

    estimate: in which some label has many rejected rays. errors: the shared errors of the log. solve: solves once.
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
    """Warn if the settings fix the noise, and `estimate` found more. In `estimate`, each label is one object."""
    said = errors.with_unknown_noise().unknown_noise - errors.unknown_noise
    if estimate.noise is None or not said:
        return
    factors = ", ".join(f"{kind} {factor:.2g}" for kind, factor in estimate.noise.to_dict(None).items() if factor > _LARGER)
    if factors:
        ledger.warn(
            f"the settings say too little noise for this log (factors found: {factors}), and many boxes are rejected; "
            f"leave the noise out of the settings, or set {', '.join(f'noise.{kind}=true' for kind in sorted(said))}"
        )
