"""Factors for a localisation, which measures the absolute pose of a keyframe.

The error of a pose may be new in each pose, or last for seconds, or have both parts. A lasting error is a first-order
Gauss-Markov process (Jazwinski 1970, 4.5). After the time t, the share r = exp(-t / T) of the error is left, and r^2 of its
variance. The information of such a chain is a sum of terms on single errors and on differences of consecutive errors. So a
localisation with lasting errors gives weak absolute poses, and precise motions from pose to pose. The absolute poses become
priors, and the motions become between-factors. No further variables are needed.
"""

from dataclasses import dataclass, replace
from typing import Self

import gtsam
import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import adjoint, inverse, is_planar
from objslam.core.ground.flattening import noise_of_ground
from objslam.core.statistics import Lasting
from objslam.core.types import Keyframes
from objslam.graph.factors.noise import huber
from objslam.graph.variables import X0

_UNTOLD = 10.0
"""The standard deviation (rad, m) of the parts of a motion that a localisation does not measure, such as the change of
height. A larger value constrains these parts less, and makes the solve less exact."""
_CONTINUED = 1e3
"""The standard deviation (rad, m) of an absolute pose that no localisation measured. It must be so large that thousands of
such poses together still have almost no information. A larger value makes the solve less exact."""
_LONGEST = 0.9999
"""The largest share of a lasting error that is left at the next pose. A larger share ties two poses of nearly the same time
more closely, and makes the solve less exact."""


Parts = Floats | float
"""Standard deviations of poses or motions: one number for all, or an array with one number for each."""


@dataclass(frozen=True)
class LocalizedMotions:
    """The motions that a localisation with lasting errors measures between consecutive keyframes.

    before, after: (s,) the keyframes. motion: (s, 4, 4) of the camera. covariance: (s, 6, 6), rotation first, in the frame
    of the camera after the motion.
    """

    before: Ints
    after: Ints
    motion: Floats
    covariance: Floats

    def joined(self, other: Self) -> Self:
        """Return these motions, followed by other motions."""
        return replace(self, **{name: np.concatenate([mine, getattr(other, name)]) for name, mine in vars(self).items()})

    def factors(self) -> list[gtsam.NonlinearFactor]:
        """Return one between-factor for each motion, with Huber's loss, because a localisation may jump."""
        return [
            gtsam.BetweenFactorPose3(X0 + i, X0 + j, gtsam.Pose3(m), huber(gtsam.noiseModel.Gaussian.Covariance(c)))
            for i, j, m, c in zip(self.before.tolist(), self.after.tolist(), self.motion, self.covariance, strict=True)
        ]


def localizations(
    keyframes: Keyframes, settings: Settings, first: int = 0, on_plane: bool | None = None
) -> list[gtsam.NonlinearFactor]:
    """Return priors on the poses of the keyframes, which are X(first), X(first + 1) and so on.

    The priors have Huber's loss, because a localisation may jump. If one measurement gives the poses of several keyframes,
    only the nearest keyframe has the information (`localized`). If `localized_at` is None, all keyframes have equal parts.
    on_plane: whether the path is planar. If it is None, the poses decide.
    """
    covariance = localization_covariance(keyframes, settings, on_plane)
    return [
        localization(first + k, pose, c) for k, (pose, c) in enumerate(zip(keyframes.map_T_camera, covariance, strict=True))
    ]


def localization(k: int, map_T_camera: Floats, covariance: Floats) -> gtsam.NonlinearFactor:
    """Return a prior on X(k) at a pose (4, 4), with Huber's loss. covariance: (6, 6) in the camera frame, rotation first."""
    noise = huber(gtsam.noiseModel.Gaussian.Covariance(covariance))
    return gtsam.PriorFactorPose3(X0 + k, gtsam.Pose3(map_T_camera), noise)


def localization_covariance(keyframes: Keyframes, settings: Settings, on_plane: bool | None = None) -> Floats:
    """Return the covariances (K, 6, 6) of the keyframes' absolute poses, in their camera frames, rotation first.

    If errors last, the poses have less information, and `localized_motions` has the rest. on_plane: whether the path is
    planar. If it is None, the poses decide.
    """
    on_plane = is_planar(keyframes.map_T_base) if on_plane is None else on_plane
    (yaw, _), (xy, _) = _chains(keyframes, settings)
    each = np.full((2, len(keyframes)), _CONTINUED)
    each[:, localized(keyframes)] = yaw, xy
    yaw, xy = each
    tilt, z = _of_ground(keyframes, settings)[0] if on_plane else (yaw, xy)
    parts = (tilt, tilt, yaw, xy, xy, z)
    s = np.stack([np.broadcast_to(np.square(part), len(keyframes)) for part in parts], axis=1) * sharing(keyframes)
    return _in_camera(keyframes.base_T_camera, s)


def localized_motions(keyframes: Keyframes, settings: Settings, on_plane: bool | None = None) -> LocalizedMotions | None:
    """Return the motions that a localisation measures because its errors last. None if its errors are new in each pose.

    A motion is known in the frame of the robot. An error of the robot's heading turns the motion to a side. Because this
    error may last, it has the noise of an absolute heading here.
    """
    if not keyframes.localized_every or len(keyframes) < 2:
        return None
    on_plane = is_planar(keyframes.map_T_base) if on_plane is None else on_plane
    lasts, ground = any(one.share for one in keyframes.lasting), on_plane and settings.planar.seconds > 0
    if not lasts and not ground:
        return None
    every, number = np.arange(len(keyframes)), localized(keyframes)
    (heading, yaw), (_, xy) = _chains(keyframes, settings)
    xy = np.hypot(xy, _way(keyframes, number) * heading[:-1])
    tilt, z = (_UNTOLD, _UNTOLD) if on_plane else (yaw, xy)
    if not ground:
        return _motions(keyframes, number, (tilt, tilt, yaw, xy, xy, z))
    tilt, z = _of_ground(keyframes, settings)[1]
    z = np.hypot(z, _way(keyframes, every) * noise_of_ground(settings)[0])  # A base that tilts moves along its own axes.
    if len(number) == len(every):
        return _motions(keyframes, every, (tilt, tilt, yaw, xy, xy, z))
    by_localization = _motions(keyframes, number, (_UNTOLD, _UNTOLD, yaw, xy, xy, _UNTOLD))
    return by_localization.joined(_motions(keyframes, every, (tilt, tilt, _UNTOLD, _UNTOLD, _UNTOLD, z)))


def _way(keyframes: Keyframes, number: Ints) -> Floats:
    """Return the distances (n-1,), m, that the robot drove between consecutive keyframes of `number` (n,).

    The distances are from the odometry, without its shared errors. Distances between localised places contain the noise of
    the motions that they weigh. With them, motions that seem short would count for more, and the map would be too small.
    With distances that follow the odometry's scale, a larger map would fit better.
    """
    driven = keyframes.way if keyframes.driven is None else keyframes.driven
    return np.diff(driven[number])


def _motions(keyframes: Keyframes, number: Ints, parts: tuple[Parts, ...]) -> LocalizedMotions:
    """Return the motions between consecutive keyframes of `number` (n,).

    parts: the standard deviations of roll, pitch, yaw (rad), x, y, z (m) in the frame of the base. Each is one number for
    all motions, or has one number for each motion (n-1,).
    """
    poses, before, after = keyframes.map_T_camera, number[:-1], number[1:]
    s = np.stack([np.broadcast_to(np.square(part), len(before)) for part in parts], axis=1) / sharing(keyframes)
    spread = _in_camera(keyframes.base_T_camera[after], np.minimum(s, _UNTOLD**2))
    return LocalizedMotions(before, after, inverse(poses[before]) @ poses[after], spread)


def localized(keyframes: Keyframes) -> Ints:
    """Return the keyframes (n,) that count as localised, in increasing order. If one measurement gave a pose to several
    keyframes, only the keyframe nearest in time counts."""
    if (at := keyframes.localized_at) is None:
        return np.arange(len(keyframes))
    order = np.lexsort((np.abs(keyframes.frame_stamps - at), at))
    measured = at[order]
    return np.sort(order[np.isfinite(measured) & (np.diff(measured, prepend=np.nan) != 0)])


def sharing(keyframes: Keyframes) -> float:
    """Return the number of keyframes that share one measured absolute pose. It is 1 if `localized_at` tells them apart."""
    return keyframes.localized_every if keyframes.localized_at is None else 1.0


def _of_ground(keyframes: Keyframes, settings: Settings) -> tuple[tuple[Parts, Parts], tuple[Parts, Parts]]:
    """Return the standard deviations of tilt (rad) and height (m). The first pair is of poses (K,), the second pair is of
    motions (K-1,).

    Uneven ground moves a robot as a lasting error would. If `planar.seconds` is 0, motions have almost no information. Poses
    that share a measurement share its information. The information of the ground is not shared, so the standard deviations
    undo the division by `localized_every`.
    """
    of, root = settings.planar, np.sqrt(sharing(keyframes))
    if not of.seconds:
        return (of.tilt, of.z), (_UNTOLD, _UNTOLD)
    gaps = np.maximum(np.diff(keyframes.stamps), 0.0)
    (tilt, turned), (z, raised) = (chain(gaps, sigma, Lasting(1.0, of.seconds)) for sigma in (of.tilt, of.z))
    return (tilt / root, z / root), (turned * root, raised * root)


def _in_camera(base_T_camera: Floats, variances: Floats) -> Floats:
    """Return the covariances (n, 6, 6) in camera frames of errors with `variances` (n, 6) in the base frames."""
    to_camera = adjoint(inverse(base_T_camera))
    covariance = (to_camera * variances[:, None, :]) @ np.swapaxes(to_camera, 1, 2)
    return np.asarray((covariance + np.swapaxes(covariance, 1, 2)) / 2)


def _chains(keyframes: Keyframes, settings: Settings) -> list[tuple[Floats, Floats]]:
    """Return the standard deviations of the n keyframes that count as localised. The first pair is of headings (rad), the
    second pair is of places (m). Each pair has one array for poses (n,) and one array for motions (n-1,)."""
    number, of = localized(keyframes), settings.localization
    if not len(number):
        return [(np.zeros(0), np.zeros(0))] * 2
    gaps = np.maximum(np.diff(keyframes.stamps[number]), 0.0) * max(sharing(keyframes), 1.0)
    more = np.zeros((2, 1)) if keyframes.carried is None else keyframes.carried[number].T
    columns = zip((of.yaw, of.xy), keyframes.pose_noise, keyframes.lasting, more, strict=True)
    return [chain(gaps, nominal * factor, lasting, added) for nominal, factor, lasting, added in columns]


def chain(gaps: Floats, sigma: float, lasting: Lasting, more: Floats | float = 0.0) -> tuple[Floats, Floats]:
    """Replace correlated errors by independent terms. Return the standard deviations of the terms.

    The first array is of terms on single errors (K,). The second is of terms on differences of neighbouring errors (K-1,).

    The terms are exact if the whole error lasts, or if nothing of it lasts. An error with both parts has no exact terms. Its
    terms have the true information about constant errors, and about errors that change their sign from pose to pose. At the
    frequencies w between these two, the true information is larger: it is a concave function of 2 - 2 cos(w), and the terms
    are linear in 2 - 2 cos(w).

    Args:
        gaps: (K-1,) s, the times between consecutive errors.
        sigma: the standard deviation of the whole error.
        lasting: the lasting part of the error.
        more: (K,) variances of further white errors, or one for all.
    """
    more = np.broadcast_to(more, len(gaps) + 1)
    if not lasting.share:
        return np.sqrt(sigma**2 + more), np.full(len(gaps), np.inf)
    white, lasts = sigma**2 * (1 - lasting.share) + more, sigma**2 * lasting.share
    stays = np.minimum(np.exp(-gaps / lasting.seconds), _LONGEST)
    before, after = np.append(0.0, stays), np.append(stays, 0.0)
    alone = white + lasts / (1 / (1 + before) + 1 / (1 + after) - 1)
    white = (white[1:] + white[:-1]) / 2
    constant = 1 / (white + lasts * (1 + stays) / (1 - stays))
    changing = 1 / (white + lasts * (1 - stays) / (1 + stays))
    return np.sqrt(alone), 2 / np.sqrt(np.maximum(changing - constant, 1e-12))
