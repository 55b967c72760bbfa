"""One session of a site: its map, and what its cameras had in view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Self

import numpy as np

from objslam.association.observations import Observations
from objslam.association.visibility import CameraFrames, count_looks
from objslam.core.arrays import Floats, Ints
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.types import Up
from objslam.io.objects_json import read_objects
from objslam.io.rays_parquet import RaysTable
from objslam.io.results.read import load_map, load_rays, load_up, load_views
from objslam.io.views_parquet import Views

_SAME_FRAME = 0.005
"""The longest time (s) between the stamp of a ray and the stamp of its camera frame. A larger value also matches inexact
stamps, but may match the wrong frame of a fast camera."""


@dataclass(frozen=True)
class Session:
    """A map of one drive or of a whole site, in a frame of its own.

    name: the name in messages. objects: the map. views, rays: the camera frames and the rays of the drive. They are None for
    a map without a result folder, because such a map does not say what was in view. visits: a function that returns the
    sessions of a site, in the order of time. If it returns no session, the site cannot say that it missed an object. up: the
    axis of the map that points up.
    """

    name: str
    objects: ObjectMap
    views: Views | None = None
    rays: RaysTable | None = None
    visits: Callable[[], tuple[Visit, ...]] = tuple
    up: Up = "z"

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Load a result folder, a site, or an objects.json. OutputError names what is missing or damaged."""
        at = Path(path)
        if at.is_file():
            return cls(str(path), read_objects(at), up=load_up(at))
        views = load_views(at) if at.is_dir() else None
        return cls(str(path), load_map(at), views, None if views is None else load_rays(at), up=load_up(at))

    @property
    def when(self) -> float:
        """The time (s) of the session. It is the last update of a site, or the last time at which a drive saw an object."""
        lives = [o.life.updated for o in (*self.objects, *self.objects.gone) if o.life is not None]
        seen = lives or [o.last_seen for o in self.objects if np.isfinite(o.last_seen)]
        return max(seen, default=0.0)

    def looks(self, objects: tuple[MapObject, ...], positions: Floats, session_T_map: Floats) -> Ints:
        """Return the number of frames (N,) in which each object should have been detected if it was at its position.
        positions: (N, 3) m.

        session_T_map: (4, 4) takes points from the frame of the objects and positions to the frame of this session. The
        number is 0 for an object without `seen_from`, and for one whose label the session ignored. It is 0 for all objects
        if the session has no views.
        """
        looks = np.zeros(len(objects), dtype=np.int64)
        if self.views is None or self.rays is None:
            return looks
        told = [o.seen_from is not None and o.label not in self.views.ignored for o in objects]
        known = np.array(told, dtype=bool)
        if not known.any():
            return looks
        turn = session_T_map[:3, :3]
        some = [(o, o.seen_from) for o, use in zip(objects, told, strict=True) if use and o.seen_from is not None]
        extent = np.array([(np.nan, np.nan) if o.extent is None else o.extent for o, _ in some])
        seen = [replace(one, sides=one.sides @ turn.T) for _, one in some]
        here = positions[known] @ turn.T + session_T_map[:3, 3]
        views = self.views
        frames = CameraFrames(
            views.stamps, views.cameras, views.camera, views.map_T_camera, views.margin, views.margin_share
        )
        obs, distance = _boxes(self.rays, self.objects, views)
        looks[known] = count_looks(here, extent, seen, frames, obs, distance)
        return looks


@dataclass(frozen=True)
class Visit:
    """A session of a site. session_T_site: (4, 4) takes points from the frame of the site to the frame of the session."""

    session: Session
    session_T_site: Floats


def _boxes(rays: RaysTable, objects: ObjectMap, views: Views) -> tuple[Observations, Floats]:
    """Return the boxes of all frames, in the order of the frames. Also return the distance (R,) in m from the camera to the
    object of each box, NaN if unknown.

    Boxes without a camera frame are left out.
    """
    frame = np.full(len(rays), -1, dtype=np.int64)
    for number, camera in enumerate(views.cameras):
        mine, own = np.flatnonzero(rays.camera == camera.name), np.flatnonzero(views.camera == number)
        if len(own) == 0:
            continue
        after = np.clip(np.searchsorted(views.stamps[own], rays.stamp[mine]), 1, max(len(own) - 1, 1))
        near = np.clip(np.column_stack([after - 1, after]), 0, len(own) - 1)
        off = np.abs(views.stamps[own][near] - rays.stamp[mine, None])
        best = off.argmin(axis=1)
        frame[mine] = np.where(off.min(axis=1) <= _SAME_FRAME, own[near[np.arange(len(mine)), best]], -1)
    kept = np.flatnonzero(frame >= 0)
    kept = kept[np.argsort(frame[kept], kind="stable")]
    order = np.argsort([o.id for o in objects], kind="stable")
    ids = np.array([o.id for o in objects], dtype=np.int64)[order]
    at = np.searchsorted(ids, rays.object[kept])
    there = np.isin(rays.object[kept], ids)
    distance = np.full(len(kept), np.nan)
    places = objects.positions[order]
    distance[there] = np.linalg.norm(places[at[there]] - rays.origin[kept][there], axis=1)
    unknown = np.full(len(kept), np.nan)
    lines = Observations.of_lines(rays.origin[kept], rays.direction[kept], rays.sigma[kept], unknown, unknown)
    return replace(lines, frame=frame[kept], box=rays.box[kept]), distance
