"""Measure the time per frame of each part of a detection: read and decode, fit in, network, boxes from outputs, cache.

    python tools/bench_detection.py MODEL.onnx [IMAGE ...] [--frames 100] [--width 640] [--height 480] [--format jpg]

The images are resized, and written in the given format. If no image is given, a drawn picture with noise is used. The tool
prints the median and the 95th percentile of the time of each part, ms per frame, and of all parts except the network. In a
run, other threads read and decode images while the network runs. Here, the parts run one after the other, and OpenCV has one
thread.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from one_line import end_with

from objslam import config
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.detection import load_detector
from objslam.detection.cache import DetectionCache, Entry
from objslam.detection.detect_log import load_frame
from objslam.errors import LogError

PARTS = ("read and decode", "fit in", "network", "boxes from outputs", "write to cache")
ENOUGH = 5.0  # The most time, ms per frame, that all parts except the network should take.


def picture(width: int, height: int) -> np.ndarray:
    """A stand-in for a camera image: shapes, and noise that makes it as hard to decode as a photograph."""
    rng = np.random.default_rng(0)
    image = np.full((height, width, 3), 90, dtype=np.uint8)
    for _ in range(40):
        corner, size = rng.integers(0, (width, height)), rng.integers(10, 200, size=2)
        cv2.rectangle(image, corner.tolist(), (corner + size).tolist(), rng.integers(0, 255, 3).tolist(), -1)
    return np.clip(image + rng.normal(0, 8, image.shape), 0, 255).astype(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("images", type=Path, nargs="*")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--format", choices=["jpg", "png"], default="jpg")
    parser.add_argument("--threads", type=int, default=0, help="the number of threads of the network, 0 for one per core")
    parser.add_argument("--min-score", type=float, default=0.25)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    detector = load_detector(args.model, config.Detector(threads=args.threads, min_score=args.min_score))
    camera = Camera("camera", args.width, args.height, np.eye(3))
    pictures = [cv2.imread(str(path)) for path in args.images] or [picture(args.width, args.height)]
    for path, image in zip(args.images, pictures, strict=False):
        if image is None:
            raise LogError("not an image that can be read", where=str(path))
    rows, found = [], 0
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder, f"{i}.{args.format}") for i in range(len(pictures))]
        for file, image in zip(files, pictures, strict=True):
            cv2.imwrite(str(file), cv2.resize(image, (args.width, args.height), interpolation=cv2.INTER_AREA))
        ledger = Ledger()
        cache, empty = (DetectionCache(Path(folder), name, ledger) for name in ("cache", "empty"))
        for i in range(args.frames + 3):
            stamps = [time.perf_counter()]
            frame = load_frame(files[i % len(files)], camera, empty)
            stamps.append(time.perf_counter())
            blob, where = detector.prepare([frame.image])
            stamps.append(time.perf_counter())
            outputs = detector.network.run(blob)
            stamps.append(time.perf_counter())
            (boxes,) = detector.read(outputs, where, 1)
            stamps.append(time.perf_counter())
            cache.write(frame.digest, Entry(args.width, args.height, boxes))
            stamps.append(time.perf_counter())
            rows.append(np.diff(stamps) * 1e3)
            found += len(boxes.scores)
        cache = DetectionCache(Path(folder), "cache", ledger)  # an open one does not learn from what it writes
        begin = time.perf_counter()
        for i in range(args.frames):
            load_frame(files[i % len(files)], camera, cache)
        again = (time.perf_counter() - begin) / args.frames * 1e3
    parts = np.array(rows[3:])  # the first calls make buffers
    around = np.delete(parts, PARTS.index("network"), axis=1).sum(axis=1)
    layout = detector.recipe.layout
    print(f"{args.model.name} ({layout}) on {args.width}x{args.height} {args.format}, {found / len(rows):.1f} boxes a frame")
    for name, column in [*zip(PARTS, parts.T, strict=True), ("all but the network", around)]:
        print(f"{name:<22}median {np.median(column):7.2f} ms   95 % {np.percentile(column, 95):7.2f} ms")
    print(f"{'a frame from the cache':<22}mean   {again:7.2f} ms")
    print(f"{'within' if np.median(around) <= ENOUGH else 'NOT within'} {ENOUGH:g} ms around the network")


if __name__ == "__main__":
    end_with(main)
