"""Checks of a map at fixed poses: whether poses err, or rays miss their objects, by more than the noise in the settings."""

from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.noise import MOST_NOISE
from objslam.core.object_map import ObjectMap
from objslam.core.statistics import RAYLEIGH_MEDIAN
from objslam.core.types import Association, Keyframes, Rays
from objslam.graph.fixed_pose_triangulation import noise_of_poses, pose_noise
from objslam.mapping.checks.finding import Finding

_MOST = np.sqrt(2.0)
"""A run warns if the residuals exceed this multiple of the noise in the settings. From this value on, the settings explain
at most half of the variance. A larger value warns less often."""
_SIGMAS = 3.0
"""A run warns if the multiple of the noise exceeds `_MOST` by at least this many standard deviations of the multiple. With a
larger number, a log must be longer before it can cause a warning."""
_MEDIAN_SIGMA = 0.72
"""The standard deviation of the multiple from one ray: 1 / (2 p(m) m) for the density p of a Rayleigh distribution at its
median m. For n independent rays, it is divided by the root of n."""


def misses(
    objects: ObjectMap, keyframes: Keyframes, rays: Rays, association: Association, residual: Floats, settings: Settings
) -> float:
    """Return the median residual of the objects that are ok, as a multiple of its expected noise. NaN without such objects.

    At fixed poses, the expected noise contains the noise of the localisation. residual: (R,) rad between each ray and its
    object.
    """
    held = held_rays(objects, association)
    if not held.any():
        return float("nan")
    promised = promised_noise(objects, keyframes, rays, association, settings)
    return float(np.median(residual[held] / promised)) / RAYLEIGH_MEDIAN


def promised_noise(
    objects: ObjectMap, keyframes: Keyframes, rays: Rays, association: Association, settings: Settings
) -> Floats:
    """Return the expected noise (H,), rad, of the rays whose objects are ok: the standard deviation of the angle between a
    ray and its object."""
    held = held_rays(objects, association)
    angle, place = pose_noise(rays, keyframes, settings) if settings.mode == "fixed" else (rays.sigma, 0.0)
    origins, _ = rays.in_map(keyframes.map_T_camera)
    positions = np.array([one.position for one in objects.objects])
    distance = np.linalg.norm(positions[association.object[held]] - origins[held], axis=1)
    return np.hypot(angle[held], place / np.maximum(distance, 1e-9))


def check_pose_noise(
    objects: ObjectMap, keyframes: Keyframes, rays: Rays, association: Association, settings: Settings, *, calibrated: bool
) -> Finding | None:
    """Return a finding if most rays are far noisier than the settings say, because the poses err.

    The covariances of the map contain this noise, so they are right. Better poses would make the map more exact. calibrated:
    whether the cameras were calibrated against the poses.
    """
    if keyframes.pose_noise == (1.0, 1.0) or not held_rays(objects, association).any():
        return None
    usual = replace(keyframes, pose_noise=(1.0, 1.0))
    found, promised = (promised_noise(objects, frames, rays, association, settings) for frames in (keyframes, usual))
    if np.median(found / promised) < _MOST:
        return None
    (yaw, place), (turns, shifts) = noise_of_poses(keyframes, settings), keyframes.pose_noise
    least = "at least " if max(turns, shifts) >= 0.999 * MOST_NOISE else ""
    cause = "is the localisation that noisy?"
    if not calibrated:
        cause = "is the localisation that noisy, or are the clock or the calibration wrong (--set calibration.use=true)?"
    return Finding(
        "localisation noise",
        f"all boxes of a frame miss their objects together: the poses err by {least}{np.degrees(yaw):.2g} deg and "
        f"{100 * place:.2g} cm, {turns:.1f} and {shifts:.1f} times what localization.yaw and localization.xy say. The map "
        f"allows for these errors, so its sigmas are large; {cause}",
        spoils=False,
    )


def held_rays(objects: ObjectMap, association: Association) -> Bools:
    """Return a mask (R,) of the rays whose objects are ok."""
    ok = np.array([one.status == "ok" for one in objects.objects] + [False])
    held: Bools = ok[association.object]  # The index -1 (no object) gives the last entry.
    return held


def check_residuals(
    objects: ObjectMap,
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    residual: Floats,
    settings: Settings,
    *,
    calibrated: bool,
) -> Finding | None:
    """Return a finding if rays miss their objects by far more than the noise of boxes and localisation. Only objects that
    are ok count.

    residual: (R,) rad between each ray and its object. calibrated: whether the cameras were calibrated against the poses.
    All rays of an object count, also rejected rays. Rays of one keyframe share its pose error, so they count as one ray.
    """
    held = held_rays(objects, association)
    if not held.any():
        return None
    times = misses(objects, keyframes, rays, association, residual, settings)
    independent = len(np.unique(rays.keyframe[held]))
    if times - _SIGMAS * _MEDIAN_SIGMA / np.sqrt(independent) < _MOST:
        return None
    worse = "the poses or the boxes are" if calibrated else "the poses, the clock, the calibration or the boxes are"
    if settings.association.method == "by_label":
        worse = f"a label is several things, or {worse}"
    remedy = "--mode joint" if calibrated else "--set calibration.use=true, or --mode joint"
    return Finding(
        "rays miss",
        f"the rays miss their objects by {np.degrees(np.median(residual[held])):.2f} deg, {times:.1f} times what "
        f"rays.pixel_sigma, rays.box_sigma and localization.* say: {worse} worse than the settings; try {remedy}",
        spoils=False,
    )
