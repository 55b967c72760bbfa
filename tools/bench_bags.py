"""Measure how fast bags are read and decoded, and how much memory a large bag takes.

    python tools/bench_bags.py [--messages 200000] [--image-gb 1.0] [--folder DIR]

The tool writes one recording of small messages (odometry, transforms, detections) as each kind of bag. It prints how many
messages per second are read and decoded, and the ratio to AnyReader of rosbags. AnyReader only decodes the messages. objslam
also collects and checks poses and boxes, and builds the tf tree. Then the tool writes a bag of raw images. A second process
reads this bag and writes the images to files, and the tool prints the peak memory of the second process. The bags are in a
temporary folder, in DIR if it is given, and are deleted at the end.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader

from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.sources.ros_bag.log import read_bag
from objslam.sources.ros_bag.options import BagOptions

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "sources" / "ros"))
from bag_writer import Maker, Raw, serialize, write_bag

_KINDS = ("bag", "bag-lz4", "sqlite3", "mcap-none", "mcap-zstd")
_CAMERA = Camera("c", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
_FRAME = "c_optical_frame"


def small_rows(maker: Maker, count: int) -> list[tuple[str, int, object]]:
    """Return messages 5 ms apart: in turn two of odometry, one of tf, and one of detections with one to three boxes."""
    rows: list[tuple[str, int, object]] = [
        ("/c/camera_info", 0, maker.camera_info(0, _CAMERA, _FRAME)),
        ("/tf_static", 0, maker.tf(0, ("base_link", _FRAME, np.eye(4)))),
    ]
    poses = lift_se2(np.cumsum(np.full((count, 3), [0.01, 0.002, 0.001]), axis=0))
    for i in range(count - 2):
        stamp = (i + 1) * 5_000_000
        if i % 4 < 2:
            rows.append(("/odom", stamp, maker.odometry(stamp, poses[i])))
        elif i % 4 == 2:
            rows.append(("/tf", stamp, maker.tf(stamp, ("map", "odom", poses[i]))))
        else:
            boxes = [(10, 10, 50 + j, 60, j, 0.5) for j in range(1 + i // 4 % 3)]
            rows.append(("/c/detections", stamp, maker.detections(stamp, boxes, _FRAME)))
    return [(topic, stamp, Raw(serialize(maker, message), message.__msgtype__)) for topic, stamp, message in rows]


def bench_small(folder: Path, count: int, repeat: int) -> None:
    """Messages per second of each kind of bag: the fastest of some runs."""
    for vision in "14":
        maker = Maker(vision)
        rows = small_rows(maker, count)
        for kind in _KINDS:
            if kind.startswith("bag") != (vision == "1"):
                continue
            path = write_bag(folder / kind, kind, maker, rows)
            ours, theirs = [], []
            for _ in range(repeat):
                begin = time.process_time()  # one thread's work, whatever else the machine does
                log = read_bag(path, Ledger())
                ours.append(time.process_time() - begin)
                begin = time.process_time()
                with AnyReader([path], default_typestore=maker.store) as reader:
                    for connection, _, data in reader.messages():
                        reader.deserialize(data, connection.msgtype)
                theirs.append(time.process_time() - begin)
            assert log.odometry is not None
            assert log.cameras[0].detections is not None
            size = sum(f.stat().st_size for f in ([path] if path.is_file() else path.iterdir())) / 1e6
            print(
                f"{kind:<10}{count:>9} messages {size:8.1f} MB {min(ours):7.2f} s {count / min(ours):10,.0f} messages/s, "
                f"{min(theirs) / min(ours):.2f} times as fast as rosbags' AnyReader that decodes and keeps nothing",
                flush=True,
            )


def bench_images(folder: Path, gigabytes: float) -> None:
    """Peak memory and time of reading a bag of raw images, in a process of its own."""
    maker = Maker("4")
    count = max(int(gigabytes * 1e9 / (1280 * 720 * 3)), 1)
    noise = np.random.default_rng(0).integers(0, 256, (720, 1280, 3)).astype(np.uint8)

    def rows():  # type: ignore[no-untyped-def]
        yield from small_rows(maker, 2)
        for i in range(count):
            stamp = (i + 1) * 33_000_000
            yield "/odom", stamp, maker.odometry(stamp, np.eye(4))
            yield "/c/image_raw", stamp, maker.image(stamp, np.roll(noise, i, axis=1), "bgr8", _FRAME)

    path = write_bag(folder / "images", "mcap-none", maker, rows())
    command = [sys.executable, __file__, "--child", str(path), "--folder", str(folder / "out")]
    begin = time.perf_counter()
    memory = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    seconds = time.perf_counter() - begin
    print(
        f"images    {count:>9} images {path.stat().st_size / 1e6:10.1f} MB {seconds:7.2f} s, at most {memory} MB of memory"
    )


def peak_memory() -> int:
    """The most memory that this process had, MB. getrusage would count what its parent had before it started this one."""
    found = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return int(found[1]) // 1000 if found else -1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--messages", type=int, default=200_000)
    parser.add_argument("--image-gb", type=float, default=1.0)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child is not None:
        log = read_bag(args.child, Ledger(), BagOptions(extract=args.folder))
        assert log.cameras[0].rgb is not None
        print(peak_memory())
        return
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        bench_small(Path(folder), args.messages, args.repeat)
        if args.image_gb > 0:
            bench_images(Path(folder), args.image_gb)


if __name__ == "__main__":
    main()
