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
    size: (R, 2) width and height of the box over the focal length. track: (R,) -1 where unknown.
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
    track: Ints

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, rays: Bools | Ints) -> Self:
        """A selection (mask or increasing indices)."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        return type(self)(**{k: v[rays] if isinstance(v, np.ndarray) else v for k, v in values.items()})


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
    focal = np.array([[c.matrix[0, 0], c.matrix[1, 1]] for c in cameras])[keyframes.camera[rays.keyframe]]
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
        size=(rays.box[:, 2:] - rays.box[:, :2]) / focal,
        track=rays.track_id,
    )
    return sightings, ray, keyframe
