"""Count the files of the package that a box passes through, and the calls from one file to another on its way.

    python tools/bench_calls.py [--most 20]

offline: a log of five frames with one box each, from the reader to the map, with fixed poses. live: one message with the
boxes of a frame, from its push until the map contains it, as the median over the second half of a simulated drive. A move is
a call of, or a return to, a function in another file of the package. Code with fewer moves is easier to follow.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
from collections import Counter
from pathlib import Path
from types import CodeType, FrameType

import numpy as np

import objslam
from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.live.session.session import Session
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate
from objslam.sources import read

PACKAGE = str(Path(objslam.__file__).parent)
CAMERA = """\
image_width: 640
image_height: 480
camera_matrix: [500, 0, 320, 0, 500, 240, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients: [0, 0, 0, 0, 0]
base_T_camera:
  translation: [0.1, 0.0, 0.3]
  rotation_xyzw: [-0.5, 0.5, -0.5, 0.5]
"""
BOXES = ((205, 207, 226, 232), (192, 203, 215, 231), (175, 198, 202, 229), (153, 192, 184, 228), (124, 183, 159, 226))


class Moves:
    """Counts, in the threads where it is installed, moves between files of the package, and names the files."""

    def __init__(self) -> None:
        self.count = 0
        self.files: set[str] = set()
        self.pairs: Counter[tuple[str, str]] = Counter()
        self._at: dict[int, str] = {}
        self._names: dict[CodeType, str] = {}

    def clear(self) -> None:
        """Begin anew, with the places where the threads are."""
        self.count = 0
        self.files.clear()

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        """What `sys.setprofile` calls at each call and return."""
        if event not in ("call", "return") or frame.f_code.co_name == "<module>" or not (here := self._file(frame.f_code)):
            return
        thread = threading.get_ident()
        if event == "call":
            self.files.add(here)
            self._go(thread, here)
            return
        caller = frame.f_back
        while caller is not None and not self._file(caller.f_code):
            caller = caller.f_back
        if caller is not None:
            self._go(thread, self._file(caller.f_code))

    def _go(self, thread: int, to: str) -> None:
        before = self._at.get(thread)
        if before != to:
            self.count += 1
            self.pairs[before or "", to] += 1
            self._at[thread] = to

    def _file(self, code: CodeType) -> str:
        name = self._names.get(code)
        if name is None:
            path = code.co_filename
            name = self._names[code] = path[len(PACKAGE) + 1 :] if path.startswith(PACKAGE) else ""
        return name


def offline(moves: Moves) -> None:
    """Read a log of five frames and map it."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder)
        (log / "camera.yaml").write_text(CAMERA)
        poses = [f"{10 + i} {i / 2} 0 0 0 0 0 1\n" for i in range(3)]
        (log / "localization.txt").write_text("".join(poses))
        lines = [
            f'{{"stamp": {10 + i / 2}, "boxes": [{list(box)}], "labels": ["cup"], "scores": [0.9]}}\n'
            for i, box in enumerate(BOXES)
        ]
        (log / "detections.jsonl").write_text("".join(lines))
        ledger = Ledger()
        sys.setprofile(moves)
        try:
            result = pipeline.run(read(log, ledger), load_settings(None), ledger)
        finally:
            sys.setprofile(None)
    assert len(result.map) == 1


def live(moves: Moves) -> tuple[float, float]:
    """Files and moves of a message with the boxes of one frame: medians over the second half of a drive."""
    log = simulate(preset("demo", frames=200, localization=None, odometry=Odometry()), 0)
    assert log.odometry is not None
    camera = log.cameras[0]
    found = camera.detections
    assert found is not None
    session = Session(load_settings(None, ("mode=joint",)), patient=True)
    threading.setprofile(moves)
    session.start()
    session.push_camera(camera.camera)
    files, counts, pose = [], [], 0
    total: Counter[tuple[str, str]] = Counter()
    for number, stamp in enumerate(found.frame_stamps):
        while pose < len(log.odometry) and (pose == 0 or log.odometry.stamps[pose - 1] < stamp):
            session.push_odometry(float(log.odometry.stamps[pose]), log.odometry.poses[pose])
            pose += 1
        session.wait()
        mine = np.flatnonzero(found.frame == number)
        labels = [found.label_names[i] for i in found.label[mine]]
        moves.clear()
        before = Counter(moves.pairs)
        sys.setprofile(moves)
        session.push_detections(float(stamp), camera.camera.name, found.boxes[mine], labels, found.scores[mine])
        sys.setprofile(None)
        session.wait()
        if number > len(found.frame_stamps) / 2 and len(mine):
            files.append(len(moves.files))
            counts.append(moves.count)
            total += moves.pairs - before
    threading.setprofile(None)
    session.abort()
    moves.pairs = Counter({pair: round(n / len(counts)) for pair, n in total.items()})
    return float(np.median(files)), float(np.median(counts))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=int, default=0, help="also list this many of the most frequent pairs of files")
    most = parser.parse_args().most
    box, message = Moves(), Moves()
    offline(box)
    print(f"one box offline: {len(box.files)} files, {box.count} moves")
    show(box, most)
    files, count = live(message)
    print(f"one message live: {files:.0f} files, {count:.0f} moves")
    show(message, most)


def show(moves: Moves, most: int) -> None:
    """The most frequent ways."""
    for (one, two), number in moves.pairs.most_common(most):
        print(f"  {number:5d}  {one} -> {two}")


if __name__ == "__main__":
    main()
