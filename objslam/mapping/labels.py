"""Judge whether labels tell objects apart: whether each label is one object."""

from collections.abc import Callable

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.estimate import Estimate
from objslam.core.noise import NOMINAL
from objslam.core.types import Association, Rays
from objslam.frontend.shared_errors import SharedErrors

MANY, SECOND = 5, 0.25
"""The number and the share of a label's rays that must disagree with its object before a second object is assumed. Larger
values accept fewer second objects."""
_JUDGEMENTS = 2
"""How often labels are judged again with the noise that the last solve found. Rejected rays hide noise, so the second time
finds more of it. More judgements are slower."""
_SAME_NOISE = 0.1
"""The relative change of the noise below which labels are not judged again. A larger change ends sooner."""

_LARGER = 1.5
"""The factor on the noise of the settings above which a warning names it. A larger factor names less."""


def may_be_by_label(settings: Settings, rays: Rays) -> bool:
    """Return whether to try one object for each label.

    association.method decides. If it is auto, this is tried if no keyframe has two rays of one label.
    """
    if settings.association.method != "auto":
        return settings.association.method == "by_label"
    pairs = np.stack([rays.keyframe, rays.label])
    return np.unique(pairs, axis=1).shape[1] == pairs.shape[1]


def labels_tell(association: Association, weight: Floats) -> bool:
    """Return whether every label is one object: no label has many rejected rays (weight (R,) 0)."""
    held = association.object >= 0
    number = np.bincount(association.object[held], minlength=association.count)
    rejected = np.bincount(association.object[held & (weight == 0)], minlength=association.count)
    return not ((rejected >= MANY) & (rejected > SECOND * number)).any()


def noise_explains(
    association: Association, estimate: Estimate, errors: SharedErrors, solve: Callable[[SharedErrors], Estimate]
) -> Estimate | None:
    """Return the solution with one object for each label in which the labels tell, None if there is none.

    With too little noise in the settings, poses cannot move as far as they should, and the rays of one object seem to be
    those of several. So all noise is estimated, also if the settings say it, and the labels are judged with it.

    estimate: the solution in which they do not tell. errors: those that the next solve starts from. solve: solves once.
    """
    errors = errors.with_unknown_noise()
    before = NOMINAL if estimate.noise is None else estimate.noise
    for _ in range(_JUDGEMENTS):
        estimate = solve(errors)
        if labels_tell(association, estimate.weight):
            return estimate
        if estimate.noise is None or estimate.noise.like(before, _SAME_NOISE):
            return None
        before = estimate.noise
        errors = errors.with_noise(before)
    return None


def warn_of_noise(errors: SharedErrors, estimate: Estimate, ledger: Ledger) -> None:
    """Warn of noise in the settings that is too small, by the noise of an estimate in which the labels tell."""
    said = errors.with_unknown_noise().unknown_noise - errors.unknown_noise
    if estimate.noise is None or not said:
        return
    factors = ", ".join(f"{kind} {factor:.2g}" for kind, factor in estimate.noise.to_dict(None).items() if factor > _LARGER)
    if factors:
        ledger.warn(
            f"the settings say too little noise for this log (factors found: {factors}), and many boxes are rejected; "
            f"leave it out of the settings, or set {', '.join(f'noise.{kind}=true' for kind in sorted(said))}"
        )
