"""A robot on DDS for tests, in a process of its own: message types written out by hand and cyclonedds' own serialiser.

python robot.py '{"domain": 60, ...}' drives for a while, then prints the stamps of what it sent as JSON.
"""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).parents[1]))
from waiting import LIMIT, wait_for

LOOPBACK = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<MaxAutoParticipantIndex>30</MaxAutoParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
    "</Domain></CycloneDDS>"
)
MATRIX = [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]
BASE_T_CAMERA = np.array([[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
MAP_T_ODOM = np.array([[0.0, -1.0, 0.0, 2.0], [1.0, 0.0, 0.0, -1.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def time_of_day() -> float:
    """s, as robots stamp."""
    return time.time()


def pose_at(time_s: float) -> np.ndarray:
    """odom_T_base on a circle of 2 m at 0.5 rad/s."""
    a = 0.5 * time_s
    c, s = np.cos(a), np.sin(a)
    return np.array([[c, -s, 0, 2 * s], [s, c, 0, 2 - 2 * c], [0, 0, 1, 0], [0, 0, 0, 1]])


@dataclass
class Drive:
    """What a robot does. hz: odometry and detections a second. bad: detections whose label is no text, before the last ones.

    heard: the writers that must have a reader before it drives off.
    """

    domain: int
    seconds: float
    odometry_hz: float = 200.0
    detections_hz: float = 20.0
    reliable: bool = True
    bad: int = 0
    topic: str = "odom"
    heard: tuple[str, ...] = ("odom", "tf", "info", "found")


@dataclass
class Recorder:
    """A sink that remembers."""

    cameras: list = field(default_factory=list)
    odometry: list = field(default_factory=list)
    localization: list = field(default_factory=list)
    mounts: list = field(default_factory=list)
    detections: list = field(default_factory=list)
    depths: list = field(default_factory=list)
    whole: list = field(default_factory=list)
    lock: Any = field(default_factory=threading.Lock)

    def push_camera(self, camera):
        self.cameras.append(camera)
        return True

    def push_odometry(self, stamp, odom_T_base, covariance=None):
        self.odometry.append((stamp, odom_T_base, covariance, time_of_day()))
        return True

    def push_localization(self, stamp, map_T_base, covariance=None):
        self.localization.append((stamp, map_T_base, covariance))
        return True

    def push_mount(self, stamp, camera, base_T_camera):
        self.mounts.append((stamp, camera, base_T_camera))
        return True

    def push_detections(self, stamp, camera, boxes, labels, scores, depths=None, track_ids=None, whole=False):
        self.depths.append(depths)
        self.whole.append(whole)
        self.detections.append((stamp, camera, np.array(boxes), list(labels), np.array(scores), track_ids, time_of_day()))
        return True


def start(drive: Drive) -> subprocess.Popen:
    env = {**os.environ, "CYCLONEDDS_URI": LOOPBACK, "OMP_NUM_THREADS": "1"}
    text = json.dumps(asdict(drive))
    return subprocess.Popen([sys.executable, str(Path(__file__)), text], env=env, stdout=subprocess.PIPE, text=True)


@contextmanager
def robot_process(drive: Drive) -> Iterator[subprocess.Popen]:
    """A robot that drives in a process of its own, and is killed at the end."""
    with start(drive) as process:
        try:
            yield process
        finally:
            process.kill()


def sent(process: subprocess.Popen) -> dict:
    """What a robot sent, when it is done."""
    try:
        out, _ = process.communicate(timeout=LIMIT)
    finally:
        process.kill()
    assert process.returncode == 0
    return json.loads(out)


def messages() -> dict[str, type]:
    """The message types by name."""
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.types import array, float64, int32, sequence, uint32

    def struct(package, name, **fields):
        from cyclonedds.idl import make_idl_struct

        made[name] = make_idl_struct(name, f"{package}.msg.dds_.{name}_", fields)

    made: dict[str, type[IdlStruct]] = {}
    struct("builtin_interfaces", "Time", sec=int32, nanosec=uint32)
    struct("std_msgs", "Header", stamp=made["Time"], frame_id=str)
    for name, fields in {"Point": "xyz", "Vector3": "xyz", "Quaternion": "xyzw"}.items():
        struct("geometry_msgs", name, **dict.fromkeys(fields, float64))
    struct("geometry_msgs", "Pose", position=made["Point"], orientation=made["Quaternion"])
    struct("geometry_msgs", "PoseWithCovariance", pose=made["Pose"], covariance=array[float64, 36])
    struct("geometry_msgs", "Twist", linear=made["Vector3"], angular=made["Vector3"])
    struct("geometry_msgs", "TwistWithCovariance", twist=made["Twist"], covariance=array[float64, 36])
    body = {"pose": made["PoseWithCovariance"], "twist": made["TwistWithCovariance"]}
    struct("nav_msgs", "Odometry", header=made["Header"], child_frame_id=str, **body)
    struct("geometry_msgs", "Transform", translation=made["Vector3"], rotation=made["Quaternion"])
    body = {"header": made["Header"], "child_frame_id": str, "transform": made["Transform"]}
    struct("geometry_msgs", "TransformStamped", **body)
    struct("tf2_msgs", "TFMessage", transforms=sequence[made["TransformStamped"]])
    numbers = {"x_offset": uint32, "y_offset": uint32, "height": uint32, "width": uint32, "do_rectify": bool}
    struct("sensor_msgs", "RegionOfInterest", **numbers)
    body = {"height": uint32, "width": uint32, "distortion_model": str, "d": sequence[float64], "k": array[float64, 9]}
    body |= {"r": array[float64, 9], "p": array[float64, 12], "binning_x": uint32, "binning_y": uint32}
    struct("sensor_msgs", "CameraInfo", header=made["Header"], **body, roi=made["RegionOfInterest"])
    struct("vision_msgs", "Point2D", x=float64, y=float64)
    struct("vision_msgs", "Pose2D", position=made["Point2D"], theta=float64)
    struct("vision_msgs", "BoundingBox2D", center=made["Pose2D"], size_x=float64, size_y=float64)
    struct("vision_msgs", "ObjectHypothesis", class_id=str, score=float64)
    body = {"hypothesis": made["ObjectHypothesis"], "pose": made["PoseWithCovariance"]}
    struct("vision_msgs", "ObjectHypothesisWithPose", **body)
    body = {"results": sequence[made["ObjectHypothesisWithPose"]], "bbox": made["BoundingBox2D"], "id": str}
    struct("vision_msgs", "Detection2D", header=made["Header"], **body)
    struct("vision_msgs", "Detection2DArray", header=made["Header"], detections=sequence[made["Detection2D"]])
    return made


class Robot:
    """Makes and sends messages."""

    def __init__(self, drive: Drive) -> None:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.domain import DomainParticipant
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        self.drive, self.types = drive, messages()
        participant = DomainParticipant(drive.domain)
        reliable = Policy.Reliability.Reliable(int(LIMIT * 1e9))
        plain = Qos(reliable if drive.reliable else Policy.Reliability.BestEffort, Policy.History.KeepLast(500))
        latched = Qos(reliable, Policy.Durability.TransientLocal, Policy.History.KeepLast(10))

        def writer(topic, name, qos):
            return DataWriter(participant, Topic(participant, f"rt/{topic}", self.types[name]), qos=qos)

        self.tf_static = writer("tf_static", "TFMessage", latched)
        self.tf = writer("tf", "TFMessage", Qos(reliable, Policy.History.KeepLast(100)))
        self.odom = writer(drive.topic, "Odometry", plain)
        self.info = writer("front/camera_info", "CameraInfo", plain)
        self.found = writer("front/detections", "Detection2DArray", plain)

    def make(self, name, *args):
        return self.types[name](*args)

    def header(self, stamp, frame):
        ns = round(stamp * 1e9)
        return self.make("Header", self.make("Time", ns // 10**9, ns % 10**9), frame)

    def turn(self, pose):
        from scipy.spatial.transform import Rotation

        return self.make("Quaternion", *Rotation.from_matrix(pose[:3, :3]).as_quat().tolist())

    def transform(self, stamp, parent, child, pose):
        place = self.make("Transform", self.make("Vector3", *pose[:3, 3].tolist()), self.turn(pose))
        return self.make("TFMessage", [self.make("TransformStamped", self.header(stamp, parent), child, place)])

    def odometry(self, stamp, pose):
        zero, none = self.make("Vector3", 0.0, 0.0, 0.0), [0.0] * 36
        place = self.make("Pose", self.make("Point", *pose[:3, 3].tolist()), self.turn(pose))
        body = self.make("PoseWithCovariance", place, [0.01, *none[1:]])
        twist = self.make("TwistWithCovariance", self.make("Twist", zero, zero), none)
        return self.make("Odometry", self.header(stamp, "odom"), "base_link", body, twist)

    def camera_info(self, stamp):
        roi = self.make("RegionOfInterest", 0, 0, 0, 0, False)
        eye, none = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], [0.0] * 12
        header = self.header(stamp, "front_optical_frame")
        return self.make("CameraInfo", header, 480, 640, "plumb_bob", [0.0] * 5, MATRIX, eye, none, 0, 0, roi)

    def detections(self, stamp, boxes):
        """boxes: (cx, cy, width, height, label, score, track)."""
        made, header = [], self.header(stamp, "front_optical_frame")
        zero = self.make("Point", 0.0, 0.0, 0.0), self.make("Quaternion", 0.0, 0.0, 0.0, 1.0)
        pose = self.make("PoseWithCovariance", self.make("Pose", *zero), [0.0] * 36)
        for x, y, width, height, label, score, track in boxes:
            centre = self.make("Pose2D", self.make("Point2D", x, y), 0.0)
            result = self.make("ObjectHypothesisWithPose", self.make("ObjectHypothesis", label, score), pose)
            made.append(self.make("Detection2D", header, [result], self.make("BoundingBox2D", centre, width, height), track))
        return self.make("Detection2DArray", header, made)

    def run(self) -> dict:
        drive = self.drive
        self.tf_static.write(self.transform(0.0, "base_link", "front_optical_frame", BASE_T_CAMERA))
        wait_for(lambda: all(getattr(self, name).get_matched_subscriptions() for name in drive.heard))
        now = time_of_day()
        self.tf.write(self.transform(now, "map", "odom", MAP_T_ODOM))
        self.info.write(self.camera_info(now))
        begin, odometry, frames = time.perf_counter(), 0, 0
        stamps: dict[str, list[float]] = {"odometry": [], "detections": []}
        while (elapsed := time.perf_counter() - begin) < drive.seconds:
            if elapsed * drive.odometry_hz >= odometry:
                now = time_of_day()
                self.odom.write(self.odometry(now, pose_at(odometry / drive.odometry_hz)))
                stamps["odometry"].append(now)
                odometry += 1
            if elapsed * drive.detections_hz >= frames:
                now = time_of_day()
                boxes = [(100.0 + 90 * i, 200.0, 40.0, 60.0, f"cup{i}", 0.9, str(i)) for i in range(5)]
                if frames % 50 == 0:
                    self.info.write(self.camera_info(now))
                self.found.write(self.detections(now, boxes))
                stamps["detections"].append(now)
                frames += 1
            time.sleep(0.0005)
        for _ in range(drive.bad):
            bad = self.detections(time_of_day(), [(100.0, 100.0, 20.0, 20.0, "cup", 0.9, "")])
            data = bytes(bad.serialize()).replace(b"cup\0", b"\xff\xfe\xff\0")
            bad.serialize = lambda *args, data=data, **kwargs: data
            self.found.write(bad)
        last = time_of_day()  # what comes after the bad ones: who has heard that has heard them
        self.found.write(self.detections(last, [(100.0, 100.0, 20.0, 20.0, "cup", 0.9, "")]))
        stamps["detections"].append(last)
        for writer in (self.odom, self.found):
            writer.wait_for_acks(int(LIMIT * 1e9))
        return stamps


if __name__ == "__main__":
    sys.stdout.write(json.dumps(Robot(Drive(**json.loads(sys.argv[1]))).run()))
