"""The promotion of tracks to landmarks, and the removal of surplus tracks."""

from collections import defaultdict
from collections.abc import Sequence
from itertools import count

import numpy as np

from objslam.association.observations import Observations
from objslam.association.single_object_fit import PointFit, fit_point
from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.graph.isam2 import IncrementalGraph
from objslam.live.mapper.landmark_update import measure_sizes, observed
from objslam.live.mapper.state import MapState
from objslam.live.mapper.tracks import Track

AGREE = 0.7  # The share of a track's rays that must be inliers. A larger share makes landmarks later, and fewer false ones.
SLACK = 0.02  # The assumed error (m) between camera poses of one track. With a larger error, more rays are inliers.
_AGREE_BY_LABEL = 0.5  # Like `AGREE`, for tracks grouped by label alone. A larger share makes landmarks later.
_AGAIN = 1.2  # The growth of a track's rays or spread before it is tried again. A smaller factor costs time.
_EARLY = 0.4  # If the position is certain, this share of joint.min_parallax_deg is enough. A larger share delays landmarks.
_SURE = 0.05  # The sigma, as a share of the distance, below which a position is certain. A larger share accepts more errors.
_MOST_TRACKS = 150  # The most tracks. Each track is predicted and matched in every frame, so more tracks take longer.


def promote_tracks(m: MapState, tracks: Sequence[Track]) -> list[Track]:
    """Turn the tracks whose rays are sufficient into landmarks, and return the other tracks.

    The graph adds the landmarks at its next update.
    """
    rest: list[Track] = []
    for track in tracks:
        fit = try_promote(track, m.graph, m.settings, m.rng)
        if fit is None:
            rest.append(track)
            continue
        at = np.searchsorted(m.rays.number, track.numbers())
        add_landmark(m, at, fit, track.sight(m.graph), (track.first, track.last), track.drift)
        m.tracks.remove(track)
    return rest


def add_landmark(m: MapState, at: Ints, fit: PointFit, obs: Observations, seen: tuple[float, float], drift: Floats) -> None:
    """Make a landmark of rays. The graph adds it at its next update.

    at: (n,) the rows of the rays, which must not be in the graph yet. fit: the position of the landmark. obs: the rays in
    the frame map. seen: the stamps (s) of the first and last observation. drift: (6, 6) odometry drift at the last
    observation.
    """
    j = m.next_id.landmark
    m.next_id.landmark += 1
    m.rays.owner[at] = j
    m.rays.used[at] = fit.inlier
    columns = observed(obs.take(fit.inlier), fit.position)
    m.landmarks.add(
        id=[j],
        label=[int(m.rays.label[at[0]])],
        drift=drift[None],
        first=[seen[0]],
        last=[seen[1]],
        expected=[len(at)],
        **{name: np.asarray(one)[None] for name, one in columns.items()},
    )
    measure_sizes(m, np.array([len(m.landmarks) - 1]))
    m.rays.to_centre[at] = m.rays.centre_sigma[at] = 0.0  # The rays may have belonged to a landmark with a body.
    m.graph.add_landmark(j, fit.position)
    m.graph.add_rays(m.bearings(at[fit.inlier]))


def try_promote(track: Track, graph: IncrementalGraph, settings: Settings, rng: np.random.Generator) -> PointFit | None:
    """Return the position of a track's object if `fit_if_observable` finds one. Else the track must first grow (_AGAIN)."""
    live, rays = settings.live, len(track.rays)
    unchanged = rays < _AGAIN * track.tried and track.spread < _AGAIN * track.tried_spread
    if rays < live.min_rays or unchanged:
        return None
    ranged = any(np.isfinite(ray[4]) for ray in track.rays)
    if not ranged and track.spread < _EARLY * np.radians(settings.joint.min_parallax_deg):
        return None
    track.tried, track.tried_spread = rays, track.spread
    share = _AGREE_BY_LABEL if track.by_label else AGREE
    return fit_if_observable(track.sight(graph), live.min_rays, share, settings, rng, early=True)


def fit_if_observable(
    obs: Observations,
    least: int,
    share: float,
    settings: Settings,
    rng: np.random.Generator,
    early: bool = False,
    slack: float = SLACK,
) -> PointFit | None:
    """Return the point where rays meet, or None.

    None has one of three reasons. The number of inliers is below `least`, or their share is below `share`. The position is
    uncertain. The parallax is low and the rays have no ranges. obs: the rays in the frame map. early: whether less parallax
    suffices if the position is certain. slack: m, as in `fit_point`.
    """
    fit = fit_point(obs, rng, slack)
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
    """Remove and count the tracks above the limit.

    The labels with the most tracks lose tracks first. Within a label, tracks with fewer than live.min_rays rays are removed
    first, and then the tracks that were unseen for longest.
    """
    if len(m.tracks) <= _MOST_TRACKS:
        return
    best_first = sorted(m.tracks, key=lambda t: (len(t.rays) >= m.settings.live.min_rays, t.last))[::-1]
    of_label: defaultdict[int, count[int]] = defaultdict(count)
    rank = {track: next(of_label[track.label]) for track in best_first}
    least = set(sorted(best_first, key=rank.__getitem__)[_MOST_TRACKS:])
    m.tracks = [track for track in m.tracks if track not in least]
    m.counters.accept("tracks given up", len(least))
