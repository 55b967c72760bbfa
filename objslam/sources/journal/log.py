"""Read a journal as a log."""

from pathlib import Path

import numpy as np

from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log, label_table
from objslam.errors import LogError
from objslam.sources.journal.reader import messages
from objslam.sources.journal.records import CameraMessage, FrameMessage, HeldMounts, MountMessage, PoseMessage
from objslam.sources.journal.segments import journal_file


def read_journal(path: Path, ledger: Ledger) -> Log:
    """Return the log of a journal, with the stamps that the session gave to the messages.

    Raises LogError if the path is not a journal, or if the journal has no frames.
    """
    poses: dict[str, list[PoseMessage]] = {"odometry": [], "localization": []}
    cameras: dict[str, Camera] = {}
    frames: dict[str, list[FrameMessage]] = {}
    mounts: dict[str, HeldMounts] = {}
    for message in messages(path, ledger):
        if isinstance(message, PoseMessage):
            poses[message.path].append(message)
        elif isinstance(message, CameraMessage):
            cameras[message.camera.name] = message.camera
        elif isinstance(message, FrameMessage):
            frames.setdefault(message.camera, []).append(message)
        elif isinstance(message, MountMessage):
            mounts.setdefault(message.camera, HeldMounts()).add(message)
    if not frames:
        raise LogError("the journal holds no frames", where=str(path))
    return Log(
        name=journal_file(path).resolve().parent.name,
        cameras=tuple(_camera_log(camera, frames.get(name, []), mounts.get(name)) for name, camera in cameras.items()),
        odometry=_trajectory(poses["odometry"]),
        localization=_trajectory(poses["localization"]),
    )


def _trajectory(found: list[PoseMessage]) -> Trajectory | None:
    if not found:
        return None
    stamps, poses = np.array([m.stamp for m in found]), np.array([m.pose for m in found])
    first = np.append(True, np.diff(stamps) > 0)
    return Trajectory(stamps[first], poses[first])


def _camera_log(camera: Camera, frames: list[FrameMessage], mounts: HeldMounts | None) -> CameraLog:
    frames = sorted(frames, key=lambda frame: frame.stamp)
    stamps = np.array([frame.stamp for frame in frames])
    names, label = label_table([name for frame in frames for name in frame.labels])
    detections = Detections(
        frame_stamps=stamps,
        frame=np.repeat(np.arange(len(frames)), [len(frame) for frame in frames]),
        boxes=np.concatenate([np.zeros((0, 4)), *(frame.boxes for frame in frames)]),
        label=label,
        scores=np.concatenate([np.zeros(0), *(frame.scores for frame in frames)]),
        depths=np.concatenate([np.zeros(0), *(frame.depths for frame in frames)]),
        track_ids=np.concatenate([np.zeros(0, dtype=np.int64), *(frame.track_ids for frame in frames)]),
        label_names=names,
        whole=bool(frames) and all(frame.whole for frame in frames),
    )
    if mounts is None:
        return CameraLog(camera, detections)
    held = np.array([mounts.at(stamp, camera) for stamp in stamps.tolist()]).reshape(-1, 4, 4)
    return CameraLog(camera, detections, mount=Trajectory(stamps, held))
