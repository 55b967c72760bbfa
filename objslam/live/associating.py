"""A frame that became a keyframe: its rays to landmarks and candidates, and those into the graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from objslam.live.births import extend, new_candidate
from objslam.live.expected import expect
from objslam.live.learning import Lesson
from objslam.live.matching import Doubt, FrameRays, best_of_label, match, match_by_label
from objslam.types import Floats

if TYPE_CHECKING:
    from objslam.live.mapper import Mapper

_NOVEL = 0.02  # weight of a frame in the share of boxes that show nothing known


def associate(m: Mapper, rays: FrameRays, k: int, camera: int, guess: Floats, doubt: Doubt, stamp: float) -> None:
    """Give every ray of keyframe k its landmark or candidate, and the graph what it can use of them.

    guess: (4, 4) where its camera is taken to be, in map; doubt: how little that is known.
    """
    known, count, of = m.known, len(rays), m.settings.association
    owner, used = np.full(count, -1, dtype=np.int64), np.zeros(count, dtype=bool)
    if m.by_label and of.method == "auto" and len(set(rays.label.tolist())) < count:
        m.by_label = False  # two boxes of one label: labels do not tell objects apart
        m.candidates = [c for c in m.candidates if not c.by_label]
    numbers = m.next_ray + np.arange(count)
    m.next_ray += count
    mine = best_of_label(rays) if m.by_label else np.arange(count)
    m.grown = []
    if m.by_label:
        hit, missed = match_by_label(rays.take(mine), guess, known, doubt, of.gate)
        lost = missed >= 0
        known.rejected[missed[lost]] += 1
        owner[mine[lost]] = known.id[missed[lost]]
        free = mine[(hit < 0) & ~lost]
    else:
        gate, number = of.gate, len(m.labels)
        expected = expect(known, m.candidates) if m.expected is None else m.expected
        hit = match(rays, guess, expected, doubt, number, gate, m.tracks, m.novelty)
        m.expected = None  # what follows changes it
        waits = hit >= len(known)
        m.novelty += _NOVEL * (float((waits | (hit < 0)).mean()) - m.novelty)
        for i in np.flatnonzero(waits).tolist():
            m.grown.append(m.candidates[hit[i] - len(known)])
            extend(m, m.grown[-1], rays, i, numbers[i], k, stamp, doubt)
        free = mine[hit < 0]
        hit[waits] = -1
    matched = mine[hit >= 0]
    rows = hit[hit >= 0]
    owner[matched], used[matched] = known.id[rows], True
    m.rays.add(
        number=numbers,
        keyframe=np.full(count, k),
        direction=rays.direction,
        sigma=rays.sigma,
        range=rays.range,
        range_sigma=rays.range_sigma,
        label=rays.label,
        score=rays.score,
        box=rays.box,
        track=rays.track,
        owner=owner,
        used=used,
    )
    m.grown += [new_candidate(m, rays, i, numbers[i], k, stamp, doubt) for i in free.tolist()]
    if len(matched):
        m.graph.add_rays(m.bearings(len(m.rays) - count + matched))
    m.graph.update()
    m.lesson = Lesson(rays, matched, rows, camera, doubt.drift, stamp, k)
