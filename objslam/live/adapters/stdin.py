"""Reads JSON lines from standard input, one message per line.

{"type": "camera", "name": "front", ...the keys of camera.yaml...}
{"type": "odometry", "stamp": 12.5, "translation": [x, y, z], "rotation_xyzw": [x, y, z, w]}    odom_T_base
{"type": "localization", ...the keys of odometry...}    map_T_base
{"type": "mount", "camera": "front", ...the keys of odometry...}    base_T_camera from this stamp on
{"type": "detections", "camera": "front", ...the keys of detections.jsonl...}

A planar pose has "x", "y", "yaw" instead of translation and rotation. Odometry and localization may have a "covariance" of
36 numbers, as in ROS. With a single camera, "camera" and "name" may be left out. The camera is then called "camera".
"""

import json
import os
import select
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2, pose_from_quaternion
from objslam.core.validity import lengths
from objslam.errors import LogError
from objslam.io.box_collector import BoxCollector
from objslam.io.camera_yaml import parse_camera
from objslam.io.detections_jsonl import Malformed, add_frame, parse_object, read_numbers, read_stamp
from objslam.live.interface import Sink

_CAMERA = "camera"
_LONGEST = 1 << 20  # The longest line, bytes. Longer lines are dropped. A larger number costs memory.
_CHUNK = 1 << 16  # The most bytes of one read. A larger number makes fewer reads.
_FASTER = 1.5  # Above this ratio of stamp time to clock time, a stream is a recording. A larger number finds fewer.
_WAIT = 0.1  # The longest time until a stop is noticed, s. With a larger value, it is noticed later, and waiting costs less.


@dataclass
class StdinAdapter:
    """Pushes the messages of a stream. Malformed lines are counted with their line numbers.

    wait: the function that is called after each frame of a recorded stream. It returns once the map contains the frame. None
    if a running robot writes the stream, because a robot never waits for the map. clock: returns the time, s.
    """

    sink: Sink
    stream: BinaryIO
    name: str = "stdin"
    wait: Callable[[], object] | None = None
    ledger: Ledger = field(default_factory=Ledger)
    clock: Callable[[], float] = time.monotonic
    _first: tuple[float, float] | None = field(default=None, init=False)
    _faster: float = field(default=1.0, init=False)

    def late(self) -> str:
        """Return advice against late frames if the stamps ran faster than the clock, "" otherwise.

        The stamps of a robot run as fast as the clock. The stamps of a recording may run faster.
        """
        if self.wait is not None or self._faster < _FASTER:
            return ""
        return (
            f"the messages came {self._faster:.2g} times as fast as their stamps: with --speed 0, every frame of a "
            "recording is mapped"
        )

    def run(self, stop: threading.Event) -> None:
        """Push messages until the stream ends or `stop` is set."""
        number, rest, skipping = 0, b"", False
        while not stop.is_set() and (chunk := self._read(stop)):
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                number += 1
                if not skipping:
                    self._take(line, number)
                skipping = False
            if len(rest) > _LONGEST:
                if not skipping:
                    self.ledger.drop(f"line longer than {_LONGEST} bytes", where=f"{self.name}:{number + 1}")
                rest, skipping = b"", True
        if rest and not skipping and not stop.is_set():
            self._take(rest, number + 1)

    def _read(self, stop: threading.Event) -> bytes:
        """Return the next bytes. Return b"" at the end of the stream, or when `stop` is set."""
        source = self.stream.fileno()
        while not stop.is_set():
            if select.select([source], [], [], _WAIT)[0]:
                return os.read(source, _CHUNK)
        return b""

    def _take(self, line: bytes, number: int) -> None:
        if not line.strip():
            return
        place = f"{self.name}:{number}"
        try:
            self._push(parse_object(line), place)
        except Malformed as malformed:
            self.ledger.drop(f"line malformed: {malformed}", where=place)
        except LogError as error:
            self.ledger.drop("line malformed: not a valid camera", where=str(error))

    def _push(self, message: dict[str, Any], place: str) -> None:
        kind = message.get("type")
        if kind == "camera":
            keys = {key: value for key, value in message.items() if key not in ("type", "name")}
            text = json.dumps(keys).encode()
            self.sink.push_camera(parse_camera(text, place, self.ledger, _name(message, "name")))
        elif kind in ("odometry", "localization"):
            push = self.sink.push_odometry if kind == "odometry" else self.sink.push_localization
            push(read_stamp(message), _pose(message), _covariance(message))
            self._compare(read_stamp(message))
        elif kind == "mount":
            self.sink.push_mount(read_stamp(message), _name(message, _CAMERA), _pose(message))
        elif kind == "detections":
            self._push_detections(message, place)
        else:
            raise Malformed("type is none of camera, odometry, localization, mount, detections")

    def _compare(self, stamp: float) -> None:
        """Record how much faster the stamps have run than the clock since the first pose. stamp: the newest pose's stamp,
        s."""
        if self._first is None:
            self._first = stamp, self.clock()
        self._faster = (stamp - self._first[0]) / max(self.clock() - self._first[1], 1e-3)

    def _push_detections(self, message: dict[str, Any], place: str) -> None:
        collector = BoxCollector()
        whole = add_frame(message, place, collector)
        boxes = np.array(collector.boxes, dtype=np.float64).reshape(-1, 4)
        scores, depths = np.array(collector.scores, dtype=np.float64), np.array(collector.depths, dtype=np.float64)
        camera, tracks = _name(message, _CAMERA), collector.track_ids
        self.sink.push_detections(collector.stamps[0], camera, boxes, collector.labels, scores, depths, tracks, whole)
        if self.wait is not None:
            self.wait()


def _name(message: dict[str, Any], key: str) -> str:
    name = message.get(key, _CAMERA)
    if type(name) is not str or not name:
        raise Malformed(f"{key} is not a name")
    return name


def _pose(message: dict[str, Any]) -> Floats:
    if "yaw" in message:
        return lift_se2(np.array(_finite([message.get(key) for key in ("x", "y", "yaw")], "x, y, yaw", 3)))
    if "translation" not in message:
        raise Malformed("no pose (x, y and yaw, or translation and rotation_xyzw)")
    place = _finite(message.get("translation"), "translation", 3)
    xyzw = _finite(message.get("rotation_xyzw"), "rotation_xyzw", 4)
    if not abs(float(lengths(np.array(xyzw))) - 1) < 0.01:
        raise Malformed("rotation_xyzw is not of length 1")
    return pose_from_quaternion(np.array([place]), np.array([xyzw]))[0]


def _covariance(message: dict[str, Any]) -> Floats | None:
    if "covariance" not in message:
        return None
    return np.array(_finite(message["covariance"], "covariance", 36)).reshape(6, 6)


def _finite(value: Any, name: str, count: int) -> list[float]:
    numbers = read_numbers(value, name)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise Malformed(f"{name} is not {count} finite numbers")
    return numbers
