"""Rays as lines in the map, in an order of their own: what association works on."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from objslam.types import Bools, Camera, Floats, Ints, Keyframes, Rays

MIN_DEPTH = 0.05
"""m; nothing closer to a camera is an object."""


@dataclass(frozen=True)
class Sightings:
    """One box each, as a line in the map; sorted by frame, then by what the box is, never by the order it came in.

    frame: (R,) number in the order of time. label: (R,). origin: (R, 3) m, direction: (R, 3) unit, in map. sigma: (R,) rad
    along each of two axes across. place: m, the noise of the origins. range: (R,) m, NaN where unknown; range_sigma: (R,).
    size: (R, 2) width and height of what the box holds for each metre of its distance. box: (R, 4) px. track: (R,) -1 where
    unknown. score: (R,).
    """

    frame: Ints
    label: Ints
    origin: Floats
    direction: Floats
    sigma: Floats
    place: float
    range: Floats
    range_sigma: Floats
    size: Floats
    box: Floats
    track: Ints
    score: Floats

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, rays: Bools | Ints) -> Self:
        """A selection (mask or increasing indices)."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        selected: dict[str, Any] = {k: v[rays] if isinstance(v, np.ndarray) else v for k, v in values.items()}
        return type(self)(**selected)


def sight(
    rays: Rays,
    keyframes: Keyframes,
    cameras: tuple[Camera, ...],
    map_T_camera: Floats,
    sigma: Floats,
    position_sigma: float,
) -> tuple[Sightings, Ints, Ints]:
    """The rays as sightings, which ray (R,) each one is, and which keyframe (K,) each frame is.

    Frames follow in the order of time and camera, the boxes of a frame by label and box, so that nothing depends on the
    order in which they were given.
    """
    keyframe = np.lexsort((keyframes.frame, keyframes.camera, keyframes.stamps))
    number = np.empty(len(keyframe), dtype=np.int64)
    number[keyframe] = np.arange(len(keyframe))
    frame = number[rays.keyframe]
    content = (*rays.direction.T, rays.range, rays.score, *rays.box.T[::-1], rays.label, frame)
    ray = np.lexsort(content)
    rays, frame = rays.take(ray), frame[ray]
    origin, direction = rays.in_map(map_T_camera)
    known = np.isfinite(rays.range) & (rays.range > 0) & np.isfinite(rays.range_sigma) & (rays.range_sigma > 0)
    sightings = Sightings(
        frame=frame,
        label=rays.label,
        origin=origin,
        direction=direction,
        sigma=sigma[ray],
        place=position_sigma,
        range=np.where(known, rays.range, np.nan),
        range_sigma=np.where(known, rays.range_sigma, np.nan),
        size=size_per_metre(rays, keyframes, cameras),
        box=rays.box,
        track=rays.track_id,
        score=rays.score,
    )
    return sightings, ray, keyframe


def size_per_metre(rays: Rays, keyframes: Keyframes, cameras: tuple[Camera, ...]) -> Floats:
    """Width and height (R, 2) of what each box holds, in metres for each metre of its distance."""
    of = keyframes.camera[rays.keyframe]
    focal = np.array([[c.matrix[0, 0], c.matrix[1, 1]] for c in cameras])[of]
    pinhole = np.array([c.distortion_model != "equidistant" for c in cameras])[of]
    depth = np.where(pinhole, rays.direction[:, 2], 1.0)  # a pinhole's image grows with z, not with the distance
    return np.asarray((rays.box[:, 2:] - rays.box[:, :2]) / focal * depth[:, None])
