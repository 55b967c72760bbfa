"""The prediction of the camera pose of a frame, with its uncertainty, before association."""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import adjoint, inverse
from objslam.graph.factors import odometry
from objslam.live.mapper.course import Placed
from objslam.live.mapper.pose_uncertainty import PoseUncertainty
from objslam.live.mapper.state import MapState

_ASK = 10
"""The number of keyframes after which the covariance of the pose is read from the graph again. This read is slow. Between
two reads, odometry noise is added, so the covariance is too large, and larger with a larger number."""


@dataclass(frozen=True)
class PosePrediction:
    """The predicted camera pose (4, 4) of a frame in map, and its uncertainty.

    camera_T_start: (4, 4) start of the course in the camera frame. motion: the id of the previous keyframe, the motion (4,
    4) from its camera to the new camera, and the covariance (6, 6) of this motion in the new camera frame. motion is None
    without a previous keyframe, or if the pose is from localisation.
    """

    map_T_camera: Floats
    camera_T_start: Floats
    uncertainty: PoseUncertainty
    motion: tuple[int, Floats, Floats] | None


class PosePredictor:
    """Predicts camera poses from the map and the course, and caches covariances that are slow to compute."""

    def __init__(self, state: MapState) -> None:
        self._state = state
        self._covariances: dict[int, Floats] = {}
        self._floor: tuple[Floats | None, bool, Floats] = (None, True, np.zeros((6, 6)))

    def predict(
        self, before: int | None, stamp: float, placed: Placed, base_T_camera: Floats, start_T_camera: Floats
    ) -> PosePrediction:
        """Predict the camera pose of a frame at a stamp, s. before: the row of the previous keyframe, or None without one.

        base_T_camera: (4, 4) camera pose on the robot. start_T_camera: (4, 4) camera pose on the course.
        """
        m, k = self._state, self._state.keyframes
        camera_T_start = inverse(start_T_camera)
        camera_from_drift = adjoint(camera_T_start)
        if before is None:
            certain = PoseUncertainty(placed.drift, camera_from_drift, np.zeros((6, 6)))
            return PosePrediction(placed.map_T_base @ base_T_camera, camera_T_start, certain, None)
        held = k.localized.any()
        measured = placed.by_odometry and (k.piece[before] == placed.piece or not held)
        noise, found = m.settings.localization, m.localization.noise
        variance = np.diag([noise.yaw * found.heading] * 3 + [noise.xy * found.place] * 3) ** 2
        there = m.course.localization.at(stamp) if held and not measured else None
        if there is not None:
            localized = PoseUncertainty(placed.drift, camera_from_drift, variance)
            return PosePrediction(there.pose @ base_T_camera, camera_T_start, localized, None)
        motion = k.camera_T_start[before] @ start_T_camera
        if measured:
            floor = self._motion_floor(base_T_camera)
            covariance = odometry.motion_covariance(placed.drift - k.drift[before], camera_from_drift, floor)
        else:
            covariance = odometry.unknown_motion(base_T_camera, m.settings, m.course.odometry.planar)
        number = int(k.id[before])
        back = adjoint(camera_T_start @ k.start_T_base[before] @ k.base_T_camera[before])
        pose = back @ self.covariance_of(number) @ back.T + covariance
        uncertainty, map_T_camera = PoseUncertainty(placed.drift, camera_from_drift, pose), m.graph.pose(number) @ motion
        # If the robot drove far without keyframes, the localisation beats the odometry since the last keyframe.
        if held and not uncertainty.is_placed and (near := m.course.by_localization(stamp, placed.piece)) is not None:
            spread = variance + camera_from_drift @ near[1] @ camera_from_drift.T
            localized = PoseUncertainty(placed.drift, camera_from_drift, spread)
            if localized.is_placed:
                uncertainty, map_T_camera = localized, near[0] @ base_T_camera
        return PosePrediction(map_T_camera, camera_T_start, uncertainty, (number, motion, covariance))

    def accept(self, prediction: PosePrediction) -> None:
        """Store the covariance of a prediction whose frame became the newest keyframe."""
        m, number = self._state, int(self._state.keyframes.id[-1])
        if prediction.motion is None:
            m.pose_covariance = np.full((6, 6), np.nan)
            return
        m.pose_covariance = prediction.uncertainty.pose
        if number % _ASK:
            self._covariances[number] = m.pose_covariance

    def covariance_of(self, keyframe: int) -> Floats:
        """Return the covariance (6, 6) of a keyframe's camera pose in the camera frame, from the cache or the graph."""
        if keyframe not in self._covariances:
            self._covariances = {keyframe: self._state.graph.pose_covariance(keyframe)}
        return self._covariances[keyframe]

    def _motion_floor(self, base_T_camera: Floats) -> Floats:
        """Return `odometry.motion_floor` (6, 6) of a mount, from a cache of one mount."""
        mount, planar, floor = self._floor
        on_plane = self._state.course.odometry.planar
        if mount is not base_T_camera or planar != on_plane:
            floor = odometry.motion_floor(base_T_camera, self._state.settings, on_plane)
            self._floor = base_T_camera, on_plane, floor
        return floor
