"""Measure losses and delays of messages over DDS on the loopback interface, and compare with a bare cyclonedds reader.

python tools/bench_dds.py [--seconds 30] [--sink session|count] [--best-effort]
python tools/bench_dds.py --beside none malformed flood-tf ...      # beside publishers that send what they should not

A robot in another process sends 200 odometry messages and 20 Detection2DArray of 5 boxes per second. The delay `accepted`
begins just before a message is written, and ends when its push is accepted. The bare reader runs at the same time in a third
process, on the same topics. Its delay ends when it has the bytes, which it does not decode. --beside runs once for each kind
of hostile publisher (tools/live_parts/hostile.py), and prints a table. MB is what the process of the session grew by,
and CPU the share of a core that it took. A process that gets less than it needs, on a busy computer, loses messages.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from live_parts import hostile
from live_parts.hostile import KINDS

from objslam.core.camera import Camera

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "sources" / "ros"))
from bag_writer import Maker, serialize

ODOMETRY, TF = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
INFO, FOUND = "sensor_msgs/msg/CameraInfo", "vision_msgs/msg/Detection2DArray"
RATES = {"odometry": 200.0, "detections": 20.0}
BASE_T_CAMERA = np.array([[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
FRAME = "front_optical_frame"
CAMERA = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--domain", type=int, default=77)
    parser.add_argument("--sink", choices=("session", "count"), default="session", help="count: only times, without a map")
    parser.add_argument("--best-effort", action="store_true")
    parser.add_argument("--beside", nargs="+", choices=("none", "topics", *KINDS), help="hostile publishers, in turn")
    parser.add_argument("--as-json", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--role", choices=("robot", "bare"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role == "robot":
        print(json.dumps(drive(options)))
    elif options.role == "bare":
        print(json.dumps(read_bare(options)))
    elif options.beside:
        beside(options)
    else:
        compare(options)


def beside(options: argparse.Namespace) -> None:
    """Run this tool beside each kind of hostile publisher, and print a row of its results for each."""
    print(f"{'beside':16}{'sent':>8}  topic        lost of      p50 ms  p99 ms   bare: lost  p50 ms  p99 ms      MB  CPU %")
    for number, kind in enumerate(options.beside):
        domain = options.domain + number
        command = [sys.executable, str(Path(hostile.__file__)), kind, str(domain)]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        other = None if kind == "none" else subprocess.Popen(command, text=True, **pipes)
        mine = [sys.executable, __file__, "--domain", str(domain), "--seconds", str(options.seconds), "--sink", options.sink]
        mine += ["--as-json", *["--best-effort"] * options.best_effort]
        found = json.loads(subprocess.run(mine, stdout=subprocess.PIPE, text=True, check=True).stdout)
        sent = other.communicate()[0].strip() if other is not None else ""
        for topic, row in found["topics"].items():
            (lost, *own), (bare, *others) = row["accepted"], row["bare reader"]
            times = f"{own[0]:9.1f}{own[1]:9.1f}{bare:12d}{others[0]:9.1f}{others[1]:9.1f}"
            taken = f"{found['megabytes']:8.1f}{found['cpu']:7.0f}"
            print(f"{kind:16}{sent:>8}  {topic:11}{lost:6d} of {row['sent']:<5d}{times}{taken}", flush=True)
        for line in found["lines"]:
            print(f"    {line}", flush=True)


def compare(options: argparse.Namespace) -> None:
    """Run all three at once and print the losses and delays."""
    from objslam.live.adapters.dds import DdsAdapter
    from objslam.live.dds.network import open_network
    from objslam.live.ros.message_handler import RosMessages
    from objslam.live.ros.topic_discovery import TopicChoice
    from objslam.live.session import low_latency

    low_latency.configure()  # as `objslam live` is
    with tempfile.TemporaryDirectory() as folder:
        sink, before = Timed(session(Path(folder)) if options.sink == "session" else None), resident()
        adapter = DdsAdapter(open_network(options.domain), RosMessages(sink), TopicChoice())
        stop, begin = threading.Event(), (time.process_time(), time.monotonic())
        thread = threading.Thread(target=adapter.run, args=(stop,))
        thread.start()
        bare, robot = start(options, "bare"), start(options, "robot")
        sent = json.loads(robot.communicate()[0])
        time.sleep(0.5)
        stop.set()
        thread.join()
        heard = json.loads(bare.communicate("\n")[0])
        cpu = 100 * (time.process_time() - begin[0]) / (time.monotonic() - begin[1])
        grown, told = resident() - before, ""
        if sink.session is not None:
            snapshot = sink.session.snapshot()
            p50, p99 = (f"{1e3 * value:.2f}" for value in snapshot.update)
            told = f"session: {snapshot.keyframes} keyframes, {len(snapshot.map)} objects, update p50 {p50} ms, p99 {p99} ms"
            adapter.ledger.add(sink.session.counters.ledger)
            sink.session.abort()
    topics = {kind: summary(stamps, sink.times[kind], heard[kind]) for kind, stamps in sent.items()}
    if options.as_json:
        print(json.dumps({"topics": topics, "megabytes": grown, "cpu": cpu, "lines": [told, *adapter.ledger.lines()]}))
        return
    print(told)
    for kind, row in topics.items():
        print(f"{kind}: sent {row['sent']} in {options.seconds:g} s")
        for name in ("accepted", "bare reader"):
            lost, p50, p99, most = row[name]
            print(f"  {name:11}  lost {lost}  p50 {p50:.2f} ms  p99 {p99:.2f} ms  most {most:.2f} ms")
        ratio = np.array(row["accepted"][1:3]) / row["bare reader"][1:3]
        print(f"  ratio to the bare reader: p50 {ratio[0]:.2f}, p99 {ratio[1]:.2f}")
    for line in adapter.ledger.lines():
        print(line)


def summary(sent: list[float], accepted: dict[str, float], bare: dict[str, float]) -> dict[str, Any]:
    """How many messages were sent, and for both readers: how many were lost, and the delays of 50 %, 99 % and all, ms."""
    found: dict[str, Any] = {"sent": len(sent)}
    for name, arrived in (("accepted", accepted), ("bare reader", bare)):
        delay = delays(sent, arrived)
        lost = len(sent) - int(np.isfinite(delay).sum())
        found[name] = [lost, *(1e3 * np.quantile(delay, [0.5, 0.99, 1.0])).tolist()]
    return found


def resident() -> float:
    """The resident size of this process, MB."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGESIZE") / 1e6


def delays(sent: list[float], arrived: dict[str, float]) -> np.ndarray:
    """Seconds from sent to there, of the messages that arrived."""
    return np.array([arrived[key] - stamp for stamp in sent if (key := f"{stamp:.6f}") in arrived] or [np.inf])


def session(folder: Path) -> object:
    """A session as `objslam live` starts one, journal included."""
    from objslam.config import load_settings
    from objslam.live.session.session import Session

    return Session(load_settings(None, ("mode=joint",)), folder / "journal").start()


class Timed:
    """A sink that notes when a push is accepted."""

    def __init__(self, session: object | None) -> None:
        self.session = session
        self.times: dict[str, dict[str, float]] = {"odometry": {}, "detections": {}}

    def push_camera(self, camera: object) -> bool:
        return self.session is None or self.session.push_camera(camera)

    def push_localization(self, *args: object) -> bool:
        return self.session is None or self.session.push_localization(*args)

    def push_mount(self, *args: object) -> bool:
        return self.session is None or self.session.push_mount(*args)

    def push_odometry(self, stamp: float, *rest: object) -> bool:
        return self._note("odometry", stamp, self.session is None or self.session.push_odometry(stamp, *rest))

    def push_detections(self, stamp: float, *rest: object, **more: object) -> bool:
        return self._note("detections", stamp, self.session is None or self.session.push_detections(stamp, *rest, **more))

    def _note(self, kind: str, stamp: float, accepted: bool) -> bool:
        if accepted:
            self.times[kind][f"{stamp:.6f}"] = time.time()
        return accepted


def start(options: argparse.Namespace, role: str) -> subprocess.Popen[str]:
    arguments = [
        sys.executable,
        __file__,
        "--role",
        role,
        "--domain",
        str(options.domain),
        "--seconds",
        str(options.seconds),
    ]
    arguments += ["--best-effort"] * options.best_effort
    return subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def read_bare(options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """When each message was there, until a line comes on standard input."""
    from cyclonedds.core import Policy, Qos, ReadCondition, WaitSet
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    from objslam.live.dds.network import open_network
    from objslam.live.dds.types import layouts_of
    from objslam.ros.messages.decode import read_head

    participant = open_network(options.domain).participant
    qos = Qos(
        Policy.Reliability.BestEffort if options.best_effort else Policy.Reliability.Reliable(0),
        Policy.History.KeepLast(1000),
    )
    readers = {}
    waitset = WaitSet(participant)
    for kind, topic, type_ in (("odometry", "rt/odom", ODOMETRY), ("detections", "rt/front/detections", FOUND)):
        readers[kind] = DataReader(participant, Topic(participant, topic, layouts_of(type_)[0]), qos=qos)
        waitset.attach(ReadCondition(readers[kind], 0x7F))
    taken: dict[str, list[tuple[bytes, float]]] = {kind: [] for kind in readers}
    done = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.readline(), done.set()), daemon=True).start()
    while not done.is_set():
        waitset.wait(duration(milliseconds=50))
        for kind, reader in readers.items():
            for sample in reader.take(100):
                if sample.sample_info.valid_data:
                    taken[kind].append((sample.data, time.time()))
    return {kind: {f"{read_head(data, 'cdr')[0] / 1e9:.6f}": at for data, at in rows} for kind, rows in taken.items()}


def drive(options: argparse.Namespace) -> dict[str, list[float]]:
    """Drive past objects on a circle and send what is seen of them; the times just before each message was written."""
    from cyclonedds.core import Policy, Qos
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    from objslam.live.dds.network import open_network
    from objslam.live.dds.types import layouts_of

    participant = open_network(options.domain).participant
    reliable = Policy.Reliability.Reliable(10**8)
    plain = Qos(Policy.Reliability.BestEffort if options.best_effort else reliable, Policy.History.KeepLast(1000))
    latched = Qos(reliable, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))

    maker = Maker()

    def writer(topic: str, type_: str, qos: Qos) -> Callable[[object], None]:
        layout = layouts_of(type_)[0]
        entity = DataWriter(participant, Topic(participant, f"rt/{topic}", layout), qos=qos)
        writers.append(entity)
        return lambda message: entity.write(layout(serialize(maker, message)))

    writers: list[DataWriter] = []
    send_odometry, send_found = writer("odom", ODOMETRY, plain), writer("front/detections", FOUND, plain)
    writer("tf_static", TF, latched)(maker.tf(0, ("base_link", FRAME, BASE_T_CAMERA)))
    writer("front/camera_info", INFO, latched)(maker.camera_info(0, CAMERA, FRAME))
    # Beside a best-effort publisher of the same topic, the session has one more reader.
    while not all(len(w.get_matched_subscriptions()) >= n for w, n in zip(writers, (2, 2, 1, 1), strict=True)):
        time.sleep(0.05)
    time.sleep(0.5)
    world = np.random.default_rng(0).uniform([-6, -4, 0.2], [6, 8, 1.5], (40, 3))
    sent: dict[str, list[float]] = {"odometry": [], "detections": []}
    count, begin = dict.fromkeys(sent, 0), time.perf_counter()
    while (elapsed := time.perf_counter() - begin) < options.seconds:
        due = {kind: begin + count[kind] / rate for kind, rate in RATES.items()}
        kind = min(due, key=lambda name: due[name])
        time.sleep(max(0.0, due[kind] - time.perf_counter()))
        pose, now = circle(elapsed), round(time.time(), 6)
        if kind == "odometry":
            send_odometry(maker.odometry(round(now * 1e9), pose))
        else:
            send_found(maker.detections(round(now * 1e9), boxes(pose, world), FRAME))
        sent[kind].append(now)
        count[kind] += 1
    for entity in writers[:2]:
        entity.wait_for_acks(2 * 10**9)
    return sent


def circle(t: float) -> np.ndarray:
    """odom_T_base on a circle of 2 m at 0.5 m/s."""
    a = 0.25 * t
    c, s = np.cos(a), np.sin(a)
    return np.array([[c, -s, 0, 2 * s], [s, c, 0, 2 - 2 * c], [0, 0, 1, 0], [0, 0, 0, 1]])


def boxes(odom_T_base: np.ndarray, world: np.ndarray) -> list[tuple[float, float, float, float, str, float]]:
    """Boxes of the 5 objects nearest to the middle of the image, as `Maker` takes them."""
    points = np.linalg.inv(odom_T_base @ BASE_T_CAMERA) @ np.column_stack([world, np.ones(len(world))]).T
    ahead = np.flatnonzero(points[2] > 0.5)
    pixels = 500 * points[:2, ahead] / points[2, ahead] + [[320], [240]]
    order = np.argsort(np.abs(pixels - [[320], [240]]).max(axis=0))[:5]
    low, high = pixels - 20, pixels + 20
    return [(low[0, i], low[1, i], high[0, i], high[1, i], f"thing{ahead[i] % 4}", 0.9) for i in order]


if __name__ == "__main__":
    main()
