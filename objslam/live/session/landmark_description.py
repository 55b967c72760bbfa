"""Describe a landmark or a track of a session as an object of a map, from its rays."""

import numpy as np

from objslam.association.observations import MIN_DEPTH, Observations, extents
from objslam.association.refinement import normalised_residuals
from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import widest_angle
from objslam.core.object_map import MapObject
from objslam.core.status import reach, status_of
from objslam.core.types import Association
from objslam.graph.posterior.marginals import largest_sigma
from objslam.live.calibration.collected import offline_rays
from objslam.live.mapper.state import MapState
from objslam.live.mapper.tracks import Track
from objslam.mapping.box_offsets import SizedRays, expected_variances, offset_covariance, sides_of

_MOST = 200  # The most rays that describe an object. They are spread evenly over all its rays. A larger number takes longer.
_FEW = 60  # The most rays whose pairs are compared for an object's parallax. More rays take longer.


def describe_landmark(
    m: MapState, row: int, position: Floats, covariance: Floats, *, from_graph: bool = False, sure: bool = True
) -> MapObject:
    """Describe the landmark in a row of `m.landmarks`, at a position (3,) m with a covariance (3, 3) m^2.

    If the mean square of the landmark's normalised residuals is above 1, the covariance is multiplied by this mean square.
    The covariance of box offsets is added. from_graph: whether the covariance includes the drift of the map. Such a
    covariance may be too large. Then the landmark is still resolved if its covariance relative to the last keyframe that saw
    it is small. sure: False if its name is `contradicted`. Then the landmark is not resolved.
    """
    landmarks, rays, j = m.landmarks, m.rays, int(m.landmarks.id[row])
    mine = np.flatnonzero((rays.owner == j) & rays.used)
    count = len(mine)
    some = _spread(mine, _MOST)
    wider = max(1.0, float(landmarks.squared[row]) / (2 * max(int(landmarks.seen[row]), 1)))
    covariance = wider * covariance
    obs = m.sight(some)
    parallax = widest_angle(m.sight(_spread(mine, _FEW)).direction)
    limits, away = m.settings.triangulation, reach(position, obs.origin)
    sigma = float(largest_sigma(covariance[None])[0])
    if from_graph and sigma > limits.max_rel_sigma * away:  # This sigma may include the drift of the map.
        seen = m.graph.seen_covariance(j, int(rays.keyframe[mine].max()))
        sigma = float(largest_sigma(wider * seen[None])[0])
    status = status_of(sigma, away, count, parallax, bool(np.isfinite(obs.range).any()), limits)
    status = status if sure or status != "ok" else "unresolved"
    fixed, extent = status == "ok", _extent(m, some, position) if count else None
    if fixed and count:
        size = np.array(extent) if extent else np.full(2, m.settings.rays.unknown_size)
        covariance = covariance + _offsets(m, some, obs, position, size)
    return MapObject(
        id=j,
        label=m.labels[int(landmarks.label[row])],
        position=position,
        covariance=covariance if fixed else None,
        status=status,
        rays=count,
        frames=len(np.unique(rays.keyframe[mine])),
        parallax_deg=round(float(np.degrees(parallax)), 3),
        rms_deg=_rms_deg(obs, position) if count else 0.0,
        first_seen=float(landmarks.first[row]),
        last_seen=float(landmarks.last[row]),
        extent=extent,
        ray=None if fixed or not count else (obs.origin[-1], obs.direction[-1]),
    )


def describe_track(m: MapState, track: Track) -> MapObject:
    """Describe a track as an unresolved object. Its id is -1."""
    obs = track.sight(m.graph)
    position = track.position if not track.by_label else obs.origin[-1] + 1.0 * obs.direction[-1]
    return MapObject(
        id=-1,
        label=m.labels[track.label],
        position=position,
        covariance=None,
        status="unresolved",
        rays=len(obs),
        frames=len(obs),
        parallax_deg=round(float(np.degrees(widest_angle(obs.direction))), 3),
        rms_deg=_rms_deg(obs, position),
        first_seen=track.first,
        last_seen=track.last,
        ray=(obs.origin[-1], obs.direction[-1]),
    )


def _spread(rows: Ints, most: int) -> Ints:
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(np.int64)]


def _rms_deg(obs: Observations, position: Floats) -> float:
    off = np.minimum(normalised_residuals(obs, position) * obs.sigma, np.pi)
    return round(float(np.degrees(np.sqrt(np.mean(off**2)))), 4)


def _offsets(m: MapState, at: Ints, obs: Observations, position: Floats, extent: Floats) -> Floats:
    """Return the covariance (3, 3), m^2, that box offsets (rays.box_sigma) add to the position (3,), m, of an object.

    at: the rows of the object's rays. obs: these rays in the frame map. extent: (2,) m, the width and height of the object.
    """
    share = m.settings.rays.box_sigma
    if share == 0:
        return np.zeros((3, 3))
    distance = np.maximum(np.linalg.norm(position - obs.origin, axis=1), MIN_DEPTH)
    size = np.full(len(at), np.sqrt(extent.prod())) / distance
    along = np.where(np.isfinite(obs.range), 1 / obs.range_sigma, 0.0)
    one = np.zeros(len(at), dtype=np.int64)
    rays = SizedRays(one, obs.origin, obs.direction, distance, obs.sigma, size, along)
    return offset_covariance(sides_of(rays, position[None])[0], extent, expected_variances(share))


def _extent(m: MapState, at: Ints, position: Floats) -> tuple[float, float] | None:
    """Return the width and height, m, of an object at a position (3,), m, or None if unknown. at: the rows of the object's
    rays."""
    row = np.searchsorted(m.keyframes.id, m.rays.keyframe[at])
    frames, index = np.unique(row, return_inverse=True)
    poses = m.graph.poses(m.keyframes.id[frames])
    one = Association(np.zeros(len(at), dtype=np.int64), np.zeros(1, dtype=np.int64))
    rays = offline_rays(m, at, index)
    width, height = extents(rays, one, position[None], poses, m.keyframe_arrays(frames), tuple(m.cameras))[0].tolist()
    return (width, height) if np.isfinite([width, height]).all() else None
