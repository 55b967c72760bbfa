"""From boxes that are nobody's to candidates, and from candidates to landmarks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from objslam.live.candidates import Candidate, ripe
from objslam.live.matching import Doubt, FrameRays
from objslam.live.meeting import information, misses

if TYPE_CHECKING:
    from objslam.live.mapper import Mapper

_CANDIDATES = 150  # at the most


def give_birth(m: Mapper, grown: list[Candidate]) -> list[Candidate]:
    """Of the candidates that have a ray more, those become landmarks whose rays carry it; the others are left.

    After the frame that brought the ray: whether rays meet takes as long to find out as working in a whole frame. The
    graph works them in when it is next asked to.
    """
    born: list[Candidate] = []
    for candidate in grown:
        met = ripe(candidate, m.graph, m.settings, m.rng)
        if met is None:
            continue
        born.append(candidate)
        j = m.next_object
        m.next_object += 1
        numbers = candidate.numbers()
        at = np.searchsorted(m.rays.number, numbers)
        m.rays.owner[at] = j
        m.rays.used[at] = met.agree
        s = candidate.sight(m.graph)
        inner = s.take(met.agree)
        m.known.add(
            id=[j],
            position=met.position[None],
            information=information(inner, met.position).sum(axis=0)[None],
            label=[candidate.label],
            drift=candidate.drift[None],
            first=[candidate.first],
            last=[candidate.last],
            seen=[int(met.agree.sum())],
            expected=[len(candidate)],
            far=[float(np.linalg.norm(met.position - inner.origin, axis=1).max())],
            squared=[float((misses(inner, met.position) ** 2).clip(max=36.0).sum())],
            rejected=[0],
        )
        m.graph.add_landmark(j, met.position)
        m.graph.add_rays(m.bearings(at[met.agree]))
    for candidate in born:
        m.candidates.remove(candidate)
    return [candidate for candidate in grown if candidate not in born]


def new_candidate(m: Mapper, rays: FrameRays, i: int, number: int, k: int, stamp: float, doubt: Doubt) -> Candidate:
    """A ray that nobody has becomes a candidate, or part of that of its label."""
    label = int(rays.label[i])
    if m.by_label:
        for candidate in m.candidates:
            if candidate.label == label:
                extend(m, candidate, rays, i, number, k, stamp, doubt)
                return candidate
    candidate = Candidate(m.next_candidate, label, m.by_label, stamp, stamp, doubt.drift)
    m.next_candidate += 1
    m.candidates.append(candidate)
    extend(m, candidate, rays, i, number, k, stamp, doubt)
    return candidate


def leave_out_the_least(m: Mapper) -> None:
    """Of very many candidates the short ones are given up, those first that were not seen for longest."""
    if len(m.candidates) > _CANDIDATES:
        worth = sorted(m.candidates, key=lambda c: (len(c) >= m.settings.live.min_rays, c.last))
        least = set(worth[: len(m.candidates) - _CANDIDATES])
        m.candidates = [c for c in m.candidates if c not in least]


def extend(
    m: Mapper, candidate: Candidate, rays: FrameRays, i: int, number: int, k: int, stamp: float, doubt: Doubt
) -> None:
    """Ray i of a frame, with the number it has among all, for a candidate."""
    seen = (rays.direction[i], float(rays.sigma[i]), float(rays.range[i]), float(rays.range_sigma[i]))
    candidate.extend((int(number), k, *seen), m.graph.pose(k))
    candidate.last, candidate.drift = max(candidate.last, stamp), doubt.drift
