"""Finds names that boxes contradict: many boxes of the label do not fit its landmark."""

import numpy as np

from objslam.core.arrays import Bools
from objslam.live.mapper.state import MapState
from objslam.mapping.joint.labels import MANY, SECOND


def contradicted(m: MapState) -> Bools:
    """Return which landmarks (N,) have a name and many rays that do not fit, as in `mapping.joint.labels.rejected`.

    Until the label is judged, the position of such a landmark is uncertain. The label may belong to a thing that moves, or
    to several things. After a solve has confirmed a name, only later rays count.
    """
    landmarks, rays = m.landmarks, m.rays
    if not len(landmarks) or m.settings.association.method != "auto":
        return np.zeros(len(landmarks), dtype=bool)
    since = np.zeros(len(m.labels), dtype=np.int64)
    since[list(m.kinds.confirmed)] = list(m.kinds.confirmed.values())
    held = np.flatnonzero((rays.owner >= 0) & (rays.number >= since[rays.label]))
    row = m.rows_of(rays.owner[held])
    number = np.bincount(row, minlength=len(landmarks))
    beyond = number - np.bincount(row[rays.used[held]], minlength=len(landmarks))
    return np.asarray(m.kinds.name(landmarks.label) & (beyond >= MANY) & (beyond > SECOND * number))
