"""Simulate an RGB-D camera on rendered images: exposure, blur, vignette and grain, and depth with noise and holes."""

import numpy as np
from numpy.typing import NDArray

from objslam.config import NotNegative, Positive, Section
from objslam.simulation.raycast import Reals
from objslam.simulation.settings import Probability

_STRIP = 32
"""The number of image rows that get their noise at a time. The arrays of 32 rows fit into a processor's cache. A larger
number is slower: if whole images of 640 x 480 px get their noise at once, this takes nearly twice the time."""
_GAMMA = (255 * np.linspace(0.0, 1.0, 4096) ** (1 / 2.2) + 0.5).astype(np.uint8)
"""The 8-bit value for each of 4096 steps of linear light, with a gamma of 2.2. More steps make dark values more exact."""


class Sensor(Section):
    """The errors of colour and depth images."""

    exposure: NotNegative = 0.25
    """The standard deviation of ln(exposure / automatic exposure). The exposure drifts slowly during a drive."""
    white: NotNegative = 0.04
    """The standard deviation of the error of each colour channel's gain. The errors are drawn once for a drive."""
    blur: NotNegative = 0.5  # The sigma of the lens blur, px.
    vignette: Probability = 0.2  # The share of light that is lost in the image's corners.
    shot: NotNegative = 0.02
    """The standard deviation of the shot noise at full light, as a share of full light. The noise is proportional to the
    square root of the light."""
    read: NotNegative = 0.006
    """The standard deviation of the read noise, as a share of full light. The read noise is also present in the dark."""
    depth_sigma: NotNegative = 0.002  # The constant part of the depth noise, m.
    depth_sigma_per_m2: NotNegative = 0.002
    """The part of the depth noise that grows with the square of the depth, m per m^2."""
    depth_missing: Probability = 0.01
    """The share of random pixels that get no depth. Pixels at depth edges and on steep surfaces never get a depth."""
    depth_range: tuple[Positive, Positive] = (0.3, 6.0)  # The least and largest measured depth, m.


def exposures(sensor: Sensor, frames: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw the gains (F, 3) of the colour channels in each image, relative to automatic exposure. The gains drift slowly."""
    steps = rng.standard_normal(frames)
    wander = np.empty(frames)
    value = steps[0]
    for i, step in enumerate(steps):  # With 0.97, the correlation falls to one half in about 20 frames.
        value = 0.97 * value + np.sqrt(1 - 0.97**2) * step
        wander[i] = value
    balance = 1 + sensor.white * rng.standard_normal(3)
    return np.asarray(np.exp(sensor.exposure * wander)[:, None] * balance)


def expose(sensor: Sensor, light: Reals, gain: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Turn linear light (H, W, 3) into an 8-bit RGB image (H, W, 3). gain: (3,) the gain of each colour channel. A gain of 1
    makes the mean light 0.25 of full light."""
    import cv2

    y, x = (np.linspace(-1, 1, count).astype(np.float32) for count in light.shape[:2])
    fall_off = (1 - sensor.vignette * (x**2 + (y**2)[:, None]) / 2)[..., None]
    image = light * (fall_off * (0.25 / max(float(light.mean()), 1e-6) * gain).astype(np.float32))
    if sensor.blur > 0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sensor.blur), dtype=np.float32)
    exposed = np.empty(image.shape, dtype=np.uint8)
    for start in range(0, len(image), _STRIP):
        part = image[start : start + _STRIP]
        noise = rng.standard_normal(part.shape, dtype=np.float32)
        noise *= np.sqrt(np.float32(sensor.shot**2) * np.clip(part, 0.0, 1.0) + np.float32(sensor.read**2))
        noise += part
        np.clip(noise, 0.0, 1.0, out=noise)
        noise *= 4095
        _GAMMA.take(noise.astype(np.int32), out=exposed[start : start + _STRIP])
    return exposed


def measure_depth(sensor: Sensor, depth: Reals, rng: np.random.Generator) -> Reals:
    """Add noise to depth (H, W), m. Pixels out of range, pixels at depth edges and some random pixels become 0."""
    low, high = sensor.depth_range
    inside = np.isfinite(depth) & (depth >= low) & (depth <= high)
    z = np.where(inside, depth, 0.0).astype(np.float32)
    jump = np.zeros(z.shape, dtype=bool)
    for first, second in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):  # Neighbours along each axis.
        step = np.abs(z[second] - z[first]) > 0.05 * np.minimum(z[first], z[second]) + 1e-6
        jump[first] |= step
        jump[second] |= step
    kept = inside & ~jump & (rng.random(z.shape, dtype=np.float32) >= sensor.depth_missing)
    sigma = sensor.depth_sigma + sensor.depth_sigma_per_m2 * z**2
    noisy = z + sigma * rng.standard_normal(z.shape, dtype=np.float32)
    return np.asarray(np.where(kept, noisy, 0.0), dtype=np.float32)
