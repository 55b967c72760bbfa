"""A session for programs that push live data into a map. It needs no middleware."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from numpy.typing import ArrayLike

from objslam.api.array_input import as_pose
from objslam.api.mapping import Given, prior_map, settings_of
from objslam.api.result import Result
from objslam.core.arrays import Floats
from objslam.core.snapshot import LATE_FRAME, Snapshot
from objslam.io.results.object_map import ObjectMap
from objslam.live.session.session import Session as LiveSession


class Session(LiveSession):
    """A map that grows while data are pushed. The session maps in a thread of its own.

    A `with` block starts and ends the session. Push cameras first, then poses and boxes, from any thread. A push returns
    False if the message is dropped. `snapshot().dropped` counts the dropped messages by reason. `result` ends the session
    and solves the whole map once more.

        with objslam.Session() as session:
            session.push_camera(camera)
            session.push_odometry(10.0, [0.0, 0.0, 0.0])
            session.push_detections(10.0, "front", [[205, 207, 226, 232]], ["cup"], [0.9])
            print(session.snapshot().map)
            result = session.result()

    settings, changes: as in `objslam.run`. The mode is always joint. journal: the path of a file that stores every accepted
    message, so that a program that is killed loses nothing. resume: whether to continue an existing journal. name: the name
    of the log in the result. patient: use True for data that do not come from a running robot. A push then waits while the
    session is busy, and the session waits for calibrations. So nothing is dropped for lack of time. Push in the order of the
    stamps. map: the map of another day, as a `Result`, an `ObjectMap`, or the path of its file or result folder. Once the
    session is found in this map, `snapshot().in_map` says so. Snapshots and result are then in the frame of the map.
    """

    def __init__(
        self,
        settings: Given = None,
        *,
        journal: str | PathLike[str] | None = None,
        resume: bool = False,
        name: str = "live",
        patient: bool = False,
        map: Result | ObjectMap | str | PathLike[str] | None = None,
        **changes: Any,
    ) -> None:
        chosen = settings_of(settings, {**changes, "mode": "joint"})
        known = None if map is None else prior_map(map)
        super().__init__(chosen, None if journal is None else Path(journal), resume, name, patient, known)

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.abort()

    def push_odometry(self, stamp: float, odom_T_base: ArrayLike, covariance: Floats | None = None) -> bool:
        """Push the pose odom_T_base of the odometry at a stamp, s. The pose is a matrix (4, 4), or three numbers x, y, yaw,
        or seven numbers x, y, z, qx, qy, qz, qw, in m and rad. `covariance` has no effect, because the settings give the
        drift. Return False if the pose is dropped."""
        return super().push_odometry(stamp, _pose(odom_T_base), covariance)

    def push_localization(self, stamp: float, map_T_base: ArrayLike, covariance: Floats | None = None) -> bool:
        """Push the pose map_T_base of a localisation at a stamp, s. The pose has one of the forms of `push_odometry`."""
        return super().push_localization(stamp, _pose(map_T_base), covariance)

    def push_mount(self, stamp: float, camera: str, base_T_camera: ArrayLike) -> bool:
        """Push the pose base_T_camera of a camera that moves on the robot. It is valid from the stamp, s, until the next
        such pose.

        The pose has one of the forms of `push_odometry`.
        """
        return super().push_mount(stamp, camera, _pose(base_T_camera))

    def snapshot(self) -> Snapshot:
        """Return the present map, path and counts. This usually takes milliseconds. If the session has stopped, or is busy
        for 5 s, return its last snapshot."""
        found = super().snapshot()
        return replace(found, map=ObjectMap.of(found.map))

    def result(self) -> Result:
        """End the session, solve the whole map once more, and return the result. SolveError if no box could be mapped.

        A frame is not mapped if it is more than live.max_late older than the newest pose. In a patient session, the summary
        then has a warning with the number of such frames.
        """
        late = self.counters.dropped().get(LATE_FRAME, 0)
        if self._patient and late:
            order = "push poses and frames in the order of their stamps, not all poses first"
            self.counters.ledger.warn(f"{late} frames came after poses that are more than live.max_late newer: {order}")
        return Result.of(self.stop())


def _pose(values: ArrayLike) -> Any:
    """Return a pose (4, 4). If the values are not a pose, return them unchanged. The session then refuses and counts
    them."""
    try:
        return as_pose(values)
    except (TypeError, ValueError):
        return values
