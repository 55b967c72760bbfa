"""Factors on keyframe poses: absolute poses from localisation, and motions between consecutive keyframes."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import inverse, is_planar
from objslam.graph.factors import odometry
from objslam.graph.factors.localization import localization, localization_covariance, localized_motions
from objslam.live.mapper.state import MapState


def localize(m: MapState) -> bool:
    """Add absolute poses to the pending keyframes that the localisation now covers. Return whether the whole map moved.

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
        _place(m, row)
        if first:
            moved = True
            if len(np.unique(m.keyframes.piece)) > 1:  # Motions across gaps of the odometry are no longer needed.
                chain_keyframes(m)
            m.graph.rebuild()
    m.localization.pending = left
    return moved


def _place(m: MapState, row: int) -> None:
    """Add the absolute pose of the newest localised keyframe, and the motion that the localisation measures up to this
    keyframe.

    If errors last, each pose has a part of the information that all poses have together. This part depends on the times of
    the poses before and after. The next pose is assumed to follow after the same time as that since the previous pose.
    """
    k, others = m.keyframes, m.keyframes.localized.copy()
    others[row] = False
    earlier = np.flatnonzero(others & (k.stamp <= k.stamp[row]))
    before = int(earlier[k.stamp[earlier].argmax()]) if len(earlier) else None
    gap = np.inf if before is None else k.stamp[row] - k.stamp[before]
    amid = m.keyframe_arrays(np.full(3, row))
    amid = replace(amid, stamps=amid.stamps + np.array([-gap, 0.0, gap]))
    covariance = localization_covariance(amid, m.settings, m.localization.planar)[1]
    number = int(k.id[row])
    m.graph.add_absolute(number, localization(number, amid.map_T_camera[1], covariance))
    if before is None or m.graph.before(number) is not None:
        return
    found = localized_motions(m.keyframe_arrays(np.array([before, row])), m.settings, m.localization.planar)
    if found is not None:
        m.graph.add_motion(int(k.id[before]), number, found.motion[0], found.covariance[0])


def place_keyframes(m: MapState) -> None:
    """Replace the absolute poses of all localised keyframes. The caller must rebuild the graph."""
    rows = m.time_order()
    rows = rows[m.keyframes.localized[rows]]
    if not len(rows):
        return
    every = m.keyframe_arrays(rows)
    covariance = localization_covariance(every, m.settings, m.localization.planar)
    for k, pose, spread in zip(m.keyframes.id[rows].tolist(), every.map_T_camera, covariance, strict=True):
        m.graph.add_absolute(k, localization(k, pose, spread))


def chain_keyframes(m: MapState) -> None:
    """Connect consecutive keyframes by their motion. The caller must rebuild the graph.

    If the odometry did not measure a motion, the motion comes from the localisation, provided that the errors of the
    localisation last. Without such a motion, a weak factor replaces it. No factor is needed if the later keyframe and some
    earlier keyframe are localised, because the absolute poses relate them.
    """
    k, order = m.keyframes, m.time_order()
    every = m.keyframe_arrays(order)
    by_localization = localized_motions(every, m.settings, m.localization.planar)
    if every.odom_T_base is None and by_localization is None:
        return
    ids, localized, measured = k.id[order].tolist(), k.localized[order], every.measured
    tied = measured | ~localized[1:] | ~np.logical_or.accumulate(localized)[:-1]
    tied &= every.odom_T_base is not None
    lasts = ~measured & localized[1:] & localized[:-1] & (by_localization is not None)
    chained = [m.graph.before(after) == before for before, after in pairwise(ids)]
    wrong = [i for i in range(1, len(ids)) if not (measured[i - 1] or lasts[i - 1]) or not chained[i - 1]]
    for i in wrong:
        m.graph.drop_motion(ids[i])
    if by_localization is not None:
        for i in [i for i in wrong if lasts[i - 1]]:
            motion, spread = by_localization.motion[i - 1], by_localization.covariance[i - 1]
            m.graph.add_motion(ids[i - 1], ids[i], motion, spread)
    to_tie = [i for i in wrong if tied[i - 1] and not lasts[i - 1]]
    if not to_tie:
        return
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
