"""The mapper of a live session. It takes one message at a time, and defines the order of all changes of the map.

The map depends on the messages and their order only, never on the clock, so a replayed journal gives the same map.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from objslam.association.landmarks import PredictedLandmarks
from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.camera import spoken_name
from objslam.frontend.boxes.part_finder import RobotPartFinder
from objslam.frontend.boxes.robot_parts import ROBOT_PARTS
from objslam.frontend.corrected_odometry import OdometryCorrection
from objslam.frontend.known_errors import known_errors
from objslam.frontend.odometry_drift import scaled_noise
from objslam.graph.isam2 import IncrementalGraph
from objslam.live.counters import Counters
from objslam.live.label_kinds import LabelKinds
from objslam.live.mapper.bearing_extraction import BearingExtractor, FrameView
from objslam.live.mapper.course import Course, Placed
from objslam.live.mapper.data_association import associate
from objslam.live.mapper.keyframe_selection import KeyframeSelector
from objslam.live.mapper.landmark_table import in_view, predict_landmarks
from objslam.live.mapper.landmark_update import LandmarkUpdate, update_landmarks
from objslam.live.mapper.localization import localize
from objslam.live.mapper.maintenance import maintain
from objslam.live.mapper.prediction import PosePrediction, PosePredictor
from objslam.live.mapper.state import MapState
from objslam.live.mapper.track_promotion import promote_tracks, prune_tracks
from objslam.live.mapper.tracks import update_positions
from objslam.sources.journal.records import CameraMessage, FrameMessage, Message, MountMessage, PoseMessage


class Mapper:
    """Builds the map in one thread, from messages whose stamps are in session time (see `clock`)."""

    def __init__(self, settings: Settings, counters: Counters) -> None:
        kinds, rng = LabelKinds(settings.association.method != "global"), np.random.default_rng(settings.seed)
        given = settings.model_copy(update={"mode": "joint"})
        known = known_errors(given)
        errors = {} if known is None else dict(zip(known.names, known.values.tolist(), strict=True))
        scaled = scaled_noise(given, errors)
        course = Course(scaled, OdometryCorrection(errors))
        self.state = MapState(
            scaled, counters, IncrementalGraph(scaled), course, kinds, rng, given, errors=errors, calibration=known
        )
        self._extractor = BearingExtractor(self.state)
        self._selector = KeyframeSelector(settings.live)
        self._predictor = PosePredictor(self.state)
        self._predicted: PredictedLandmarks | None = None  # The candidates of the next keyframe. None if the map has moved.

    def feed(self, message: Message) -> None:
        """Process a pose, a camera or a mount. Other messages change nothing."""
        m = self.state
        if isinstance(message, PoseMessage):
            if message.path == "odometry":
                m.course.add_odometry(message.stamp, message.pose, m.keyframes)
                return
            m.localization.received += 1
            m.course.add_localization(message.stamp, message.pose, m.keyframes)
            if localize(m):
                self._predicted = None
        elif isinstance(message, CameraMessage):
            self._extractor.add_camera(message.camera)
        elif isinstance(message, MountMessage):
            self._extractor.add_mount(message)

    def is_ready(self, stamp: float) -> bool:
        """Return whether all poses for a frame with this stamp have arrived (`Course.ready`)."""
        return self.state.course.ready(stamp)

    def corrected_stamp(self, frame: FrameMessage) -> float:
        """Return the stamp of a frame, s, on the clock of the poses."""
        return frame.stamp + self.state.errors.get(f"{frame.camera}.clock", 0.0)

    def map_has_moved(self) -> None:
        """Forget the preparations for the next frame, because keyframes and landmarks have moved."""
        m = self.state
        self._predictor, self._predicted = PosePredictor(m), None
        for number in np.unique(m.keyframes.camera).tolist():
            row = int(np.flatnonzero(m.keyframes.camera == number)[-1])
            self._selector.place(number, m.keyframes.start_T_base[row] @ m.keyframes.base_T_camera[row])

    def take(self, frame: FrameMessage) -> LandmarkUpdate | None:
        """Add a frame to the map. Return the argument for `look_after`, or None if the frame does not become a keyframe."""
        m, stamp = self.state, self.corrected_stamp(frame)
        before = m.newest_before(stamp)
        placed = m.course.place(stamp, m.keyframes, before)
        if placed is None:
            m.counters.drop_frame(frame, "frames without a pose: the path has a gap there, or does not reach them")
            return None
        view = self._extractor.extract(frame, stamp)
        m.frames[view.camera] += 1
        start_T_camera = placed.start_T_base @ view.base_T_camera
        view = self._without_robot_parts(view, start_T_camera, frame)
        shown = set(view.rays.label.tolist())
        if not self._is_wanted(frame, view.camera, start_T_camera, shown, before):
            return None
        prediction = self._predictor.predict(before, stamp, placed, view.base_T_camera, start_T_camera)
        pose = prediction.map_T_camera
        if not shown:  # A frame without boxes only counts against the landmarks in view.
            m.landmarks.expected[in_view(m.landmarks, m.cameras[view.camera], pose)] += 1
            return None
        self._selector.accept(view.camera, start_T_camera, shown)
        k = self._add_keyframe(frame, view, placed, prediction)
        if localize(m):
            pose, self._predicted = m.graph.pose(k), None
        predicted, self._predicted = self._predicted, None
        return associate(m, view.rays, pose, prediction.uncertainty, predicted)

    def look_after(self, update: LandmarkUpdate) -> None:
        """Update landmarks and tracks after a new keyframe, run maintenance, and prepare the next association."""
        m = self.state
        update_landmarks(m, update)
        rest = promote_tracks(m, update.tracks)
        update_positions([track for track in rest if not track.by_label], m.graph)
        maintain(m)
        if not m.by_label:
            prune_tracks(m)
            self._predicted = predict_landmarks(m.landmarks, m.tracks)
        if m.keyframes.by_odometry[-1]:
            self._predictor.covariance_of(int(m.keyframes.id[-1]))

    def _without_robot_parts(self, view: FrameView, start_T_camera: Floats, frame: FrameMessage) -> FrameView:
        """Return the view without boxes of parts of the robot. A camera that moves on the robot keeps all boxes."""
        m = self.state
        if not m.given.rays.robot_parts or self._extractor.moves(frame.camera):
            return view
        finder = m.robot_parts.setdefault(view.camera, RobotPartFinder())
        part = finder.add(view.rays.box, view.rays.label, start_T_camera, view.rays.direction)
        if not part.any():
            return view
        m.counters.drop(ROBOT_PARTS, f"{spoken_name(frame.camera)}, stamp {frame.stamp:.3f}", int(part.sum()))
        return replace(view, rays=view.rays.take(np.flatnonzero(~part)))

    def _is_wanted(
        self, frame: FrameMessage, camera: int, start_T_camera: Floats, shown: set[int], before: int | None
    ) -> bool:
        """Return whether a frame is neither redundant nor late, and has boxes or can show that landmarks are missing."""
        m = self.state
        if self._selector.is_redundant(camera, start_T_camera, shown):
            m.counters.accept("frames between keyframes")
            return False
        is_late = before is None and len(m.keyframes.id) > 0
        shows_something = bool(shown) or len(m.landmarks.id) > 0
        if is_late or not shown:
            self._selector.pass_over(camera, start_T_camera)
        if is_late and shows_something:
            m.counters.drop_frame(frame, "frames older than the map")
        return shows_something and not is_late

    def _add_keyframe(self, frame: FrameMessage, view: FrameView, placed: Placed, prediction: PosePrediction) -> int:
        """Add a keyframe to the table and the graph, and return its id."""
        m = self.state
        k = m.next_id.keyframe
        m.next_id.keyframe += 1
        row: dict[str, Any] = {
            "id": k,
            "stamp": self.corrected_stamp(frame),
            "sent": frame.stamp,
            "mount": view.mount,
            "camera": view.camera,
            "frame": m.frames[view.camera] - 1,
            "base_T_camera": view.base_T_camera,
            "camera_T_start": prediction.camera_T_start,
            "localized": False,
            **vars(placed),
        }
        m.keyframes.add(**{name: np.asarray(value)[None] for name, value in row.items()})
        m.graph.add_keyframe(k, prediction.map_T_camera)
        if prediction.motion is not None:
            number, motion, covariance = prediction.motion
            m.graph.add_motion(number, k, motion, covariance)
        elif k == 0 and placed.by_odometry:
            m.graph.add_anchor(k, prediction.map_T_camera)
        self._predictor.accept(prediction)
        m.localization.pending.append(k)
        return k
