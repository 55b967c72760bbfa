"""Factors on keyframe poses: absolute poses from localisation, and motions between consecutive keyframes."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import inverse, is_planar
from objslam.graph.factors import odometry
from objslam.graph.factors.localization import localizations
from objslam.live.mapper.state import MapState


def localize(m: MapState) -> bool:
    """Add absolute poses to the pending keyframes that the localisation covers by now. Return whether the map moved.

    The first absolute pose moves the whole map, because odometry alone gives the map relative to its own start.
    """
    if not m.localization.received or not m.localization.pending:
        return False
    left, moved, path = [], False, m.course.localization
    for k in m.localization.pending:
        row = int(np.searchsorted(m.keyframes.id, k))
        if row == len(m.keyframes) or m.keyframes.id[row] != k:
            continue
        stamp = float(m.keyframes.stamp[row])
        if stamp > path.newest:
            left.append(k)
        if (found := path.at(stamp)) is None:
            continue
        planar = m.localization.planar and is_planar(np.stack([np.eye(4), path.from_start(found.pose)]))
        m.localization.planar = planar
        first = not m.keyframes.localized.any() and bool(m.keyframes.by_odometry.any())
        if first:
            _move_onto(m, row, found.pose)
        m.keyframes.map_T_base[row] = found.pose
        m.keyframes.localized[row] = True
        one = m.keyframe_arrays(np.array([row]))
        m.graph.add_absolute(k, localizations(one, m.settings, k, planar)[0])
        if first:
            moved = True
            if len(np.unique(m.keyframes.piece)) > 1:  # Motions across gaps of the odometry are no longer needed.
                chain_keyframes(m)
            m.graph.rebuild()
    m.localization.pending = left
    return moved


def chain_keyframes(m: MapState) -> None:
    """Connect consecutive keyframes by their motion. The caller must rebuild the graph.

    If the odometry did not measure a motion, a weak factor replaces it. No factor is needed if the later keyframe and some
    earlier keyframe are localised, because their absolute poses relate the two.
    """
    k, order = m.keyframes, m.time_order()
    every = m.keyframe_arrays(order)
    if every.odom_T_base is None:
        return
    ids, localized, measured = k.id[order].tolist(), k.localized[order], every.measured
    tied = measured | ~localized[1:] | ~np.logical_or.accumulate(localized)[:-1]
    wrong = [i for i in range(1, len(ids)) if not measured[i - 1] or m.graph.before(ids[i]) != ids[i - 1]]
    for i in wrong:
        m.graph.drop_motion(ids[i])
    to_tie = [i for i in wrong if tied[i - 1]]
    pairs = np.array([[i - 1, i] for i in to_tie], dtype=np.int64).ravel()
    on_plane = m.course.odometry.planar
    motion, covariance = odometry.motions(every.take(pairs), m.settings, on_plane)
    loose = odometry.unknown_motion(every.base_T_camera, m.settings, on_plane)
    for i, step, spread in zip(to_tie, motion[::2], covariance[::2], strict=True):
        m.graph.add_motion(ids[i - 1], ids[i], step, spread if measured[i - 1] else loose[i])


def _move_onto(m: MapState, row: int, map_T_base: Floats) -> None:
    """Move the whole map, so that the robot has the pose map_T_base (4, 4) at the keyframe of a row."""
    m.graph.update()
    there = map_T_base @ m.keyframes.base_T_camera[row] @ inverse(m.graph.pose(int(m.keyframes.id[row])))
    m.graph.drop_absolute()
    m.move(there)
