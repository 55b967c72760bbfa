"""Check whether a solve moved the cameras back, which shows that the objects of a row may be at wrong places.

A camera sees the near side of a thing, and other things hide parts of the thing. So rays from one side cross before the
centre of the thing, and a solve of poses moves the cameras ahead until the rays cross at the centre. A single thing never
moves the cameras back. But in a row of large equal things, rays from one end of the row can cross rays from the other end at
the wrong neighbour. All things then lie half a spacing off, and the cameras move back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.calibration import Calibration
from objslam.mapping.checks.finding import Finding

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.core.types import Keyframes
    from objslam.mapping.solution import Solution

_STRETCHES = 10
"""The number of stretches of a drive whose mean shifts count as independent. With fewer stretches, the standard deviation of
the shift is less exact."""
_LEVEL = 0.5
"""The least horizontal part of the unit viewing direction of a camera that counts. Cameras that look down see the tops of
things."""
_CLEAR = 2.0
"""The number of standard deviations that a clear shift exceeds. The shift must exceed the same multiple of `localization.xy`
too. With a larger number, fewer maps are doubted. In simulations of rows, wrong maps have shifts of -5 to -75 cm at 2.4 to
20 standard deviations, and right maps have 4 to 19 cm ahead. Other maps have -5 to 2 cm, and recorded robots -2 to 2 cm."""
_RANGED = 0.5
"""The share of the used rays with ranges from which a map is not doubted. A ray to a neighbour in a row has another range.
With a larger share, more maps with ranges are doubted. Logs have ranges for nearly all boxes or for none."""
BACK = "rows of equal things that may be off by half their spacing"
"""The name of the finding that a solve moved the cameras back."""


def shift_ahead(
    keyframes: Keyframes, map_T_base: Floats, calibration: Calibration | None, cameras: tuple[str, ...]
) -> tuple[float, float]:
    """Return the mean shift (m) of the cameras along their horizontal viewing directions by a solve, and its standard
    deviation (m).

    The shared errors of the cameras' places on the robot count too, with their covariance. The result is (0, 0) if all
    cameras look up or down.

    keyframes: the keyframes with the given poses. map_T_base: (K, 4, 4) the solved poses. calibration: the shared errors.
    cameras: the names of the cameras.
    """
    ahead = (map_T_base @ keyframes.base_T_camera)[:, :2, 2]
    level = np.linalg.norm(ahead, axis=1)
    used = np.flatnonzero(level >= _LEVEL)
    if not len(used):
        return 0.0, 0.0
    moved = np.einsum("ki,ki->k", (map_T_base - keyframes.map_T_base)[used, :2, 3], ahead[used] / level[used, None])
    mount = keyframes.base_T_camera[used, :2, 2] / np.linalg.norm(keyframes.base_T_camera[used, :2, 2], axis=1)[:, None]
    means = np.array([part.mean() for part in np.array_split(moved, min(_STRETCHES, len(moved)))])
    shift, variance = float(means.mean()), float(means.var() / len(means))
    if calibration is not None:
        camera = keyframes.camera[used]
        share = np.stack([(mount * (camera == c)[:, None]).mean(axis=0) for c in range(len(cameras))])  # (C, 2)
        by_name = {f"{name}.{axis}": share[c, i] for c, name in enumerate(cameras) for i, axis in enumerate("xy")}
        by_value = np.array([by_name.get(name, 0.0) for name in calibration.names])
        shift += float(by_value @ calibration.values)
        variance += float(by_value @ calibration.covariance @ by_value)
    return shift, float(np.sqrt(variance))


def moves_back(shift: tuple[float, float], settings: Settings) -> bool:
    """Return whether the cameras clearly moved back. shift: from `shift_ahead`."""
    return shift[0] < -_CLEAR * max(settings.localization.xy, shift[1])


def check_rows(solution: Solution, cameras: tuple[str, ...], settings: Settings) -> Finding | None:
    """Return a finding if a joint solve at localised poses moved the cameras back, and labels have several objects.

    The result is None if most rays have ranges, because ranges distinguish neighbours. With ranges, cameras may also move
    back because the ranges are too long.
    """
    keyframes, estimate, association = solution.keyframes, solution.estimate, solution.association
    used = (estimate.weight > 0) & (association.object >= 0)
    if used.any() and np.isfinite(solution.rays.range[used]).mean() >= _RANGED:
        return None
    number = np.bincount(association.label[np.isfinite(estimate.covariance[:, 0, 0])])
    if not keyframes.localized_every or number.max(initial=0) < 2:
        return None
    shift = shift_ahead(keyframes, estimate.map_T_base, estimate.calibration, cameras)
    if not moves_back(shift, settings):
        return None
    return Finding(
        BACK,
        f"the boxes agree only if the robot was {-100 * shift[0]:.0f} cm farther back, on all ways, than its localisation "
        "says. Boxes show the near sides of things, so they only seem to move it ahead. In a row of equal things, boxes may "
        "count for a neighbour, and all things of the row may be off by half their spacing. Depths would show it",
        spoils=False,
    )
