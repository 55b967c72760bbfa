"""Register two object maps to each other, if the transform between their frames is unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from objslam.association.place_recognition import Constellation
from objslam.association.registration.map_registration import MIN_LOG_ODDS, Registration, register_maps
from objslam.core.object_map import ObjectMap


def register(a: ObjectMap, b: ObjectMap) -> Registration:
    """Find the transform b_T_a from the frame of map a to the frame of map b, from the relative positions of their objects.

    Both frames have z up. The transform turns about z and shifts along x, y and z. Only resolved objects count. `matches`
    are indices into the objects of a and b. Use the transform only if `accepted` is true.
    """
    names = sorted({o.label for m in (a, b) for o in m})
    number = {name: k for k, name in enumerate(names)}
    kept = [placed(a), placed(b)]
    one, other = (
        Constellation(
            m.positions[some], m.covariances[some], np.array([number[m.objects[i].label] for i in some], dtype=np.int64)
        )
        for m, some in zip((a, b), (np.array(k, dtype=np.int64) for k in kept), strict=True)
    )
    found = register_maps(one, other, a.shared_covariance, b.shared_covariance)
    pairs = [(kept[0][i], kept[1][k]) for i, k in found.matches.tolist()]
    return replace(found, matches=np.array(pairs, dtype=np.int64).reshape(-1, 2))


def placed(objects: ObjectMap) -> list[int]:
    """Return the indices of the objects that a registration can use: resolved ones with a covariance."""
    return [i for i, o in enumerate(objects.objects) if o.status == "ok" and o.covariance is not None]


def reason(found: Registration, a: ObjectMap, b: ObjectMap, names: tuple[str, str]) -> str:
    """Return in a few words why the registration of a to b was accepted or refused. names: the names of a and b in this
    text."""
    for name, objects in zip(names, (a, b), strict=True):
        if (number := len(placed(objects))) < 2:
            return f"too little evidence, because {name} has {number or 'no'} resolved object"
    if not len(found.matches):
        return "too little evidence, because no two objects have the same offset in both maps"
    odds = f"{len(found.matches)} objects match, log odds {found.log_odds:.1f}, lead {found.lead:.1f}"
    if found.verdict == "ambiguous":
        return f"ambiguous, because another place fits as well ({odds})"
    needed = f"{MIN_LOG_ODDS:.1f} are needed, and five or six objects usually give them"
    return odds if found.accepted else f"too little evidence ({odds}; {needed})"
