"""Objects that have a position, but a wide sigma: a robot that drives to one of them may miss it."""

from __future__ import annotations

import numpy as np

from objslam.core.maps.shared_covariance import jacobian, own_part, root_of
from objslam.core.result import Doubt, RunResult

_NAMED = 3
"""The most objects that the assessment names. A larger number makes the assessment longer."""
_MOST = 0.5
"""A map is good only if at most this share of its objects with a position is unsure. With a larger share, more maps are
good."""


def unsure_objects(result: RunResult) -> list[Doubt]:
    """Return a doubt for each object with a position whose sigma exceeds `triangulation.sure_sigma`, the least sure first.

    The error that all objects share does not count: it moves the map, and a robot in it, as a whole.
    """
    known = [o for o in result.map if o.covariance is not None and o.status == "ok"]
    if not known:
        return []
    covariance = np.array([o.covariance for o in known])
    if result.map.shared_covariance is not None:
        shared = jacobian(np.array([o.position for o in known])) @ root_of(result.map.shared_covariance)
        covariance = own_part(covariance, shared)
    sigma = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
    most = result.settings.triangulation.sure_sigma
    found = []
    for i in np.argsort(-sigma, kind="stable").tolist():
        o = known[i]
        if sigma[i] <= most:
            break
        found.append(
            Doubt(
                "unsure",
                "wide sigma",
                o.label,
                f"{o.label} #{o.id} has a sigma of {sigma[i]:.2f} m in its least certain direction "
                f"(triangulation.sure_sigma {most:g} m): its {o.rays} rays span {o.parallax_deg:.1f} deg. Drive around "
                "it, or past it nearby.",
                (o.id,),
                o.position,
                np.flatnonzero(result.association.object == o.id),
                {"sigma_m": float(sigma[i]), "rays": o.rays, "parallax_deg": o.parallax_deg},
            )
        )
    return found


def in_assessment(doubts: list[Doubt], result: RunResult) -> list[str]:
    """Return the sentence about the objects for the assessment."""
    if not doubts:
        return []
    names = [f"{one.label} #{one.objects[0]} ({one.numbers['sigma_m']:.2f} m)" for one in doubts[:_NAMED]]
    more = f" and {len(doubts) - _NAMED} more" if len(doubts) > _NAMED else ""
    have = "1 position has a sigma" if len(doubts) == 1 else f"{len(doubts)} positions have a sigma"
    return [f"{have} above {result.settings.triangulation.sure_sigma:g} m: {', '.join(names)}{more}."]


def are_most(doubts: list[Doubt], result: RunResult) -> bool:
    """Return whether most objects with a position are unsure."""
    return len(doubts) > _MOST * len(result.map.resolved())
