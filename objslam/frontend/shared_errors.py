"""The measurements of a log with its shared errors taken out: the odometry's scale, clocks, and the cameras' rotations.

The parameters change what was measured, never the factors that a graph makes of it.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.calibration import kind
from objslam.core.camera import Camera
from objslam.core.geometry import interpolate, inverse, make_pose
from objslam.core.types import CameraLog, Images, Keyframes, Log, Rays, Trajectory
from objslam.frontend.odometry_drift import gathered_drift
from objslam.io.calibration_yaml import load_calibration

_STEPS = {"clock": 0.1, "turn_bias": 1e-3, "yaw": 5e-3, "tilt": 5e-3, "roll": 5e-3}
"""The steps (in the parameter's unit) over which derivatives are taken. The clock's step is long, because velocities are
noisy and change abruptly. The clocks of the MRCLAM robots converge in half the rounds with 0.1 s instead of 0.01 s."""
_STEP = 0.01
"""The step of every other parameter, in its unit; the measurements are close to linear over it."""
_MOST_SIGMAS = 6.0
"""The largest absolute value of a parameter without a bound of its own, in standard deviations of its prior."""
_AXES = ("roll", "tilt", "yaw")


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

    @property
    def steps(self) -> Floats:
        """(P,) steps over which derivatives are taken."""
        return np.array([_STEPS.get(kind(name), _STEP) for name in self.names])

    @property
    def bounds(self) -> Floats:
        """(P,) the largest absolute values."""
        clock = self.settings.calibration.max_clock
        widest = np.abs(self.mean) + _MOST_SIGMAS * np.sqrt(np.diagonal(self.prior))
        return np.array([clock if kind(n) == "clock" else w for n, w in zip(self.names, widest.tolist(), strict=True)])

    def at(self, values: Floats, drift: bool = True) -> tuple[Keyframes, Rays, Settings]:
        """Return keyframes, rays and settings with the errors (P,) taken out.

        The noise of what is scaled is scaled with it. Otherwise a smaller world would fit the odometry better.
        Keyframes stay on their path: a stamp that leaves it takes the nearest pose of the path.
        """
        error = dict(zip(self.names, values.tolist(), strict=True))
        keyframes, rays, max_gap = self.keyframes, self.rays, self.settings.poses.max_gap
        path = self.log.localization or self.log.odometry
        assert path is not None
        stamps, base_T_camera, direction = keyframes.stamps.copy(), keyframes.base_T_camera.copy(), rays.direction
        for index, one in enumerate(self.log.cameras):
            mine = keyframes.camera == index
            stamps[mine] = np.clip(
                stamps[mine] + error.get(f"{one.camera.name}.clock", 0.0), path.stamps[0], path.stamps[-1]
            )
            if one.mount is not None:
                base_T_camera[mine] = _at_stamps(one.mount, stamps[mine], max_gap)
            base_T_camera[mine] = _corrected_mount(base_T_camera[mine], error, one.camera.name)
            direction = _refocused(direction, mine[rays.keyframe], error.get(f"{one.camera.name}.focal", 0.0))
        odometry, localization = self._odometry(error), self.log.localization
        odom_T_base, gathered = keyframes.odom_T_base, keyframes.drift
        settings = _scaled_noise(self.settings, error)
        map_T_base = keyframes.map_T_base if localization is None else _at_stamps(localization, stamps, max_gap)
        if odometry is not None:
            at = _at_stamps(odometry, stamps, max_gap)
            map_T_base = at if localization is None else map_T_base
            if odom_T_base is not None:
                odom_T_base = inverse(odometry.poses[0]) @ at
                if drift:
                    # Different clocks may change the order of images, but drift never shrinks from one keyframe to the next.
                    gathered = gathered_drift(odometry, np.maximum.accumulate(stamps), settings.odometry)
        moved = replace(
            keyframes,
            stamps=stamps,
            base_T_camera=base_T_camera,
            map_T_base=map_T_base,
            odom_T_base=odom_T_base,
            drift=gathered,
        )
        longer = 1 + error.get("range_scale", 0.0)
        ranged = replace(rays, direction=direction, range=rays.range * longer, range_sigma=rays.range_sigma * longer)
        return moved, ranged, settings

    def corrected_log(self, values: Floats) -> Log:
        """Return the log with the errors (P,) taken out of odometry, cameras and the stamps of frames."""
        error = dict(zip(self.names, values.tolist(), strict=True))
        cameras = tuple(_corrected_camera(one, error) for one in self.log.cameras)
        return replace(self.log, odometry=self._odometry(error), cameras=cameras)

    def take(self, keyframes: Keyframes, rays: Rays) -> Self:
        """Return the same errors for other keyframes and rays of the log."""
        return replace(self, keyframes=keyframes, rays=rays)

    @cached_property
    def _turns(self) -> Floats:
        """(N-1,) by how much the odometry turns about the vertical axis in each step, rad."""
        assert self.log.odometry is not None
        rotation = self.log.odometry.poses[:, :3, :3]
        return np.asarray(Rotation.from_matrix(rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2)).as_rotvec()[:, 2])

    def _odometry(self, error: dict[str, float]) -> Trajectory | None:
        """The odometry with its ways and turns corrected; its first pose stays."""
        scale, turn_scale, turn_bias = (error.get(f"odometry.{name}", 0.0) for name in ("scale", "turn_scale", "turn_bias"))
        odometry = self.log.odometry
        if odometry is None or scale == turn_scale == turn_bias == 0:
            return odometry
        more = np.append(0.0, np.cumsum(turn_scale * self._turns + turn_bias * np.diff(odometry.stamps)))
        ways = (1 + scale) * np.diff(odometry.poses[:, :3, 3], axis=0)
        middle = (more[1:] + more[:-1]) / 2  # a scaled arc begins and ends at other headings, its chord lies between them
        cos, sin = np.cos(middle), np.sin(middle)
        x, y, z = ways.T
        ways = np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1)
        turned = Rotation.from_rotvec(np.outer(more, [0.0, 0.0, 1.0])).as_matrix() @ odometry.poses[:, :3, :3]
        places = odometry.poses[0, :3, 3] + np.vstack([np.zeros(3), np.cumsum(ways, axis=0)])
        return Trajectory(odometry.stamps, make_pose(turned, places))


def shared_errors(log: Log, keyframes: Keyframes, rays: Rays, settings: Settings) -> SharedErrors | None:
    """Return the errors that are estimated from a log by the settings, None if there are none.

    keyframes, rays: those that are solved. An error is a parameter if its prior is not 0 and something was measured with it.
    """
    of = settings.calibration
    auto = settings.mode == "joint" and keyframes.odom_T_base is not None
    if not (auto if of.use == "auto" else of.use):
        return None
    sigmas: dict[str, float] = {}
    if keyframes.odom_T_base is not None:
        sigmas |= {f"odometry.{name}": getattr(of, name) for name in ("scale", "turn_scale", "turn_bias")}
    for index, one in enumerate(log.cameras):
        if (keyframes.camera == index).any():
            sigmas |= {f"{one.camera.name}.{name}": getattr(of, name) for name in ("clock", *_AXES, "focal")}
            sigmas |= {f"{one.camera.name}.{axis}": of.translation for axis in "xyz"}
    if np.isfinite(rays.range).any():
        sigmas["range_scale"] = of.range_scale
    known = None if of.file is None else load_calibration(Path(of.file))
    names = tuple(name for name, sigma in sigmas.items() if sigma > 0)
    if not names:
        return None
    mean, prior = np.zeros(len(names)), np.diag([sigmas[name] ** 2 for name in names])
    if known is not None:
        here, there = np.array([(names.index(n), i) for i, n in enumerate(known.names) if n in names], int).reshape(-1, 2).T
        mean[here], prior[np.ix_(here, here)] = known.values[there], known.covariance[np.ix_(there, there)]
    return SharedErrors(log, keyframes, rays, settings, names, mean, prior)


def _scaled_noise(settings: Settings, error: dict[str, float]) -> Settings:
    """The settings whose odometry noise is (1 + scale) times as large in metres and (1 + turn_scale) times in radians.

    The noise grows with the root of the way and of the turn, which are scaled themselves.
    """
    way, turn = 1 + error.get("odometry.scale", 0.0), 1 + error.get("odometry.turn_scale", 0.0)
    if way == turn == 1:
        return settings
    of = settings.odometry
    scaled = of.model_copy(
        update={
            "x_per_m": of.x_per_m * np.sqrt(way),
            "y_per_m": of.y_per_m * np.sqrt(way),
            "xy_per_rad": of.xy_per_rad * way / np.sqrt(turn),
            "yaw_per_m": of.yaw_per_m * turn / np.sqrt(way),
            "yaw_per_rad": of.yaw_per_rad * np.sqrt(turn),
            "floor_xy": of.floor_xy * way,
            "floor_yaw": of.floor_yaw * turn,
        }
    )
    return settings.model_copy(update={"odometry": scaled})


def _corrected_mount(base_T_camera: Floats, error: dict[str, float], name: str) -> Floats:
    """Camera poses on the base (..., 4, 4), turned about the axes of base and moved along them."""
    turn = Rotation.from_rotvec([error.get(f"{name}.{axis}", 0.0) for axis in _AXES]).as_matrix()
    move = np.array([error.get(f"{name}.{axis}", 0.0) for axis in "xyz"])
    return make_pose(turn @ base_T_camera[..., :3, :3], base_T_camera[..., :3, 3] + move)


def _refocused(directions: Floats, mine: Bools, focal: float) -> Floats:
    """Unit directions (R, 3), those of `mine` (R,) as a camera with a focal length that is longer by a share sees them."""
    if focal == 0:
        return directions
    longer = np.where(mine[:, None], directions * [1.0, 1.0, 1 + focal], directions)
    return np.asarray(longer / np.linalg.norm(longer, axis=1, keepdims=True))


def _corrected_camera(one: CameraLog, error: dict[str, float]) -> CameraLog:
    camera, name = one.camera, one.camera.name
    clock, focal = error.get(f"{name}.clock", 0.0), 1 + error.get(f"{name}.focal", 0.0)
    matrix = camera.matrix * np.array([[focal, 1, 1], [1, focal, 1], [1, 1, 1]])
    corrected: Camera = replace(camera, base_T_camera=_corrected_mount(camera.base_T_camera, error, name), matrix=matrix)

    def later(images: Images | None) -> Images | None:
        return None if images is None else replace(images, stamps=images.stamps + clock)

    found = one.detections
    return CameraLog(
        camera=corrected,
        detections=None if found is None else replace(found, frame_stamps=found.frame_stamps + clock),
        rgb=later(one.rgb),
        depth=later(one.depth),
        mount=None if one.mount is None else Trajectory(one.mount.stamps, _corrected_mount(one.mount.poses, error, name)),
    )


def _at_stamps(path: Trajectory, stamps: Floats, max_gap: float) -> Floats:
    """Poses (Q, 4, 4) of a path at stamps (Q,). A stamp beyond an end of the path, or in a gap, takes the nearest pose."""
    known = np.clip(stamps, path.stamps[0], path.stamps[-1])
    index = np.clip(np.searchsorted(path.stamps, known), 1, max(len(path) - 1, 1))
    before, after = path.stamps[index - 1], path.stamps[np.minimum(index, len(path) - 1)]
    nearest = np.where(known - before < after - known, before, after)
    return interpolate(path.stamps, path.poses, np.where(after - before > max_gap, nearest, known), np.inf)[0]
