"""The covariances of objects in a merge of sessions: those of each session's measurements, and those of the site."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from objslam.association.registration.joint_frames import JointFrames, Measured
from objslam.core.arrays import Floats
from objslam.core.maps.shared_covariance import NUMBERS, SIZE, jacobian, own_part, root_of, shared_covariance
from objslam.core.object_map import MapObject

Row = tuple[int, int, MapObject]
"""One object of one session: the number of the session, the number of its track, and the object."""
_REMEMBERED = 5
"""The largest weight of an object of a site in a solve, as a number of sessions. The weight is the number of sessions that
saw the object, up to this limit. With a larger number, the position averages more sessions, and follows a nudged object more
slowly."""


def measured_objects(rows: list[Row], shared: Sequence[Floats | None]) -> Measured:
    """Return the objects of S sessions as measurements of their tracks. shared: for each session, the covariance (7, 7) of
    the error that its objects share, None if it is not known."""
    maps, objects = (np.array([row[n] for row in rows], dtype=np.int64) for n in (0, 1))
    positions = np.array([o.position for _, _, o in rows]).reshape(-1, 3)
    roots = np.array([np.zeros((NUMBERS, NUMBERS)) if one is None else root_of(one) for one in shared])
    covariance = np.array([o.covariance for _, _, o in rows]).reshape(-1, 3, 3)
    own = own_part(covariance, jacobian(positions) @ roots[maps])
    often = np.array([1 if o.life is None else min(max(o.life.sessions_seen, 1), _REMEMBERED) for _, _, o in rows])
    return Measured(maps, objects, positions, own / often[:, None, None], roots)


def site_covariances(solved: JointFrames, rows: list[Row], shared: Sequence[Floats | None]) -> tuple[Floats, Floats]:
    """Return the covariances (N, 3, 3) m^2 of the tracks, and their correlated part as a factor (N, 3, m) m.

    Some errors repeat from session to session, such as the errors of an object's boxes and the scale of a robot's odometry.
    Many sessions do not average these errors out. So the own error of an object is at least its own error in its best
    session. The size of the site is at least as uncertain as the size of the best session.
    """
    measured = measured_objects([(s, k, replace(o, life=None)) for s, k, o in rows], shared)
    assert measured.roots is not None
    maps, tracks, own = measured.map, measured.object, measured.covariance
    size = np.trace(own, axis1=1, axis2=2)
    order = np.lexsort((size, tracks))
    best = order[np.unique(tracks[order], return_index=True)[1]]  # The row with the least own errors of each track.
    rotation = solved.site_T_map[maps[best], :3, :3]
    least = rotation @ own[best] @ np.swapaxes(rotation, 1, 2)
    enough = np.trace(solved.own, axis1=1, axis2=2) >= size[best]
    alone = np.where(enough[:, None, None], solved.own, least)
    factor = solved.correlated
    found = shared_covariance(solved.positions, alone + factor @ np.swapaxes(factor, 1, 2), factor)
    if found is not None:
        more = max(min(0.0 if one is None else float(one[SIZE, SIZE]) for one in shared) - float(found[SIZE, SIZE]), 0.0)
        column = np.sqrt(more) * (solved.positions - solved.positions.mean(axis=0))
        factor = np.concatenate([factor, column[..., None]], axis=2)
    return alone + factor @ np.swapaxes(factor, 1, 2), factor
