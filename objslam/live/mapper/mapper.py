"""The map of a session, message by message, in one thread: the order in which the modules beside do their work.

It depends on the messages and their order alone, never on the time of day, so that a journal played again gives the same
map.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from objslam.association.landmarks import PredictedLandmarks
from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.live.counters import Counters
from objslam.live.mapper.bearing_extraction import BearingExtractor, FrameView
from objslam.live.mapper.course import Placed
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
    """Takes messages in session time and keeps the map; not to be used from two threads at a time."""

    def __init__(self, settings: Settings, counters: Counters) -> None:
        self.state = MapState.new(settings, counters)
        self._extractor = BearingExtractor(settings, counters.ledger, self.state.cameras, self.state.labels)
        self._selector = KeyframeSelector(settings.live)
        self._predictor = PosePredictor(self.state)
        self._predicted: PredictedLandmarks | None = None  # of the map as it is, made ahead; None where it changed since

    def feed(self, message: Message) -> None:
        """Take a message that is no frame."""
        m = self.state
        if isinstance(message, PoseMessage):
            if message.path == "odometry":
                m.course.add_odometry(message.stamp, message.pose)
                return
            m.localization.received += 1
            m.course.localization.append(message.stamp, message.pose)
            if localize(m):
                self._predicted = None
        elif isinstance(message, CameraMessage):
            self._extractor.add_camera(message.camera)
        elif isinstance(message, MountMessage):
            self._extractor.add_mount(message)

    def is_ready(self, stamp: float) -> bool:
        """Whether the place on the course of a frame from then is decided."""
        return self.state.course.ready(stamp)

    def take(self, frame: FrameMessage) -> LandmarkUpdate | None:
        """Work a frame into the map: what `look_after` is to be given then; None where it became no keyframe."""
        m = self.state
        # the pose on the course
        before = m.newest_before(frame.stamp)
        placed = m.course.place(frame.stamp, m.keyframes, before)
        if placed is None:
            m.counters.drop_frame(frame, "frames off the path, or in a gap of it")
            return None
        # bearings of the boxes
        view = self._extractor.extract(frame)
        m.frames[view.camera] = m.frames.get(view.camera, 0) + 1
        # keyframe selection
        start_T_camera, shown = placed.start_T_base @ view.base_T_camera, set(view.rays.label.tolist())
        if not self._is_wanted(frame, view.camera, start_T_camera, shown, before):
            return None
        # prediction of the pose, with its covariance
        prediction = self._predictor.predict(before, frame.stamp, placed, view.base_T_camera, start_T_camera)
        if not shown:  # what was not seen is evidence, but no keyframe
            camera = m.cameras[view.camera]
            m.landmarks.expected[in_view(m.landmarks, camera, prediction.map_T_camera)] += 1
            return None
        self._selector.accept(view.camera, start_T_camera, shown)
        # into the graph
        k = self._add_keyframe(frame.stamp, view, placed, prediction)
        # localisation
        pose = prediction.map_T_camera
        if localize(m):
            pose, self._predicted = m.graph.pose(k), None
        # association with landmarks and tracks
        predicted, self._predicted = self._predicted, None
        return associate(m, view.rays, pose, prediction.uncertainty, predicted)

    def look_after(self, update: LandmarkUpdate) -> None:
        """After a frame became a keyframe: what landmarks learn of it, and what else need not keep the next one waiting."""
        m = self.state
        # landmarks and tracks that the frame showed
        update_landmarks(m, update)
        rest = promote_tracks(m, update.tracks)
        update_positions([track for track in rest if not track.by_label])
        # what is due now and then
        maintain(m)
        # prediction of what the next frame may show, and from where
        if not m.by_label:
            prune_tracks(m)
            self._predicted = predict_landmarks(m.landmarks, m.tracks)
        if m.keyframes.by_odometry[-1]:
            self._predictor.covariance_of(int(m.keyframes.id[-1]))

    def _is_wanted(
        self, frame: FrameMessage, camera: int, start_T_camera: Floats, shown: set[int], before: int | None
    ) -> bool:
        """Whether a frame tells something new: it is neither redundant nor late, and there are boxes or landmarks."""
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

    def _add_keyframe(self, stamp: float, view: FrameView, placed: Placed, prediction: PosePrediction) -> int:
        """The id of the new keyframe."""
        m = self.state
        k = m.next_id.keyframe
        m.next_id.keyframe += 1
        row: dict[str, Any] = {
            "id": k,
            "stamp": stamp,
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
