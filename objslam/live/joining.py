"""Landmarks that turn out to be one, and landmarks that go."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from objslam.types import Ints

if TYPE_CHECKING:
    from objslam.live.mapper import Mapper


def join(m: Mapper, keep: int, drop: int) -> None:
    known, rays = m.known, m.rays
    mine = np.flatnonzero(rays.owner == known.id[drop])
    m.graph.drop_rays(rays.number[mine])
    rays.owner[mine] = known.id[keep]
    known.information[keep] += known.information[drop]
    for name in ("squared", "seen", "expected", "rejected"):
        getattr(known, name)[keep] += getattr(known, name)[drop]
    known.first[keep] = min(known.first[keep], known.first[drop])
    if known.last[drop] > known.last[keep]:
        known.last[keep], known.drift[keep] = known.last[drop], known.drift[drop]
    known.far[keep] = max(known.far[keep], known.far[drop])
    m.graph.add_rays(m.bearings(mine[rays.used[mine]]))


def without(m: Mapper, rows: Ints, rebuild: bool = True) -> None:
    """Landmarks whose rays have gone elsewhere, away; without `rebuild` the graph still waits for it."""
    ids = set(m.known.id[rows].tolist())
    m.graph.drop_landmarks(m.known.id[rows])
    kept = np.ones(len(m.known), dtype=bool)
    kept[rows] = False
    m.known.keep(kept)
    m.together = {pair: n for pair, n in m.together.items() if not ids & set(pair)}
    m.apart = {pair: n for pair, n in m.apart.items() if not ids & set(pair)}
    if not rebuild:
        return
    m.graph.rebuild_in_turns(m.in_order())
    m.known.position[:] = m.graph.points(m.known.id)
