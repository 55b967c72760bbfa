"""Absolute poses for keyframes, when the localisation gets there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from objslam.geometry import inverse, is_planar
from objslam.graph import factors
from objslam.types import Floats

if TYPE_CHECKING:
    from objslam.live.mapper import Mapper


def localize(m: Mapper) -> None:
    """Absolute poses for the keyframes that the localisation covers by now."""
    if not m.localizations or not m.unlocalized:
        return
    left = []
    for k in m.unlocalized:
        row = int(np.searchsorted(m.keyframes.id, k))
        if row == len(m.keyframes) or m.keyframes.id[row] != k:
            continue
        stamp = float(m.keyframes.stamp[row])
        if stamp > m.localization.newest:
            left.append(k)
            continue
        found = m.localization.at(stamp, m.settings.poses.max_gap)
        if found is None:
            continue
        m.flat = m.flat and is_planar(np.stack([np.eye(4), m.localization.from_start(found[0])]))
        first = not m.keyframes.localized.any() and not m.localized_only
        if first:
            _move_onto(m, row, found[0])
        m.keyframes.map_T_base[row] = found[0]
        m.keyframes.localized[row] = True
        one = m.keyframe_arrays(np.array([row]))
        m.graph.add_absolute(k, factors.localizations(one, m.settings, k, m.flat)[0])
        if first:
            m.graph.rebuild()
    m.unlocalized = left


def _move_onto(m: Mapper, row: int, map_T_base: Floats) -> None:
    """The first localisation says where the map is: so far it lay where the odometry began."""
    m.graph.update()
    there = map_T_base @ m.keyframes.base_T_camera[row] @ inverse(m.graph.pose(int(m.keyframes.id[row])))
    m.graph.drop_absolute()
    m.graph.move(there)
    m.known.position[:] = m.known.position @ there[:3, :3].T + there[:3, 3]
    spun = there[:3, :3]
    m.known.information[:] = spun @ m.known.information @ spun.T
    m.move_candidates(there, -np.inf)
