"""Register the map of one run to the map of another run, if the transform between their frames is unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from objslam.association.place_recognition import Constellation
from objslam.association.registration.map_registration import Registration, register_maps
from objslam.core.object_map import ObjectMap


def register(a: ObjectMap, b: ObjectMap) -> Registration:
    """Find the transform b_T_a from the frame of map a to the frame of map b, by the relative positions of their objects.

    Both frames have z up. The transform turns about z and shifts along x, y and z. Only resolved objects count. `matches`
    are indices into the objects of a and b. Use the transform only if `accepted` is true. Otherwise `verdict` says why not.
    """
    names = sorted({o.label for m in (a, b) for o in m})
    number = {name: k for k, name in enumerate(names)}
    kept = [[i for i, o in enumerate(m.objects) if o.status == "ok" and o.covariance is not None] for m in (a, b)]
    maps = (
        Constellation(
            m.positions[some], m.covariances[some], np.array([number[m.objects[i].label] for i in some], dtype=np.int64)
        )
        for m, some in zip((a, b), (np.array(k, dtype=np.int64) for k in kept), strict=True)
    )
    found = register_maps(*maps)
    pairs = [(kept[0][i], kept[1][k]) for i, k in found.matches.tolist()]
    return replace(found, matches=np.array(pairs, dtype=np.int64).reshape(-1, 2))
