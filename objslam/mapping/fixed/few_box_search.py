"""Search the objects of a log that sees each thing from few places, with a given noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.association.observations import MIN_DEPTH
from objslam.association.refinement import grouped_sums
from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.noise import MOST_POSE_NOISE
from objslam.core.types import CameraLog, Log
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.up import upright
from objslam.mapping.checks.agreement import take_frames
from objslam.mapping.fixed.pose_noise import least_cost

if TYPE_CHECKING:
    from objslam.association.few_rays.additional_objects import FewRayEvidence

_MOST_BOXES = 600
"""The most boxes that are searched, from frames that follow each other. More boxes are more exact and take longer."""
_EXPLAINED = 0.5
"""The least share of the boxes that the objects must explain. With a smaller share, noise is taken for objects."""
_FAR = 10.0
"""The prior standard deviation of an object's place, as a multiple of the largest distance of a ray. So the place of an
object with one ray has a variance. The number hardly matters if it is large."""


@dataclass(frozen=True)
class SparseNoise:
    """Factors on the noise in the settings: of `localization.xy`, of `depth.sigma` and `depth.sigma_per_m`, and of
    `rays.pixel_sigma` and `rays.box_sigma`."""

    place: float = 1.0
    ranges: float = 1.0
    rays: float = 1.0

    def settings(self, nominal: Settings) -> Settings:
        """Return the settings with this noise."""
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
    """The objects that a search finds with a noise.

    For the P rays with an object, direction: (P, 3) of the ray, and apart: (P, 3) m, from the ray's origin to the object, in
    a frame whose z is up. sigma: (P,) rad, range_sigma: (P,) m, place: m, the noise in the settings. range: (P,) m, NaN if
    unknown.
    """

    noise: SparseNoise
    found: FewRayEvidence
    direction: Floats
    apart: Floats
    sigma: Floats
    range: Floats
    range_sigma: Floats
    place: float

    @property
    def value(self) -> float:
        """The evidence of the noise. It is minus infinity if the noise explains too few boxes."""
        return self.found.chance + self.found.detections if self.found.explained >= _EXPLAINED else -np.inf

    @property
    def views(self) -> float:
        """The mean number of boxes of an object."""
        return len(self.found.ray) / max(len(self.found.positions), 1)

    def with_place_of_residuals(self, prior: float) -> SparseNoise:
        """Return the noise with the noise of places that agrees best with the misses of the rays, by restricted likelihood
        (Patterson and Thompson 1971).

        Seen from above, a ray misses its object across by the noise of the ray and of the place, and along by the noise of
        the depth and of the place. prior: the weight of the noise in the settings, as a number of residuals.
        """
        level = np.maximum(np.hypot(*self.apart[:, :2].T), MIN_DEPTH)
        flat = np.maximum(np.hypot(*self.direction[:, :2].T), 1e-6)
        ahead = self.apart[:, :2] / level[:, None]
        left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
        across = level * (self.direction[:, :2] * left).sum(axis=1) / flat
        along = self.range * flat - level
        known = np.isfinite(along)
        owner = np.concatenate([self.found.owner, self.found.owner[known]])
        miss = np.concatenate([across, along[known]])
        axis = np.concatenate([left, ahead[known]])
        own = np.concatenate([self.sigma * level * self.noise.rays, self.range_sigma[known] * self.noise.ranges])
        unknown = np.eye(2) / (_FAR * level.max(initial=1.0)) ** 2

        def cost(logarithm: Floats) -> float:
            """Return -2 ln of the restricted posterior density of the logarithm (1,) of the factor on the places."""
            factor = float(np.exp(logarithm[0]))
            variance = own**2 + (self.place * factor) ** 2
            weighted = axis / variance[:, None]
            count = len(self.found.positions)
            information = grouped_sums((weighted[:, :, None] * axis[:, None]).reshape(-1, 4), owner, count).reshape(-1, 2, 2)
            information += unknown
            pulled = grouped_sums(weighted * miss[:, None], owner, count)
            explained = (pulled * np.linalg.solve(information, pulled[:, :, None])[:, :, 0]).sum()
            likelihood = (np.log(variance) + miss**2 / variance).sum() - explained
            likelihood += np.log(np.linalg.det(information)).sum()
            return float(likelihood + prior * (2 * np.log(factor) + factor**-2.0))

        bounds = np.log([[1.0], [MOST_POSE_NOISE]])
        found, _ = least_cost(cost, np.ones(1, dtype=bool), np.log([self.noise.place]), bounds)
        return replace(self.noise, place=float(np.exp(found[0])))


def search_objects(log: Log, settings: Settings, noise: SparseNoise) -> Searched:
    """Search the objects of a log with a noise."""
    from objslam.association.few_rays.additional_objects import few_ray_evidence
    from objslam.graph.fixed_pose_triangulation import pose_noise

    noisier = noise.settings(settings)
    frames = build_keyframes(log, noisier, Ledger())
    rays = build_rays(log, frames, noisier, Ledger())
    sigma, place = pose_noise(rays, frames, noisier)
    cameras = tuple(one.camera for one in log.cameras)
    found = few_ray_evidence(
        rays,
        frames,
        cameras,
        noisier,
        map_T_camera=frames.map_T_camera,
        sigma=sigma,
        position_sigma=place,
        seed=settings.seed,
    )
    of = rays.take(found.ray)
    origin, direction = of.in_map(frames.map_T_camera)
    up = upright(frames)
    return Searched(
        noise,
        found,
        direction @ up.T,
        (found.positions[found.owner] - origin) @ up.T,
        of.sigma / noise.rays,
        of.range,
        of.range_sigma / noise.ranges,
        place / noise.place,
    )


def middle(log: Log) -> Log:
    """Return the log with the frames of its middle only, of at most `_MOST_BOXES` boxes."""
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
