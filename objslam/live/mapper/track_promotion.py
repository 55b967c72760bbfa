"""From tracks to landmarks, once their rays carry a place; and which tracks are given up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from objslam.association.observations import Observations
from objslam.association.refinement import information, normalised_residuals
from objslam.association.single_object_fit import PointFit, fit_point
from objslam.config import Settings
from objslam.core.statistics import CLIPPED_RAY
from objslam.graph.isam2 import IncrementalGraph
from objslam.live.mapper.state import MapState
from objslam.live.mapper.tracks import Track

AGREE = 0.7
"""The share of the rays of one thing that must agree on its place; larger makes objects later, and fewer false ones."""
SLACK = 0.02
"""m; the poses of one stretch fit each other that well, and larger lets rays meet less closely."""
_AGREE_BY_LABEL = 0.5
"""The same share where rays merely share a label, and some may be of another object; larger makes those objects later."""
_AGAIN = 1.2
"""Times as many rays, or as wide a spread, as when a track was last tried, before it is tried again; smaller takes time."""
_EARLY = 0.4
"""Share of joint.min_parallax_deg that is enough where the place is very sure; larger makes objects later."""
_SURE = 0.05
"""Standard deviation of such a place as a share of its distance; larger makes objects sooner, and more of them false."""
_MOST_TRACKS = 150
"""Tracks at the most; each is predicted, and matched with every frame, so more take longer."""


def promote_tracks(m: MapState, tracks: Sequence[Track]) -> list[Track]:
    """Of tracks that have a ray more, those whose rays carry it become landmarks; the others are returned.

    To be called once the frame that brought the rays is worked in: whether rays meet takes as long to find out. The graph
    works the landmarks in when it is next asked to.
    """
    rest: list[Track] = []
    for track in tracks:
        fit = try_promote(track, m.graph, m.settings, m.rng)
        if fit is None:
            rest.append(track)
            continue
        j = m.next_id.landmark
        m.next_id.landmark += 1
        at = np.searchsorted(m.rays.number, track.numbers())
        m.rays.owner[at] = j
        m.rays.used[at] = fit.inlier
        inner = track.sight(m.graph).take(fit.inlier)
        m.landmarks.add(
            id=[j],
            position=fit.position[None],
            information=information(inner, fit.position).sum(axis=0)[None],
            label=[track.label],
            drift=track.drift[None],
            first=[track.first],
            last=[track.last],
            seen=[int(fit.inlier.sum())],
            expected=[len(track.rays)],
            far=[float(np.linalg.norm(fit.position - inner.origin, axis=1).max())],
            squared=[float((normalised_residuals(inner, fit.position) ** 2).clip(max=CLIPPED_RAY**2).sum())],
            rejected=[0],
        )
        m.graph.add_landmark(j, fit.position)
        m.graph.add_rays(m.bearings(at[fit.inlier]))
        m.tracks.remove(track)
    return rest


def try_promote(track: Track, graph: IncrementalGraph, settings: Settings, rng: np.random.Generator) -> PointFit | None:
    """Where a track's object is once its rays carry that: enough of them, enough parallax or ranges, few against it."""
    live, count = settings.live, len(track.rays)
    if count < live.min_rays:
        return None
    if count < _AGAIN * track.tried and track.spread < _AGAIN * track.tried_spread:
        return None
    ranged = any(np.isfinite(ray[4]) for ray in track.rays)
    if not ranged and track.spread < _EARLY * np.radians(settings.joint.min_parallax_deg):
        return None
    track.tried, track.tried_spread = count, track.spread
    share = _AGREE_BY_LABEL if track.by_label else AGREE
    return fit_if_observable(track.sight(graph), live.min_rays, share, settings, rng, early=True)


def fit_if_observable(
    obs: Observations, least: int, share: float, settings: Settings, rng: np.random.Generator, early: bool = False
) -> PointFit | None:
    """Where rays meet, if they make an object of it.

    Args:
        obs: rays in map.
        least: rays that must agree.
        share: share of the rays that must agree.
        early: less parallax is enough for a place that is very sure.

    Returns:
        None with fewer rays that agree, too little parallax and no ranges, or a place that is too uncertain.
    """
    fit = fit_point(obs, rng, SLACK)
    if fit is None or fit.inlier.sum() < least or fit.inlier.mean() < share:
        return None
    full = np.radians(settings.joint.min_parallax_deg)
    away = float(np.median(np.linalg.norm(fit.position - obs.origin[fit.inlier], axis=1)))
    sigma = np.sqrt(np.linalg.eigvalsh(fit.covariance)[-1])
    if early and fit.parallax >= _EARLY * full and sigma <= _SURE * away:
        return fit
    wide = fit.parallax >= full or bool(np.isfinite(obs.range).any())
    return fit if wide and sigma <= settings.triangulation.max_rel_sigma * away else None


def prune_tracks(m: MapState) -> None:
    """Give up tracks where there are too many: the short ones of the labels that have most, unseen for longest first.

    So a crowd of one label leaves room for the others. What is given up is counted.
    """
    if len(m.tracks) <= _MOST_TRACKS:
        return
    best_first = sorted(m.tracks, key=lambda t: (len(t.rays) >= m.settings.live.min_rays, t.last))[::-1]
    of_label: Counter[int] = Counter()
    rank: dict[Track, int] = {}
    for track in best_first:
        rank[track] = of_label[track.label]
        of_label[track.label] += 1
    least = set(sorted(best_first, key=lambda track: rank[track])[_MOST_TRACKS:])
    m.tracks = [track for track in m.tracks if track not in least]
    m.counters.accept("tracks given up", len(least))
