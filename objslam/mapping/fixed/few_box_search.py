"""Find the objects of a log that sees each thing from few places, under an assumed noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.types import CameraLog, Log
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.up import upright
from objslam.mapping.checks.agreement import take_frames

if TYPE_CHECKING:
    from objslam.association.few_rays.additional_objects import FewRayEvidence

_MOST_BOXES = 600
"""The most boxes that are searched, from frames that follow each other. With a larger number, the noise is more exact, and
the search takes longer."""
_EXPLAINED = 0.5
"""The least share of the boxes that the found objects must explain. With a smaller share, stray boxes are taken for
objects."""


@dataclass(frozen=True)
class SparseNoise:
    """Three factors on the noise in the settings. place: on `localization.xy`. ranges: on `depth.sigma` and
    `depth.sigma_per_m`. rays: on `rays.pixel_sigma` and `rays.box_sigma`."""

    place: float = 1.0
    ranges: float = 1.0
    rays: float = 1.0

    def settings(self, nominal: Settings) -> Settings:
        """Return settings with this noise. nominal: the settings to which the factors apply."""
        where, depth, rays = nominal.localization, nominal.depth, nominal.rays
        update = {
            "localization": where.model_copy(update={"xy": where.xy * self.place}),
            "depth": depth.model_copy(
                update={"sigma": depth.sigma * self.ranges, "sigma_per_m": depth.sigma_per_m * self.ranges}
            ),
            "rays": rays.model_copy(
                update={"pixel_sigma": rays.pixel_sigma * self.rays, "box_sigma": rays.box_sigma * self.rays}
            ),
        }
        return nominal.model_copy(update=update)

    def in_words(self, nominal: Settings) -> str:
        """Return the noise in words, for people."""
        of = self.settings(nominal)
        told = [f"places that err by about {of.localization.xy:.2g} m"] if self.place > 1 else []
        told += [f"depths that err by about {100 * of.depth.sigma_per_m:.2g} %"] if self.ranges > 1 else []
        told += [f"box centres that err by about {of.rays.pixel_sigma:.2g} px"] if self.rays > 1 else []
        return " and ".join(told)


@dataclass(frozen=True)
class Searched:
    """The objects that a search finds under an assumed noise.

    The arrays describe the P rays that have an object, in a frame with z up. direction: (P, 3) the unit vector of each ray.
    shift: (P, 3) m, from the given to the corrected origin of the ray. apart: (P, 3) m, from the corrected origin to the
    object. range: (P,) m, NaN if unknown. The last three are the noise in the settings. sigma: (P,) rad, of the directions.
    range_sigma: (P,) m, of the ranges. place: m, of the places.
    """

    noise: SparseNoise
    found: FewRayEvidence
    direction: Floats
    apart: Floats
    shift: Floats
    sigma: Floats
    range: Floats
    range_sigma: Floats
    place: float

    @property
    def value(self) -> float:
        """The log evidence for the noise. It is minus infinity if the objects explain too few boxes."""
        return self.found.chance + self.found.detections if self.found.explained >= _EXPLAINED else -np.inf

    @property
    def views(self) -> float:
        """The mean number of boxes of an object."""
        return len(self.found.ray) / max(len(self.found.positions), 1)


def search_objects(log: Log, settings: Settings, noise: SparseNoise, *, correct_places: bool = False) -> Searched:
    """Find the objects of a log under an assumed noise. correct_places: as in `few_ray_evidence`."""
    from objslam.association.few_rays.additional_objects import few_ray_evidence
    from objslam.association.observations import PosedRays
    from objslam.graph.fixed_pose_triangulation import pose_noise

    noisier = noise.settings(settings)
    frames = build_keyframes(log, noisier, Ledger())
    rays = build_rays(log, frames, noisier, Ledger())
    sigma, place = pose_noise(rays, frames, noisier)
    cameras = tuple(one.camera for one in log.cameras)
    posed = PosedRays(rays, frames, cameras, frames.map_T_camera, sigma, place)
    found = few_ray_evidence(posed, noisier, seed=settings.seed, correct_places=correct_places)
    of = rays.take(found.ray)
    origin, direction = of.in_map(frames.map_T_camera)
    up = upright(frames)
    return Searched(
        noise,
        found,
        direction @ up.T,
        (found.positions[found.owner] - origin - found.shift) @ up.T,
        found.shift @ up.T,
        of.sigma / noise.rays,
        of.range,
        of.range_sigma / noise.ranges,
        place / noise.place,
    )


def middle(log: Log) -> Log:
    """Return the log with only the frames in its middle, which have about `_MOST_BOXES` boxes at most."""
    found = [one.detections for one in log.cameras if one.detections is not None]
    stamps = np.sort(np.concatenate([one.frame_stamps[one.frame] for one in found]))
    if len(stamps) <= _MOST_BOXES:
        return log
    first = (len(stamps) - _MOST_BOXES) // 2
    low, high = stamps[first], stamps[first + _MOST_BOXES - 1]

    def taken(one: CameraLog) -> CameraLog:
        if one.detections is None:
            return one
        within = (one.detections.frame_stamps >= low) & (one.detections.frame_stamps <= high)
        return CameraLog(one.camera, take_frames(one, within))

    return Log(
        name=log.name, cameras=tuple(taken(one) for one in log.cameras), odometry=log.odometry, localization=log.localization
    )
