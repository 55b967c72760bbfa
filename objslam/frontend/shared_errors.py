"""The measurements of a log with its shared errors taken out: the odometry's scale, clocks, and the cameras' rotations.

The parameters change what was measured, never the factors that a graph makes of it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from objslam.config import CalibrationSettings, Settings
from objslam.core.arrays import Floats
from objslam.core.calibration import MOST_SCALE, SCALES, Calibration, kind
from objslam.core.geometry import interpolate, inverse
from objslam.core.noise import NOMINAL, NoiseFactors
from objslam.core.types import Keyframes, Log, Rays, Trajectory
from objslam.frontend.corrected_log import corrected_mount, corrected_odometry, later, refocused, take_out, turns
from objslam.frontend.known_errors import error_names, estimates, known_errors, prior_sigma
from objslam.frontend.odometry_drift import gathered_drift, scaled_noise

_STEPS = {"clock": 0.1, "turn_bias": 1e-3, "yaw": 5e-3, "tilt": 5e-3, "roll": 5e-3}
"""The steps (in the parameter's unit) over which derivatives are taken. The clock's step is long, because velocities are
noisy and change abruptly. The clocks of the MRCLAM robots converge in half the rounds with 0.1 s instead of 0.01 s."""
_STEP = 0.01
"""The step of every other parameter, in its unit; the measurements are close to linear over it."""
_MOST_SIGMAS = 6.0
"""The largest absolute value of a parameter without a bound of its own, in standard deviations of its prior. A larger value
lets a parameter move farther from its prior."""


_KEPT = 8
"""The number of corrected paths that are kept; more take more memory, and a round of derivatives needs seven."""


@dataclass(frozen=True)
class SharedErrors:
    """The measurements of some keyframes of a log, as a function of its shared errors.

    keyframes, rays: as the log measured them. names: the P parameters. mean: (P,) and prior: (P, P), their expected
    values and covariance before the solve.
    """

    log: Log
    keyframes: Keyframes
    rays: Rays
    settings: Settings
    names: tuple[str, ...]
    mean: Floats
    prior: Floats
    noise: NoiseFactors = NOMINAL

    @property
    def unknown_noise(self) -> frozenset[str]:
        """The kinds of noise that are estimated: those that the settings do not tell, if there are such measurements."""
        of, default = self.settings, Settings()
        if of.mode != "joint" or self.keyframes.odom_T_base is None:
            return frozenset()
        ranged = bool(np.isfinite(self.rays.range).any())
        kinds = {
            "rays": (of.noise.rays, of.rays == default.rays, of.joint.factor == "bearing"),
            "ranges": (of.noise.ranges, of.depth == default.depth, ranged),
            "odometry": (of.noise.odometry, of.odometry == default.odometry, True),
        }
        return frozenset(k for k, (use, usual, there) in kinds.items() if there and (usual if use == "auto" else use))

    @cached_property
    def size_told(self) -> float:
        """From 0 to 1, how far ranges or absolute poses tell the size of the map, and not the odometry.

        Bearings leave the size to the odometry, so that any scale of it fits equally. What seems to tell the scale then is
        noise: a smaller map has less of it.
        """
        if self.keyframes.odom_T_base is None or self.keyframes.localized_every:
            return 1.0
        known, variance = np.isfinite(self.rays.range), dict(zip(self.names, np.diagonal(self.prior).tolist(), strict=True))
        information = float(np.sum((self.rays.range[known] / self.rays.range_sigma[known]) ** 2))
        odometry = variance.get("odometry.scale", CalibrationSettings().scale ** 2)
        return odometry / (odometry + variance.get("range_scale", 0.0) + 1 / max(information, 1e-12))

    def with_noise(self, noise: NoiseFactors) -> Self:
        """Return the same with other noise."""
        return replace(self, noise=noise)

    def with_unknown_noise(self) -> Self:
        """Return the same with all kinds of noise unknown, whatever the settings say."""
        noise = self.settings.noise.model_copy(update={"rays": True, "ranges": True, "odometry": True})
        return replace(self, settings=self.settings.model_copy(update={"noise": noise}))

    @property
    def steps(self) -> Floats:
        """(P,) steps over which derivatives are taken.

        Without odometry a clock is told by the path alone. Then its step is at least as long as two steps of the path. So
        the noise of the poses that make a residual is not in its derivative, where it would shift the clock.
        """
        steps = {**_STEPS}
        path = self.log.robot_path
        if self.keyframes.odom_T_base is None and path is not None and len(path) > 1:
            apart = 2 * float(np.median(np.diff(path.stamps)))
            steps["clock"] = float(
                np.clip(apart, _STEPS["clock"], max(_STEPS["clock"], self.settings.calibration.max_clock))
            )
        return np.array([steps.get(kind(name), _STEP) for name in self.names])

    @property
    def bounds(self) -> Floats:
        """(P,) the largest absolute values."""
        widest = np.abs(self.mean) + _MOST_SIGMAS * np.sqrt(np.diagonal(self.prior))
        kinds = np.array([kind(name) for name in self.names])
        clocks = np.maximum(self.settings.calibration.max_clock, np.abs(self.mean))
        widest = np.where(np.isin(kinds, SCALES), np.minimum(widest, MOST_SCALE), widest)
        return np.where(kinds == "clock", clocks, widest)

    def at(self, values: Floats, drift: bool = True) -> tuple[Keyframes, Rays, Settings]:
        """Return keyframes, rays and settings with the errors (P,) taken out.

        The noise of ways and ranges follows their scale. Otherwise a smaller map would fit better. Keyframes stay on their
        path: a stamp that leaves it takes the pose of the end, one in a gap the nearest pose.
        """
        error = dict(zip(self.names, values.tolist(), strict=True))
        keyframes, rays = self.keyframes, self.noise.rays_with_noise(self.rays)
        settings, max_gap = self._scaled_noise(error), self.settings.poses.max_gap
        path = self.log.robot_path
        assert path is not None
        stamps, base_T_camera, direction = keyframes.stamps.copy(), keyframes.base_T_camera.copy(), rays.direction
        known = stamps.copy()  # those of the poses, which end with the path
        for index, one in enumerate(self.log.cameras):
            mine = keyframes.camera == index
            clock = error.get(f"{one.camera.name}.clock", 0.0)
            known[mine] = np.clip(stamps[mine] + clock, path.stamps[0], path.stamps[-1])
            stamps[mine] = later(stamps[mine], clock, path)
            if one.mount is not None:
                base_T_camera[mine] = _at_stamps(one.mount, known[mine], max_gap)
            base_T_camera[mine] = corrected_mount(base_T_camera[mine], error, one.camera.name)
            direction = refocused(direction, mine[rays.keyframe], error.get(f"{one.camera.name}.focal", 0.0))
        odometry, localization = self._odometry(error), self.log.localization
        odom_T_base, gathered = keyframes.odom_T_base, keyframes.drift
        map_T_base = keyframes.map_T_base if localization is None else _at_stamps(localization, known, max_gap)
        if odometry is not None:
            at = _at_stamps(odometry, known, max_gap)
            map_T_base = at if localization is None else map_T_base
            if odom_T_base is not None:
                odom_T_base = inverse(odometry.poses[0]) @ at
                if drift:
                    # Different clocks may change the order of images, but drift never shrinks from one keyframe to the next.
                    gathered = gathered_drift(odometry, np.maximum.accumulate(known), settings.odometry)
        moved = replace(
            keyframes,
            stamps=stamps,
            base_T_camera=base_T_camera,
            map_T_base=map_T_base,
            odom_T_base=odom_T_base,
            drift=gathered,
        )
        longer = (1 + error.get("range_scale", 0.0)) * (1 + self.noise.shrinkage)
        ranged = replace(rays, direction=direction, range=rays.range * longer, range_sigma=rays.range_sigma * longer)
        return moved, ranged, settings

    def corrected_log(self, values: Floats) -> Log:
        """Return the log with the errors (P,) taken out of odometry, cameras and the stamps of frames."""
        return take_out(self.log, dict(zip(self.names, values.tolist(), strict=True)), stay=True)

    def drift_at_stamps(self, keyframes: Keyframes, values: Floats) -> Keyframes:
        """Return keyframes of `at`, with the drift at their own stamps.

        The clocks of several cameras can change the order of their frames. A graph keeps the order of the log, and needs
        a drift that grows in this order. What sorts keyframes by time needs a drift that grows with time.
        """
        error = dict(zip(self.names, values.tolist(), strict=True))
        odometry = self._odometry(error)
        if odometry is None or keyframes.drift is None:
            return keyframes
        return replace(keyframes, drift=gathered_drift(odometry, keyframes.stamps, self._scaled_noise(error).odometry))

    def with_prior(self, found: Calibration) -> Calibration:
        """Return what was found together with what was expected of these errors before."""
        return replace(found, prior_mean=self.mean, prior_covariance=self.prior)

    def take(self, keyframes: Keyframes, rays: Rays) -> Self:
        """Return the same errors for other keyframes and rays of the log."""
        return replace(self, keyframes=keyframes, rays=rays)

    @cached_property
    def _turns(self) -> Floats:
        """(N-1,) by how much the odometry turns in each step, rad."""
        assert self.log.odometry is not None
        return turns(self.log.odometry)

    def drift_components(self, values: Floats) -> list[tuple[Keyframes, Settings]]:
        """Return keyframes and settings whose odometry has nominal noise only along, only across, only in turning, or none.

        The last ones have the noise that is not the odometry's. values: (P,) the errors taken out.
        """
        error = dict(zip(self.names, values.tolist(), strict=True))
        odometry = self._odometry(error)
        assert odometry is not None
        keyframes, _, _ = self.at(values, drift=False)
        stamps, none = np.maximum.accumulate(keyframes.stamps), {"along": 0.0, "across": 0.0, "turning": 0.0}
        found = []
        for only in (*none, None):
            noise = NoiseFactors(**none) if only is None else NoiseFactors(**{**none, only: 1.0})
            settings = self.with_noise(noise)._scaled_noise(error)
            if only is not None:
                flat = settings.planar.model_copy(update={"z": 0.0, "tilt": 0.0})
                settings = settings.model_copy(update={"planar": flat})
            found.append((replace(keyframes, drift=gathered_drift(odometry, stamps, settings.odometry)), settings))
        return found

    def _scaled_noise(self, error: Mapping[str, float]) -> Settings:
        """The settings with the estimated noise, scaled as the ways are."""
        return scaled_noise(self.noise.settings(self.settings), error)

    @cached_property
    def _corrected(self) -> dict[tuple[float, ...], Trajectory]:
        """The last corrected odometry by its errors: most derivatives leave it as it is, and 60,000 poses take 30 ms."""
        return {}

    def _odometry(self, error: dict[str, float]) -> Trajectory | None:
        """The odometry without its errors, with ways that make up for the shrinkage of the map, as the ranges do."""
        odometry = self.log.odometry
        if odometry is None:
            return None
        stretched = (1 + error.get("odometry.scale", 0.0)) * (1 + self.noise.shrinkage) - 1
        key = (stretched, *(error.get(f"odometry.{name}", 0.0) for name in ("turn_scale", "turn_bias")))
        if key not in self._corrected:
            if len(self._corrected) >= _KEPT:
                self._corrected.pop(next(iter(self._corrected)))
            self._corrected[key] = corrected_odometry(odometry, self._turns, {**error, "odometry.scale": stretched})
        return self._corrected[key]


def shared_errors(log: Log, keyframes: Keyframes, rays: Rays, settings: Settings) -> SharedErrors | None:
    """Return the errors that are estimated from a log by the settings, None if there are none.

    keyframes, rays: those that are solved. An error is a parameter if its prior is not 0 and something was measured with it.
    """
    names: tuple[str, ...] = ()
    if estimates(settings, keyframes.odom_T_base is not None, keyframes.localized_every > 0):
        cameras = {one.camera.name: (keyframes.camera == index).any() for index, one in enumerate(log.cameras)}
        measured = {
            **cameras,
            "odometry": keyframes.odom_T_base is not None,
            "": np.isfinite(rays.range).any(),  # range_scale belongs to no part
        }
        names = tuple(n for n in error_names(log) if measured[n.rpartition(".")[0]] and prior_sigma(n, settings) > 0)
    mean = np.zeros(len(names))
    prior = np.diag([prior_sigma(name, settings) ** 2 for name in names]).reshape(len(names), len(names))
    known = known_errors(settings) if names else None
    if known is not None:
        here, there = np.array([(names.index(n), i) for i, n in enumerate(known.names) if n in names], int).reshape(-1, 2).T
        mean[here], prior[np.ix_(here, here)] = known.values[there], known.covariance[np.ix_(there, there)]
    errors = SharedErrors(log, keyframes, rays, settings, names, mean, prior)
    return errors if names or errors.unknown_noise else None


def _at_stamps(path: Trajectory, stamps: Floats, max_gap: float) -> Floats:
    """Poses (Q, 4, 4) of a path at stamps (Q,). A stamp beyond an end of the path, or in a gap, takes the nearest pose."""
    known = np.clip(stamps, path.stamps[0], path.stamps[-1])
    index = np.clip(np.searchsorted(path.stamps, known), 1, max(len(path) - 1, 1))
    before, after = path.stamps[index - 1], path.stamps[np.minimum(index, len(path) - 1)]
    nearest = np.where(known - before < after - known, before, after)
    return interpolate(path.stamps, path.poses, np.where(after - before > max_gap, nearest, known), np.inf)[0]
