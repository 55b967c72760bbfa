"""Replays a log at its own speed, at another speed, or as fast as the session accepts it."""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.core.types import Detections, Log
from objslam.live.interface import Sink

_BEHIND = 1.0  # The delay of a replay, s, above which the user is warned. A larger value warns later.


@dataclass
class ReplayAdapter:
    """Pushes the content of a log in the order of `events`.

    speed: 2 replays twice as fast as recorded. None replays as fast as possible. wait: the function that is called after
    each frame if `speed` is None. It returns once the map contains the frame. after: the function that returns the stamp, s,
    before which a resumed session already has all messages.
    """

    sink: Sink
    log: Log
    speed: float | None = 1.0
    wait: Callable[[], object] | None = None
    after: Callable[[], float] = lambda: -np.inf
    settings: Settings = field(default_factory=Settings)
    ledger: Ledger = field(default_factory=Ledger)

    def run(self, stop: threading.Event) -> None:
        """Push the whole log, unless `stop` is set before its end."""
        for camera_log in self.log.cameras:
            self.sink.push_camera(camera_log.camera)
        begin, first = time.perf_counter(), None
        late, after = 0.0, self.after()
        for stamp, frame, push in events(self.log, self.settings):
            if stop.is_set():
                return
            if stamp < after:
                continue
            first = stamp if first is None else first
            if self.speed is not None:
                ahead = (stamp - first) / self.speed - (time.perf_counter() - begin)
                late = max(late, -ahead)
                if ahead > 0 and stop.wait(ahead):
                    return
            push(self.sink)
            if self.speed is None and frame and self.wait is not None:
                self.wait()
        if late > _BEHIND:
            self.ledger.warn(f"the replay was up to {late:.1f} s late: choose a smaller --speed")


Push = Callable[[Sink], bool]


def events(log: Log, settings: Settings | None = None) -> Iterator[tuple[float, bool, Push]]:
    """Yield the events of a log in time order: the time, s, whether the event is a frame, and the function that pushes it.

    The time of an event is its stamp, except for a frame. A frame directly follows the first pose of the robot's path at or
    after the frame's stamp, and has the time of this pose. So no frame waits for a pose (live.max_lag). If this pose does
    not exist or is more than live.max_late later, the time of the frame is its own stamp.
    """
    settings = settings or Settings()
    # For each kind of event: the stamps, s, the rank (lower first at one stamp), and the function that returns push i.
    kinds: list[tuple[np.ndarray, int, Callable[[int], Push]]] = []
    for path, which in ((log.localization, "push_localization"), (log.odometry, "push_odometry")):
        if path is not None:
            kinds.append((path.stamps, 0, _poses(path, which)))
    for camera_log in log.cameras:
        name, mount = camera_log.camera.name, camera_log.mount
        if mount is not None:
            kinds.append((mount.stamps, 1, _poses(mount, "push_mount", name)))
        if camera_log.detections is not None:
            kinds.append((_covered(log, settings, camera_log.detections), 2, _frames(camera_log.detections, name)))
    stamps = np.concatenate([k[0] for k in kinds])
    rank = np.concatenate([np.full(len(k[0]), k[1]) for k in kinds])
    kind = np.concatenate([np.full(len(k[0]), i) for i, k in enumerate(kinds)])
    index = np.concatenate([np.arange(len(k[0])) for k in kinds])
    for at in np.lexsort((rank, stamps)).tolist():
        yield float(stamps[at]), bool(rank[at] == 2), kinds[kind[at]][2](int(index[at]))


def _covered(log: Log, settings: Settings, detections: Detections) -> Floats:
    """Return the stamp (F,), s, of the first pose at or after each frame.

    If no pose follows within live.max_late, return the frame's own stamp.
    """
    path = log.localization if log.odometry is None or settings.poses.use == "localization" else log.odometry
    own = detections.frame_stamps
    if path is None:
        return own
    later = np.append(path.stamps, np.inf)[np.searchsorted(path.stamps, own)]
    return np.asarray(np.where(later - own <= settings.live.max_late, later, own))


def _poses(path: Trajectory, which: str, *camera: str) -> Callable[[int], Push]:
    return lambda i: lambda sink: getattr(sink, which)(float(path.stamps[i]), *camera, path.poses[i])


def _frames(detections: Detections, camera: str) -> Callable[[int], Push]:
    bounds = np.searchsorted(detections.frame, np.arange(len(detections.frame_stamps) + 1))

    def push(i: int) -> Push:
        boxes = slice(bounds[i], bounds[i + 1])
        labels = tuple(detections.label_names[j] for j in detections.label[boxes].tolist())
        depths, tracks = detections.depths[boxes], detections.track_ids[boxes].tolist()
        found = detections.boxes[boxes], labels, detections.scores[boxes], depths, tracks, detections.whole
        return lambda sink: sink.push_detections(float(detections.frame_stamps[i]), camera, *found)

    return push
