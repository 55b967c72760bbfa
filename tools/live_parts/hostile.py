"""Publishers on DDS that a session does not want: python hostile.py KIND DOMAIN sends until its standard input ends."""

from __future__ import annotations

import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "sources" / "ros"))
from bag_writer import Maker, serialize

ODOMETRY, TF, FOUND = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage", "vision_msgs/msg/Detection2DArray"
FRAME = "front_optical_frame"
FAST, SLOW = 5000.0, 50.0
"""The rates of floods and of single wrong messages, messages per second."""
MAKER = Maker()
EYE = np.eye(4)


def odometry(ahead: float = 0.0) -> bytes:
    """An odometry message whose stamp is ahead, s."""
    return serialize(MAKER, MAKER.odometry(round((time.time() + ahead) * 1e9), EYE))


def with_number(data: bytes, value: float) -> bytes:
    """An odometry message with another w in its quaternion."""
    at = data.index(struct.pack("<d", 1.0))
    return data[:at] + struct.pack("<d", value) + data[at + 8 :]


def huge() -> bytes:
    """A message of 2 MB with 20,000 boxes, twice as many as a session decodes."""
    return serialize(MAKER, MAKER.detections(time.time_ns(), [(1, 2, 30, 40, "cup", 0.9, "7")] * 20_000, FRAME))


def boxes(frame: str) -> bytes:
    return serialize(MAKER, MAKER.detections(round(time.time() * 1e9), [(1, 2, 30, 40, "cup", 0.9, "7")] * 5, frame))


def unknown_frames() -> bytes:
    """Return transforms between frames that nobody knows. The frames are new in each message."""
    now = time.time_ns()
    return serialize(MAKER, MAKER.tf(now, *((f"a{now}{i}", f"b{now}{i}", EYE) for i in range(10))))


RNG = np.random.default_rng(0)
KINDS: dict[str, tuple[str, str, float, Callable[[], bytes]]] = {
    "malformed": ("odom", ODOMETRY, SLOW, lambda: b"\0\1\0\0" + RNG.bytes(4 * int(RNG.integers(0, 200)))),
    "nan": ("odom", ODOMETRY, SLOW, lambda: with_number(odometry(), float("nan"))),
    "negative": ("odom", ODOMETRY, SLOW, lambda: odometry()[:4] + struct.pack("<iI", -100, 0) + odometry()[12:]),
    "future": ("odom", ODOMETRY, SLOW, lambda: odometry(10 ** RNG.uniform(-0.2, 1.8))),
    "huge": ("front/detections", FOUND, 1.0, huge),
    "unknown": ("tf", TF, 500.0, unknown_frames),
    "flood-malformed": ("odom", ODOMETRY, FAST, lambda: b"\0\1\0\0garbage!"),
    "flood-boxes": ("other/detections", FOUND, FAST, lambda data=boxes("nobody"): data),  # type: ignore[misc]
    "flood-tf": ("tf", TF, FAST, lambda data=unknown_frames(): data),  # type: ignore[misc]
}
"""For each kind: the topic, the type, the messages per second, and a function that makes the bytes of the next one. `send`
knows one more kind, "topics"."""


def send(kind: str, domain: int, done: threading.Event) -> int:
    """Send until `done`, and return how many messages went out, or for "topics" how many topics were opened."""
    from cyclonedds.core import Policy, Qos
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    from objslam.live.dds.network import open_network
    from objslam.live.dds.types import layouts_of

    participant = open_network(domain).participant
    plain = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(1))
    if kind == "topics":
        layout, made = layouts_of(ODOMETRY)[0], []
        while not done.wait(0.001) and len(made) < 5000:
            made.append(DataWriter(participant, Topic(participant, f"rt/made/up{len(made)}", layout), qos=plain))
        done.wait()
        return len(made)
    topic, type_, rate, following = KINDS[kind]
    layout, count, begin = layouts_of(type_)[0], 0, time.monotonic()
    writer = DataWriter(participant, Topic(participant, f"rt/{topic}", layout), qos=plain)
    data = following() if kind == "huge" else b""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        while not done.wait(0.001):
            for _ in range(min(500, int((time.monotonic() - begin) * rate) - count)):
                count += 1
                if "malformed" in kind:
                    forge(wire, writer.get_guid().bytes, domain, count, following())
                else:
                    writer.write(layout(data or following()))
    return count


def forge(wire: socket.socket, writer: bytes, domain: int, number: int, payload: bytes) -> None:
    """Send a payload that cyclonedds itself refuses to send, after the RTPS specification, 9.4.5.3. writer: its GUID."""
    body = struct.pack("<HH", 0, 16) + bytes(4) + writer[12:] + struct.pack("<iI", 0, number) + payload
    packet = b"RTPS\x02\x01\x01\x10" + writer[:12] + struct.pack("<BBH", 0x15, 0x05, len(body)) + body
    for index in range(4):
        wire.sendto(packet, ("127.0.0.1", 7400 + 250 * domain + 11 + 2 * index))


def main() -> None:
    done = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), done.set()), daemon=True).start()
    print(send(sys.argv[1], int(sys.argv[2]), done))


if __name__ == "__main__":
    main()
