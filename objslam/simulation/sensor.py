"""What a real RGB-D camera makes of a rendered image: exposure, blur, vignette and grain; depth that errs and has holes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from objslam.config import NotNegative, Positive, Section
from objslam.simulation.raycast import Reals
from objslam.simulation.settings import Probability


class Sensor(Section):
    """How colour and depth err."""

    exposure: NotNegative = 0.25
    """standard deviation of the exposure's logarithm around that of an automatic exposure; it wanders over a drive."""
    white: NotNegative = 0.04
    """standard deviation of each colour channel's gain around the right white balance; one value a drive."""
    blur: NotNegative = 0.5
    """px; sigma of the lens."""
    vignette: Probability = 0.2
    """share of the light that is lost in the corners."""
    shot: NotNegative = 0.02
    """standard deviation of the grain at full light (it grows with the root of the light),"""
    read: NotNegative = 0.006
    """and what is left of it in the dark."""
    depth_sigma: NotNegative = 0.002
    """m; the noise of a depth that does not depend on it,"""
    depth_sigma_per_m2: NotNegative = 0.002
    """and what grows with its square."""
    depth_missing: Probability = 0.01
    """share of pixels without a depth, besides those at edges and glancing surfaces."""
    depth_range: tuple[Positive, Positive] = Field(default=(0.3, 6.0))
    """m; nearer and further than this there is no depth."""


def exposures(sensor: Sensor, frames: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """The gains (F, 3) of each frame's channels around an automatic exposure: a slow random walk, and a white balance."""
    steps = rng.standard_normal(frames)
    wander = np.empty(frames)
    value = steps[0]
    for i, step in enumerate(steps):  # 0.97: half of it is forgotten after some 20 frames
        value = 0.97 * value + np.sqrt(1 - 0.97**2) * step
        wander[i] = value
    balance = 1 + sensor.white * rng.standard_normal(3)
    return np.asarray(np.exp(sensor.exposure * wander)[:, None] * balance)


def expose(sensor: Sensor, light: Reals, gain: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.uint8]:
    """An 8-bit RGB image (H, W, 3) of linear light (H, W, 3); gain (3,) around the exposure that gives a mean of 0.25."""
    import cv2

    height, width = light.shape[:2]
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j].astype(np.float32)
    fall_off = (1 - sensor.vignette * (x**2 + y**2) / 2)[..., None]
    scale = 0.25 / max(float(light.mean()), 1e-6)
    image = light * (fall_off * (scale * gain).astype(np.float32))
    if sensor.blur > 0:
        image = cv2.GaussianBlur(image, (0, 0), sensor.blur)
    sigma = np.sqrt(sensor.shot**2 * np.clip(image, 0.0, 1.0) + sensor.read**2)
    image = image + sigma.astype(np.float32) * rng.standard_normal(image.shape, dtype=np.float32)
    table = (255 * np.linspace(0.0, 1.0, 4096) ** (1 / 2.2) + 0.5).astype(np.uint8)
    return np.asarray(table[(np.clip(image, 0.0, 1.0) * 4095).astype(np.int32)])


def measure_depth(sensor: Sensor, depth: Reals, rng: np.random.Generator) -> Reals:
    """Depth (H, W), m, as a sensor gives it, 0 where it has none: out of range, at edges, at random."""
    low, high = sensor.depth_range
    inside = np.isfinite(depth) & (depth >= low) & (depth <= high)
    z = np.where(inside, depth, 0.0).astype(np.float32)
    jump = np.zeros(z.shape, dtype=bool)
    for axis in (0, 1):
        step = np.abs(np.diff(z, axis=axis)) > 0.05 * np.minimum(*_neighbours(z, axis)) + 1e-6
        first, second = _halves(axis)
        jump[first] |= step
        jump[second] |= step
    kept = inside & ~jump & (rng.random(z.shape, dtype=np.float32) >= sensor.depth_missing)
    sigma = sensor.depth_sigma + sensor.depth_sigma_per_m2 * z**2
    noisy = z + sigma * rng.standard_normal(z.shape, dtype=np.float32)
    return np.asarray(np.where(kept, noisy, 0.0), dtype=np.float32)


def _halves(axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    every = slice(None)
    return (
        ((slice(None, -1), every), (slice(1, None), every))
        if axis == 0
        else ((every, slice(None, -1)), (every, slice(1, None)))
    )


def _neighbours(z: Reals, axis: int) -> tuple[Reals, Reals]:
    first, second = _halves(axis)
    return z[first], z[second]
