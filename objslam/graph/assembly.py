"""Turn the measurements of a log into factors, for the initialisation, the outlier rejection and the final solve."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, Self

import gtsam
import numpy as np

from objslam.config import Loss, Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import is_planar
from objslam.core.types import Keyframes, Rays
from objslam.graph.factors.bearing import bearings_fixed, point_to_line_fixed
from objslam.graph.factors.localization import LocalizedMotions, localizations, localized_motions
from objslam.graph.factors.localized_rows import LocalizedRows
from objslam.graph.factors.noise import robust
from objslam.graph.factors.odometry import betweens, motions
from objslam.graph.factors.odometry_motions import OdometryMotions, find_ties
from objslam.graph.factors.priors import anchor, point_prior
from objslam.graph.factors.range import along_ray
from objslam.graph.factors.rays import ray_factors
from objslam.graph.multiframes import Multiframes
from objslam.graph.optimizers import build_graph
from objslam.graph.tags.corner_rays import TagCorners
from objslam.graph.tags.square_rows import SquareRows
from objslam.graph.tags.squares import add_squares
from objslam.graph.variables import make_values


class RowsOfKind(Protocol):
    """All n factors of one kind, as arrays. Each factor has r rows, and all its rows share c columns.

    The columns are as in `JointRows`: three for each landmark of the graph, then six for each pose.
    """

    @property
    def rows_each(self) -> int:
        """r, the number of rows of a factor."""

    @property
    def columns(self) -> Ints:
        """(n, c) the columns of each factor. All rows of a factor share them."""

    def rows(self, map_T_camera: Floats, landmarks: Floats) -> tuple[Floats, Floats, float]:
        """Return the whitened residuals (n, r), their derivatives (n, r, c) and the cost at camera poses (P, 4, 4) and
        positions (m, 3), m. Residuals and derivatives contain the roots of the robust weights."""


@dataclass(frozen=True)
class Measurements:
    """The measurements of a log, as P multiframes.

    images: all K keyframes. keyframes: the first keyframe of each multiframe. Only these keyframes have a pose in the graph.
    rays: all R rays, in the camera frames of `keyframes`. motions: the camera motions in the graph, None without odometry.
    tags: the fiducials whose corners are landmarks, None without fiducials.
    """

    multiframes: Multiframes
    images: Keyframes
    keyframes: Keyframes
    rays: Rays
    settings: Settings
    motions: OdometryMotions | None = None
    tags: TagCorners | None = None

    @classmethod
    def of(
        cls,
        images: Keyframes,
        rays: Rays,
        settings: Settings,
        multiframes: Multiframes | None = None,
        tags: TagCorners | None = None,
        ties: Ints | None = None,
    ) -> Self:
        """Compute the measurements from keyframes and rays. Without multiframes, each keyframe has its own pose.

        ties: (T, 2) the ties between multiframes, from `find_ties`. If it is None, the function finds them.
        """
        joined = Multiframes.single(len(images)) if multiframes is None else multiframes
        keyframes, rays = joined.keyframes(images), joined.rays(images, rays)
        used = None
        if keyframes.odom_T_base is not None:
            used = OdometryMotions.of(keyframes, settings, find_ties(keyframes, settings) if ties is None else ties)
        sized = None if tags is None else tags.sized(rays.label_names, settings)
        return cls(joined, images, keyframes, rays, settings, used, sized)

    def map_T_base(self, map_T_camera: Floats) -> Floats:
        """Return the base poses (K, 4, 4) at all images, from the poses (P, 4, 4) of the graph."""
        return self.multiframes.map_T_base(self.images, map_T_camera)

    @cached_property
    def seen_twice(self) -> Bools:
        """(M,) whether both poses of each motion see the same fiducial. Its corners also measure the motion.

        A tie between multiframes is True if one of the motions between its ends is True.
        """
        if self.motions is None:
            return np.zeros(0, dtype=bool)
        if self.tags is None:
            return np.zeros(len(self.motions), dtype=bool)
        number = np.append(0, np.cumsum(self.tags.measured_motions(self.rays, len(self.keyframes))))
        return np.asarray(number[self.motions.after] > number[self.motions.before])

    @cached_property
    def motion_factors(self) -> list[gtsam.NonlinearFactor]:
        """The factors of `motions`. All graphs share these factors, because they never change."""
        of = self.motions
        return [] if of is None else betweens(of.before, of.after, of.motion, of.covariance, self.seen_twice)

    @cached_property
    def localized_motions(self) -> LocalizedMotions | None:
        """The motions that a localisation with lasting errors measures, None without such errors."""
        return localized_motions(self.keyframes, self.settings)

    @property
    def localized_factors(self) -> list[gtsam.NonlinearFactor]:
        """The factors of `localized_motions`. Only the graph of a whole log contains them."""
        return [] if self.localized_motions is None else self.localized_motions.factors()

    def whole(
        self, owner: Ints, used: Bools, map_T_camera: Floats, positions: Floats, loss: Loss = "huber"
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Return the graph of the whole log, and its values. The ties of fiducials are its last factors.

        owner: (R,) the landmark of each ray. used: (R,) whether a ray is in the graph. map_T_camera: (P, 4, 4). positions:
        (N, 3) m, NaN for a landmark that is not in the graph. loss: the loss of the bearings.
        """
        landmarks = np.flatnonzero(np.isfinite(positions[:, 0]))
        factors = self.factors(owner, np.flatnonzero(used), landmarks, positions, loss)
        factors += self.localized_factors
        values = make_values(map_T_camera, positions, landmarks)
        if self.tags is not None:
            factors += add_squares(self.tags, landmarks, positions, values, self.settings.joint.prior_sigma)
        return build_graph(factors), values

    def further_rows(self, landmarks: Ints) -> tuple[SquareRows, *tuple[RowsOfKind, ...]]:
        """Return the kinds of factors that make their own rows.

        `JointGraph` makes the rows of bearings, ranges, weak priors, motions and poses. This method returns all other kinds.
        landmarks: (m,) the landmarks in the graph, in increasing order.
        """
        squares, by_localization = SquareRows.of(self.tags, landmarks), self.localized_motions
        if by_localization is None:
            return (squares,)
        return squares, LocalizedRows(by_localization, 3 * len(landmarks))

    @cached_property
    def _steps(self) -> tuple[Floats, Floats]:
        return motions(self.keyframes, self.settings)

    def odometry(self) -> tuple[Floats, Floats]:
        """Return the camera motions (P-1, 4, 4) that odometry measured, and their covariances (P-1, 6, 6).

        Without odometry, a ValueError is raised.
        """
        return self._steps

    def factors(
        self,
        owner: Ints,
        which: Ints,
        landmarks: Ints,
        positions: Floats,
        loss: Loss = "huber",
        begin: int = 0,
        end: int | None = None,
    ) -> list[gtsam.NonlinearFactor]:
        """Return the factors that new keyframes, rays and landmarks add to a graph.

        Args:
            owner: (R,) the landmark of each ray, or -1.
            which: (n,) the added rays. The first n factors are the bearings of the added rays, in this order.
            landmarks: (m,) the added landmarks.
            positions: (N, 3) m, all landmarks in map.
            loss: the loss of the bearings.
            begin, end: the added keyframes are `begin` to `end` - 1. If `end` is None, they end with the last keyframe.
        """
        keyframes, settings = self.keyframes, self.settings
        end = len(keyframes) if end is None else end
        made = [f for _, group in ray_factors(self.rays.take(which), owner[which], loss, settings) for f in group]
        made += [point_prior(j, positions[j], settings.joint.prior_sigma) for j in landmarks.tolist()]
        if self.motions is not None:
            after = self.motions.after
            made += [self.motion_factors[i] for i in np.flatnonzero((after >= begin) & (after < end)).tolist()]
        if keyframes.localized_every:
            on_plane = is_planar(keyframes.map_T_base)
            made += localizations(keyframes.take(np.arange(begin, end)), settings, begin, on_plane)
        elif begin == 0:
            made.append(anchor(0, keyframes.map_T_camera[0]))
        return made


def fixed_pose_factors(
    rays: Rays,
    origins: Floats,
    directions: Floats,
    landmark: Ints,
    distance: Floats,
    noise: tuple[Floats, float],
    loss: Loss,
) -> list[gtsam.NonlinearFactor]:
    """Return the factors of rays at fixed poses. The first n factors are for rays, and the others for measured ranges.

    With the loss `l1`, a factor is Eq. 1 of Staszak & Belter: the distance of the landmark from the ray. This loss uses no
    noise and no ranges. With it, noise of the directions draws a landmark towards the cameras, because the distance from a
    noisy ray is smaller near the origin of the ray. The other losses use the noise. Let x be the distance of the landmark
    from the ray, and s the standard deviation of x. At distance d from the origin, s^2 = (angle d)^2 + place^2. The residual
    is the angle of the landmark, seen from a point place^2 / (angle^2 d) behind the origin. Near distance d, the residual is
    proportional to x / s. If the landmark moves by 1 m along the line of sight, the residual and x / s both change by the
    share d angle^2 / s^2. With this residual, neither noise of directions nor noise of origins moves a landmark to one side.

    Args:
        origins, directions: (n, 3), (n, 3) the rays in map.
        landmark: (n,) the landmark of each ray. distance: (n,) m, the approximate distance of the landmark from the origin.
        noise: the standard deviations of directions (n,), rad, and of origins, m.
    """
    if loss == "l1":
        return point_to_line_fixed(origins, directions, landmark, robust(loss, np.ones(len(rays)), 2))
    angle, place = noise
    standoff = place**2 / (angle**2 * distance)
    sigma = np.hypot(angle * distance, place) / (distance + standoff)
    at = np.flatnonzero(np.isfinite(rays.range))
    along = along_ray(origins[at], directions[at], rays.range[at], rays.range_sigma[at], landmark[at])
    return bearings_fixed(origins, directions, standoff, landmark, robust(loss, sigma, 2)) + along
