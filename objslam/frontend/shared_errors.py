"""The measurements of a log, corrected by its shared errors, such as the odometry's scale, clocks and cameras' rotations."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.calibration import MOST_SCALE, SCALES, Calibration, kind
from objslam.core.geometry import inverse
from objslam.core.noise import NOMINAL, NoiseFactors
from objslam.core.trajectory import Trajectory, poses_near
from objslam.core.types import Keyframes, Log, Rays
from objslam.frontend.corrected_log import corrected_mount, inverse_lens, later, lens_errors, refocused, take_out
from objslam.frontend.corrected_odometry import ODOMETRY, CorrectablePath
from objslam.frontend.corrected_rays import corrected_poses, corrected_rays
from objslam.frontend.localization.measured_poses import carried_variance
from objslam.frontend.odometry_drift import DriftPath, scaled_noise
from objslam.frontend.recent_values import RecentValues
from objslam.frontend.surface_ranges import (
    corrected_lengths,
    half_widths_of_rays,
    measured_ranges,
    range_factors,
    weights_of,
)
from objslam.frontend.unknown_noise import unknown_noise

_STEPS = {"clock": 0.1, "turn_bias": 1e-3, "turn_per_m": 5e-3, "yaw": 5e-3, "tilt": 5e-3, "roll": 5e-3}
"""The steps (in the parameter's unit) over which derivatives are taken. The clock's step is long, because velocities are
noisy and change abruptly. The clocks of the MRCLAM robots converge in half the rounds with 0.1 s instead of 0.01 s."""
_STEP = 0.01
"""The step of each parameter that is not in `_STEPS`, in its unit. The measurements are nearly linear over this step."""
_MOST_SIGMAS = 6.0
"""A parameter's bound is the absolute value of its prior mean plus this number of standard deviations of its prior.
MOST_SCALE is a second bound of scales. Clocks have their own bound. With a larger value, a parameter may move farther from
its prior."""
_LEAST = 0.1
"""The least measured range, as a share of the corrected range. With a larger share, more of the shortest ranges become
longer than asked. The limit is never reached for things that are farther away than the offset of ranges."""
_KEPT = 9
"""The number of values of the errors for which the poses of the keyframes are kept. A larger number takes more memory. A
round of derivatives needs seven."""


@dataclass(frozen=True)
class SharedErrors:
    """The measurements of some keyframes of a log, as a function of its shared errors.

    keyframes, rays: as the log measured them. names: the P parameters. mean: (P,) and prior: (P, P), their expected
    values and covariance before the solve. noise: the factors on the nominal noise. sized_tags: whether rays are to
    fiducials whose size is given.
    """

    log: Log
    keyframes: Keyframes
    rays: Rays
    settings: Settings
    names: tuple[str, ...]
    mean: Floats
    prior: Floats
    noise: NoiseFactors = NOMINAL
    sized_tags: bool = False
    _path: list[CorrectablePath] = field(default_factory=list, repr=False, compare=False)  # Copies share this list.

    @property
    def unknown_noise(self) -> frozenset[str]:
        """The kinds of noise that are estimated, as the function `unknown_noise` returns them."""
        return unknown_noise(self.settings, self.log, self.keyframes, self.rays)

    @cached_property
    def unknown_scales(self) -> frozenset[str]:
        """The names of the scales, if every measured length has an unknown scale, else an empty set.

        With unknown scales alone, the log does not determine the size of its map.
        """
        if self.keyframes.odom_T_base is None or self.keyframes.localized_every:
            return frozenset()
        lengths = {"range_scale": np.isfinite(self.rays.range).any(), "tag_scale": self.sized_tags}
        scales = {"odometry.scale"} | {name for name, measured in lengths.items() if measured}
        return frozenset(scales) if scales <= set(self.names) else frozenset()

    @property
    def cameras(self) -> tuple[str, ...]:
        """The names of the cameras, in the order of `Keyframes.camera`."""
        return tuple(one.camera.name for one in self.log.cameras)

    @property
    def odometry_stamps(self) -> Floats:
        """(n,) s, the stamps of the odometry, empty without odometry."""
        return np.zeros(0) if self.log.odometry is None else self.log.odometry.stamps

    def with_noise(self, noise: NoiseFactors) -> Self:
        """Return the same measurements with other noise. Both share the kept poses, which do not depend on the noise."""
        return self._sharing_poses(replace(self, noise=noise))

    def with_rays(self, directions: Floats, ranges: Floats, values: Floats) -> Self:
        """Return the same measurements with other rays. At values (P,), `at` then returns these unit directions (R, 3) and
        ranges (R,), m.

        Both share the kept poses, which do not depend on the rays. If an offset would make a measured range 0 or less, the
        measured range stays positive (`_LEAST`). In this case, `at` returns a longer range than asked.
        """
        error = dict(zip(self.names, values.tolist(), strict=True))
        lens, factors = self._lens(error), range_factors(error, self._half) * (1 + self.noise.shrinkage)
        if lens.any():
            back = np.array([inverse_lens((focal, cx, cy)) for focal, cx, cy in lens.tolist()])
            directions, _ = refocused(directions, back[self.keyframes.camera[self.rays.keyframe]])
        measured = np.maximum(measured_ranges(error, ranges, directions, factors), _LEAST * ranges)
        other = self._sharing_poses(replace(self, rays=replace(self.rays, direction=directions, range=measured)))
        vars(other).update(_half=self._half)
        return other

    def with_paths_of(self, other: Self) -> Self:
        """Return the same errors, which now share the corrected paths of `other` if both have the same odometry."""
        if self.log.odometry is not other.log.odometry:
            return self
        found = replace(self, _path=other._path)
        same = self.log is other.log and self.keyframes is other.keyframes and self.settings.poses == other.settings.poses
        return other._sharing_poses(found) if same else found

    def with_unknown_noise(self) -> Self:
        """Return the same measurements with all kinds of noise unknown, whatever the settings say."""
        noise = self.settings.noise.model_copy(update={"rays": True, "ranges": True, "odometry": True})
        return replace(self, settings=self.settings.model_copy(update={"noise": noise}))

    @cached_property
    def _half(self) -> Floats:
        half = half_widths_of_rays(self.rays, self.keyframes, [one.camera for one in self.log.cameras])
        return half * weights_of(self.rays)

    @cached_property
    def steps(self) -> Floats:
        """(P,) steps over which derivatives are taken.

        If odometry is not used, only the localised path reveals the offset of a clock. Then the clock's step is at least as
        long as two steps of the path, up to calibration.max_clock. So the noise of single poses does not bias the offset.
        """
        steps = {**_STEPS}
        path = self.log.robot_path
        if self.keyframes.odom_T_base is None and path is not None and len(path) > 1:
            apart = 2 * float(np.median(np.diff(path.stamps)))
            longest = max(_STEPS["clock"], self.settings.calibration.max_clock)
            steps["clock"] = float(np.clip(apart, _STEPS["clock"], longest))
        return np.array([steps.get(kind(name), _STEP) for name in self.names])

    @cached_property
    def bounds(self) -> Floats:
        """(P,) the largest absolute values of the parameters, in their units."""
        widest = np.abs(self.mean) + _MOST_SIGMAS * np.sqrt(np.diagonal(self.prior))
        kinds = np.array([kind(name) for name in self.names])
        clocks = np.maximum(self.settings.calibration.max_clock, np.abs(self.mean))
        widest = np.where(np.isin(kinds, SCALES), np.minimum(widest, MOST_SCALE), widest)
        return np.where(kinds == "clock", clocks, widest)

    def at(self, values: Floats, drift: bool = True) -> tuple[Keyframes, Rays, Settings]:
        """Return keyframes, rays and settings corrected by the errors (P,).

        The noise of distances and ranges grows with their scale. Otherwise a smaller map would fit better. The noise of
        directions follows the lens for the same reason: with a longer focal length, all angles are smaller. Keyframes stay
        on their path. A stamp beyond an end of the path takes the pose of that end, and a stamp in a gap takes the nearest
        pose. drift: whether the drift is computed for the corrected odometry. If not, the drift and the variance of the
        interpolated path stay as measured.
        """
        error = dict(zip(self.names, values.tolist(), strict=True))
        keyframes, rays = self.keyframes, self.noise.rays_with_noise(self.rays)
        settings, poses = self._scaled_noise(error), self._poses(error)
        base_T_camera, direction, sigma = poses.base_T_camera.copy(), rays.direction, rays.sigma
        lens = self._lens(error)
        if lens.any():
            direction, factors = refocused(direction, lens[keyframes.camera[rays.keyframe]])
            sigma = sigma * factors
        for index, one in enumerate(self.log.cameras):
            mine = keyframes.camera == index
            mounts = base_T_camera[mine] if one.mount is not None else base_T_camera[mine][:1]
            base_T_camera[mine] = corrected_mount(mounts, error, one.camera.name)
        gathered, step, wander = keyframes.drift, keyframes.step, keyframes.wander
        if drift and self.log.odometry is not None and keyframes.odom_T_base is not None:
            # Different clocks may change the order of images, but drift must not shrink from one keyframe to the next.
            gathered = self._drift(error).gathered(np.maximum.accumulate(poses.known), settings.odometry)
            step, wander = self._correctable().bridge.at(poses.known)
            if keyframes.localized_at is not None and poses.odom_T_base is not None:
                measured = self._drift(error).gathered(keyframes.localized_at, settings.odometry)
                keyframes = replace(keyframes, carried=carried_variance(poses.odom_T_base, gathered, measured))
        stamps, map_T_base, odom_T_base = poses.stamps, poses.map_T_base, poses.odom_T_base
        moved = replace(
            keyframes, stamps=stamps, map_T_base=map_T_base, odom_T_base=odom_T_base, base_T_camera=base_T_camera
        )
        # The given stamps decide which keyframes count as localised, so that the graph is the same for all values.
        moved = replace(moved, drift=gathered, step=step, wander=wander, given_stamps=keyframes.frame_stamps)
        reach, spread, bias = corrected_lengths(error, rays, self._half, 1 + self.noise.shrinkage)
        ranged = replace(rays, direction=direction, sigma=sigma, range=reach, range_sigma=spread, range_bias=bias)
        tags = settings.tags.scaled(1 + error.get("tag_scale", 0.0))
        if self.settings.mode == "joint":
            noise = self.noise
            moved = replace(moved, pose_noise=(noise.heading, noise.place), lasting=noise.lasting)
            moved = replace(moved, driven=self.keyframes.way)
        return moved, ranged, settings if tags is settings.tags else settings.model_copy(update={"tags": tags})

    def rays_in_map(self, values: Floats) -> tuple[Floats, Floats, Floats]:
        """Return origins (M, R, 3), m, and unit directions (M, R, 3) in map, and noise (M, R), rad, of the rays of `at`.

        values: (M, P) the errors. Values with the same clocks and the same odometry share their poses.
        """
        errors = [dict(zip(self.names, row, strict=True)) for row in values.tolist()]
        keys = [self._poses_key(error) for error in errors]
        distinct = dict(zip(keys, errors, strict=True))
        which = [{key: number for number, key in enumerate(distinct)}[key] for key in keys]
        max_gap = self.settings.poses.max_gap
        at = corrected_poses(self.log, self.keyframes, list(distinct.values()), self._odometry_at, max_gap)
        _, map_T_base, base_T_camera = at
        rays = self.noise.rays_with_noise(self.rays)
        return corrected_rays(map_T_base[which], base_T_camera[which], self.keyframes.camera, rays, self.cameras, errors)

    def corrected_log(self, values: Floats) -> Log:
        """Return the log corrected by the errors (P,): odometry, cameras and the stamps of frames."""
        return take_out(self.log, dict(zip(self.names, values.tolist(), strict=True)), stay=True)

    def drift_at_stamps(self, keyframes: Keyframes, values: Floats) -> Keyframes:
        """Return keyframes that `at` returned, with the drift at their own stamps.

        The clocks of several cameras can change the order of their frames. A graph keeps the order of the log, and needs
        a drift that grows in this order. Code that sorts keyframes by time needs a drift that grows with time.
        """
        error = dict(zip(self.names, values.tolist(), strict=True))
        if self.log.odometry is None or keyframes.drift is None:
            return keyframes
        drift = self._drift(error).gathered(keyframes.stamps, self._scaled_noise(error).odometry)
        return replace(keyframes, drift=drift)

    def with_prior(self, found: Calibration) -> Calibration:
        """Return the calibration `found` with the prior from before the solve."""
        return replace(found, prior_mean=self.mean, prior_covariance=self.prior)

    def take(self, keyframes: Keyframes, rays: Rays) -> Self:
        """Return the same errors for other keyframes and rays of the log."""
        other = replace(self, keyframes=keyframes, rays=rays)
        return self._sharing_poses(other) if keyframes is self.keyframes else other

    def drift_components(self, values: Floats) -> list[tuple[Keyframes, Settings]]:
        """Return four pairs of keyframes and settings, each with one component of the noise of motions.

        The components are odometry noise along the path, across it and in turning, all nominal, and the noise of `planar` in
        the settings. values: (P,) the corrected errors.
        """
        error = dict(zip(self.names, values.tolist(), strict=True))
        path = self._drift(error)
        keyframes, _, _ = self.at(values, drift=False)
        stamps, found = np.maximum.accumulate(keyframes.stamps), []
        for only in ("along", "across", "turning", None):
            noise = NoiseFactors(along=only == "along", across=only == "across", turning=only == "turning")
            settings = self.with_noise(noise)._scaled_noise(error)
            if only is not None:
                flat = settings.planar.model_copy(update={"z": 0.0, "tilt": 0.0})
                settings = settings.model_copy(update={"planar": flat})
            found.append((replace(keyframes, drift=path.gathered(stamps, settings.odometry)), settings))
        return found

    def _sharing_poses(self, other: Self) -> Self:
        """Return errors `other` of the same keyframes, which now share the kept poses of this object."""
        vars(other).update(_kept_poses=self._kept_poses, _kept_drift=self._kept_drift)
        return other

    def _lens(self, error: Mapping[str, float]) -> Floats:
        """The errors (C, 3) of the lenses of the cameras, as `lens_errors`."""
        return np.array([lens_errors(error, name) for name in self.cameras])

    def _scaled_noise(self, error: Mapping[str, float]) -> Settings:
        """The settings with the estimated noise. The odometry noise is scaled like the odometry's distances."""
        return scaled_noise(self.noise.settings(self.settings), error)

    def _poses(self, error: Mapping[str, float]) -> "_Poses":
        """The poses of the keyframes. Rotations of cameras and scales of ranges do not change the poses, so the poses are
        kept."""
        return self._kept_poses.get(self._poses_key(error), lambda: self._computed_poses(error))

    def _poses_key(self, error: Mapping[str, float]) -> tuple[float, ...]:
        return *self._odometry_key(error), *(error.get(f"{one.camera.name}.clock", 0.0) for one in self.log.cameras)

    def _computed_poses(self, error: Mapping[str, float]) -> "_Poses":
        keyframes, path = self.keyframes, self.log.robot_path
        (known,), (map_T_base,), (base_T_camera,) = corrected_poses(
            self.log, keyframes, [error], self._odometry_at, self.settings.poses.max_gap
        )
        stamps, odom_T_base = keyframes.stamps.copy(), keyframes.odom_T_base
        for index, one in enumerate(self.log.cameras):
            mine = keyframes.camera == index
            stamps[mine] = later(stamps[mine], error.get(f"{one.camera.name}.clock", 0.0), path)
        if self.log.odometry is not None and odom_T_base is not None:
            at = map_T_base if self.log.localization is None else self._odometry_at(error, known)
            odom_T_base = inverse(self.log.odometry.poses[0]) @ at
        return _Poses(stamps, known, base_T_camera, map_T_base, odom_T_base)

    @cached_property
    def _kept_poses(self) -> RecentValues["_Poses"]:
        return RecentValues(_KEPT)

    @cached_property
    def _kept_drift(self) -> RecentValues[DriftPath]:
        return RecentValues(1)

    def _odometry_at(self, error: Mapping[str, float], stamps: Floats) -> Floats:
        """Poses (Q, 4, 4) of the corrected odometry at stamps (Q,), s. Only the poses around the stamps are computed."""
        odometry = self._correctable().odometry
        after = np.clip(np.searchsorted(odometry.stamps, stamps), 1, max(len(odometry) - 1, 1))
        needed = np.zeros(len(odometry), dtype=bool)
        needed[after - 1] = needed[np.minimum(after, len(odometry) - 1)] = True
        around = np.flatnonzero(needed)
        path = Trajectory(odometry.stamps[around], self._correctable().poses(self._of_odometry(error), around))
        return poses_near(path, stamps, self.settings.poses.max_gap)

    def _of_odometry(self, error: Mapping[str, float]) -> dict[str, float]:
        """The errors of the odometry by name. Their scale also corrects the distances for the shrinkage of the map."""
        return dict(zip(ODOMETRY, self._odometry_key(error), strict=True))

    def _correctable(self) -> CorrectablePath:
        odometry = self.log.odometry
        assert odometry is not None
        if not self._path or self._path[0].odometry is not odometry:
            self._path[:] = [CorrectablePath(odometry)]
        return self._path[0]

    def _drift(self, error: Mapping[str, float]) -> DriftPath:
        """The steps of the corrected odometry, which give its drift."""
        return self._kept_drift.get(self._odometry_key(error), lambda: self._correctable().drift(self._of_odometry(error)))

    def _odometry_key(self, error: Mapping[str, float]) -> tuple[float, ...]:
        """The key of a kept path: the errors of the odometry. Their scale also corrects the shrinkage of the map."""
        scale, *others = (error.get(name, 0.0) for name in ODOMETRY)
        return (1 + scale) * (1 + self.noise.shrinkage) - 1, *others


@dataclass(frozen=True)
class _Poses:
    """The poses (K, 4, 4) of K keyframes, corrected for the errors of clocks and odometry.

    stamps: (K,) s, of the images. known: (K,) s, at which the poses are taken, all within the time of the path.
    base_T_camera: not yet corrected for the errors of the cameras' rotations and places.
    """

    stamps: Floats
    known: Floats
    base_T_camera: Floats
    map_T_base: Floats
    odom_T_base: Floats | None
