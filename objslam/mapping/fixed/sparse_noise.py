"""Estimate the noise of a log that sees each thing from few places, such as a street past which a car with GPS drives.

With the usual noise, the rays of such a log do not meet, and nothing is found whose residuals could show the noise. So the
objects are searched with many noises. The noise with the most evidence counts: the odds of the objects over stray boxes, and
how likely it is that they were detected and missed as they were. Rays that miss by much are left out there, which makes the
noise of places a third too small. So this noise is taken from the residuals of the objects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from objslam.association.observations import MIN_DEPTH
from objslam.association.refinement import grouped_sums
from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.core.noise import MOST_POSE_NOISE
from objslam.core.types import CameraLog, Log
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.up import upright
from objslam.mapping.checks.agreement import take_frames
from objslam.mapping.checks.diagnosis import Diagnosis, diagnose
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.hypotheses.disagreement import DISAGREE
from objslam.mapping.checks.hypotheses.every import coarse_hypotheses, with_poses
from objslam.mapping.fixed.pose_noise import least_cost
from objslam.mapping.progress import Progress

if TYPE_CHECKING:
    from objslam.association.few_rays.additional_objects import FewRayEvidence

_PLACES = (1.0, 3.0, 10.0, 30.0, 100.0)
"""The factors on `localization.xy` that are tried first. More factors find more, and take longer."""
_RANGES = (1.0, 3.0, 8.0)
"""The factors on the noise of depths that are tried first."""
_RAYS = (1.0, 4.0)
"""The factors on the noise of rays that are tried first. A street hardly tells this noise from that of the places."""
_MOST_BOXES = 600
"""The most boxes that are searched, from frames that follow each other. More boxes are more exact and take longer."""
_EXPLAINED = 0.5
"""The least share of the boxes that the objects must explain. With a smaller share, noise is taken for objects."""
_TURN = 15
"""The steps (degrees) of the tried turns of all cameras about the vertical axis. A larger step misses more wrong mounts."""
_LEAD = 15.0
"""The least lead, in log odds, of the log as it is over the log with turned cameras. On streets the lead is 18 and more.
With cameras turned by 15 degrees and more, it is below 0, and mostly in rooms with turned cameras too. With a larger lead,
fewer streets are mapped. With a smaller one, wrong mounts are taken for noise."""
_SURE = 60.0
"""The lead from which the boxes agree even if few points explain most of them: each thing has few boxes. With a larger lead,
more right streets with few boxes are called wrong."""
_BETTER = 40.0
"""The least lead, in log odds, of a usual mistake over the log as it is. A straight street looks alike in a mirror, so a
corrected mistake leads by up to 25 by chance. With a larger lead, mistakes are sooner taken for noise."""
_MOST_VIEWS = 12.0
"""The most boxes that an object may have on average. The streets have 4. If objects with more boxes still disagree, wrong
input is likelier than noise, because their frames would show the noise. With a larger number, a turned camera is sooner
taken for noisy places."""
_FAR = 10.0
"""The prior standard deviation of an object's place, as a multiple of the largest distance of a ray. So the place of an
object with one ray has a variance. The number hardly matters if it is large."""
_CLEAR = 20.0
"""The least growth of the log odds over stray boxes. Dozens of noises are tried, so the odds must grow by far more than by
chance. With a larger value, a street needs more boxes."""


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


def with_sparse_noise(
    log: Log, settings: Settings, diagnosis: Diagnosis, ledger: Ledger, progress: Progress
) -> tuple[Settings, Diagnosis]:
    """Return settings with the noise of a log whose boxes disagree only because the settings say too little noise.

    diagnosis: of the log with the noise in the settings. If another noise lets the boxes agree, the returned diagnosis is of
    the log with this noise, and says so. If few boxes of each thing agree with the noise in the settings, the finding that
    they disagree is taken back. Otherwise the settings and the diagnosis are returned unchanged.
    """
    if settings.mode != "fixed" or diagnosis.certain or not any(one.name == DISAGREE for one in diagnosis.findings):
        return settings, diagnosis
    noises, lead = sparse_noise(log, settings, progress)
    for number, noise in enumerate(noises, start=1):
        noisier = noise.settings(settings)
        again = diagnosis if noise == SparseNoise() else diagnose(log, noisier, ledger, progress)
        if lead >= _SURE and number == len(noises):
            again = again.without(DISAGREE)
        if again.spoilt:
            continue
        if noise == SparseNoise():
            return settings, again
        message = (
            f"the boxes agree only with {noise.in_words(settings)}, far more than the settings say. The map was made "
            "with this noise. If you know the noise, set localization.xy, depth.sigma_per_m and rays.pixel_sigma"
        )
        return noisier, again.with_findings([Finding("noise", message, spoils=False)])
    return settings, diagnosis


def sparse_noise(log: Log, settings: Settings, progress: Progress) -> tuple[tuple[SparseNoise, ...], float]:
    """Return the noise of a log's places, depths and boxes with which its boxes show objects at the given poses.

    Also return its lead, in log odds, over the log with turned cameras. The likeliest noise comes first. If a noise that is
    about as likely has noisier places, it comes second. There is none if no noise explains most of the boxes, far better
    than chance and than the noise in the settings. Only noise that the settings let a run estimate is changed. Without
    depths, the noise in the settings is the only one: with noisy places, bearings meet anywhere.
    """
    if log.localization is None:
        return (), 0.0
    part = _part(log)
    places, depths, boxes = _unknown(part, settings)
    tried = product(_PLACES if places else (1.0,), _RANGES if depths else (1.0,), _RAYS if boxes else (1.0,))
    noises = [SparseNoise(*factors) for factors in tried]
    searched = []
    for number, noise in enumerate(noises):
        progress("noise of few boxes", number, len(noises))
        searched.append(_searched(part, settings, noise))
    best = max(searched, key=lambda one: one.value)
    views = len(best.found.ray) / max(len(best.found.positions), 1)
    nominal = best is searched[0]
    grown = best.found.chance - (0.0 if nominal else searched[0].found.chance)
    if best.value == -np.inf or grown < _CLEAR or views > _MOST_VIEWS:
        return (), 0.0
    lead = np.inf
    for corrected, turned in _what_ifs(part, lambda done, total: progress("what-ifs about the noise", done, total)):
        ahead = best.value - _searched(corrected, settings, best.noise).value
        lead = min(lead, ahead) if turned else lead
        if ahead < (_LEAD if turned else -_BETTER):
            return (), 0.0
    if nominal or not places:
        return (best.noise,), lead
    # With the larger noise, a second search would take more stray boxes into its objects, and the noise would grow again.
    prior = settings.noise.prior
    likely = best.with_place_of_residuals(prior)
    others = [one.with_place_of_residuals(prior) for one in searched if one.value > best.value - _LEAD]
    noisy = max(others, key=lambda one: one.place)
    return ((likely, noisy) if noisy.place > likely.place else (likely,)), lead


def _unknown(log: Log, settings: Settings) -> tuple[bool, bool, bool]:
    """Return whether the noise of places, of depths, and of boxes is unknown, and can be found."""
    usual, told = Settings(), any(one.camera.depth_noise is not None for one in log.cameras)
    ranged = any(one.detections is not None and np.isfinite(one.detections.depths).any() for one in log.cameras)
    known = {
        "localization": settings.localization == usual.localization,
        "ranges": settings.depth == usual.depth and not told,
        "rays": settings.rays == usual.rays,
    }
    uses = {name: getattr(settings.noise, name) for name in known}
    places, depths, boxes = (ranged and bool(known[name] if use == "auto" else use) for name, use in uses.items())
    return places, depths, boxes


@dataclass(frozen=True)
class _Searched:
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


def _searched(log: Log, settings: Settings, noise: SparseNoise) -> _Searched:
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
    return _Searched(
        noise,
        found,
        direction @ up.T,
        (found.positions[found.owner] - origin) @ up.T,
        of.sigma / noise.rays,
        of.range,
        of.range_sigma / noise.ranges,
        place / noise.place,
    )


def _what_ifs(log: Log, progress: Callable[[int, int], None]) -> Iterator[tuple[Log, bool]]:
    """Yield the log with all cameras turned about the vertical axis, and with each usual mistake about directions corrected.

    With each log comes whether its cameras are turned. Errors of the clock and of the size of images are left out. They move
    rays by little, or all places by the same way.
    """
    usual = [one for one in coarse_hypotheses(log) if one.usual]
    turns = range(_TURN, 360, _TURN)
    for number, degrees in enumerate(turns):
        progress(number, len(usual) + len(turns))
        yield with_poses(log, partial(_turned, by=np.radians(degrees))), True
    for number, hypothesis in enumerate(usual):
        progress(len(turns) + number, len(usual) + len(turns))
        yield hypothesis.put_right(log), False


def _turned(poses: Floats, by: float) -> Floats:
    """Return poses (N, 4, 4) with their headings turned by an angle, rad."""
    return poses @ lift_se2(np.array([0.0, 0.0, by]))


def _part(log: Log) -> Log:
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
