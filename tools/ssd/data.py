"""Training images: random rooms, lights, cameras and exposures, rendered at 640x480 and kept at the network's size."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from objslam.core.geometry import lift_se2
from objslam.errors import ConfigError
from objslam.simulation import make_camera
from objslam.simulation.furniture import Room, furnish_room
from objslam.simulation.raycast import Caster
from objslam.simulation.render import BoxLimits, true_boxes
from objslam.simulation.sensor import Sensor, expose, exposures
from objslam.simulation.shapes import LABELS

SIZE = (320, 240)
"""Width and height of the network's input, px: half of the rendered image."""
RAW_SCALE = 2.0
"""The number of px of the rendered image for one px of the network's input."""
VIEWS = 8
"""The number of images taken in each room."""
COPIES = (1, 2, 3)
"""How many copies of each object a room may have. More copies show the detector more objects, fewer leave room for other
things."""


@dataclass(frozen=True)
class Samples:
    """Images (N, H, W, 3) RGB with their boxes, one row a box, in the order of the images.

    image: (M,) index. boxes: (M, 4) x1, y1, x2, y2, px of these images. label: (M,) index into LABELS. counts: (M,) False
    for objects that are too hidden or too small. A detector need not learn or find them.
    """

    images: NDArray[np.uint8]
    image: NDArray[np.int64]
    boxes: NDArray[np.float32]
    label: NDArray[np.int64]
    counts: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.images)

    def of(self, number: int) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.bool_]]:
        """Boxes, labels and counts of one image."""
        start, end = np.searchsorted(self.image, [number, number + 1])
        return self.boxes[start:end], self.label[start:end], self.counts[start:end]

    @classmethod
    def join(cls, parts: list[Samples]) -> Samples:
        """The images of all parts."""
        starts = np.cumsum([0, *(len(part) for part in parts)])
        image = np.concatenate([part.image + start for part, start in zip(parts, starts, strict=False)])
        columns = ("images", "boxes", "label", "counts")
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in columns}
        return cls(image=image, **joined)

    def save(self, file: Path) -> None:
        """Write an .npz file, whole or not at all."""
        work = file.with_suffix(".part")
        with work.open("wb") as stream:
            np.savez(stream, images=self.images, image=self.image, boxes=self.boxes, label=self.label, counts=self.counts)
        work.rename(file)

    @classmethod
    def load(cls, file: Path) -> Samples:
        """Read what `save` wrote."""
        with np.load(file) as arrays:
            return cls(**{name: arrays[name] for name in ("images", "image", "boxes", "label", "counts")})


def random_room(rng: np.random.Generator) -> tuple[Room, tuple[float, float]]:
    """A room of random size with several of each object, and its size."""
    for copies in range(int(rng.choice(COPIES)), 0, -1):
        size = (float(rng.uniform(4.6, 7.5)), float(rng.uniform(4.2, 6.5)))
        try:
            return furnish_room(size, LABELS * copies, rng), size
        except ConfigError:
            continue  # too little furniture came about: fewer objects
    raise ConfigError("a random room has no place for the objects")


def render_room(seed: np.random.SeedSequence, views: int = VIEWS) -> Samples:
    """Images of one random room, each from another camera and under another exposure."""
    rng = np.random.default_rng(seed)
    room, size = random_room(rng)
    sensor = Sensor(
        blur=float(rng.uniform(0.3, 0.9)),
        shot=float(rng.uniform(0.01, 0.04)),
        read=float(rng.uniform(0.003, 0.012)),
        exposure=0.3,
    )
    focal = float(rng.uniform(370, 480))
    caster = Caster(room, make_camera(focal=focal), int(rng.integers(1 << 31)))
    images, image, boxes, label, counts = [], [], [], [], []
    for number, gain in enumerate(rng.permutation(exposures(sensor, 50 * views, rng))[:views]):
        height, pitch = float(rng.uniform(0.85, 1.15)), float(rng.uniform(-0.38, -0.12))
        camera = make_camera(focal=focal, position=(0.0, 0.0, height), pitch=pitch)
        reach = np.array(size) / 2 - 1.0
        target = room.middle[rng.integers(len(room.middle)), :2]
        spots = rng.uniform(-reach, reach, (8, 2))
        distance = np.linalg.norm(spots - target, axis=1)
        spot = spots[np.argmin(np.abs(distance - rng.uniform(0.9, 4.0)))]
        way = target - spot
        yaw = np.arctan2(way[1], way[0]) + rng.uniform(-0.5, 0.5)
        map_T_camera = lift_se2(np.array([*spot, yaw])) @ camera.base_T_camera
        cast = caster.cast(map_T_camera)
        rgb = expose(sensor, caster.shade(cast, map_T_camera[:3, 3]), gain, rng)
        found = true_boxes(caster, cast, map_T_camera, BoxLimits())
        images.append(cv2.resize(rgb, SIZE, interpolation=cv2.INTER_AREA))
        image.append(np.full(len(found.object), number))
        boxes.append((found.box / RAW_SCALE).astype(np.float32))
        label.append(found.object % len(LABELS))
        counts.append(found.counts)
    return Samples(np.stack(images), *(np.concatenate(column) for column in (image, boxes, label, counts)))


def render_samples(folder: Path, kind: str, images: int, seed: int, shard: int = 240, views: int = VIEWS) -> None:
    """Render images into `folder`/`kind`-*.npz. Files that exist stay, so a killed run goes on where it was. images: their
    number.

    kind: "train" or "held_out". The two never share a room or a seed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    root = np.random.SeedSequence([seed, {"train": 0, "held_out": 1}[kind]])
    rooms = root.spawn(-(-images // views))
    per_shard = max(shard // views, 1)
    for number, start in enumerate(range(0, len(rooms), per_shard)):
        file = folder / f"{kind}-{number:04d}.npz"
        if not file.exists():
            Samples.join([render_room(room, views) for room in rooms[start : start + per_shard]]).save(file)
            print(f"{file.name}: {min(start + per_shard, len(rooms)) * views} of {len(rooms) * views} images", flush=True)


def shard_files(folder: Path, kind: str) -> list[Path]:
    """The files with images of a kind that are there."""
    return sorted(folder.glob(f"{kind}-*.npz"))


def load_samples(folder: Path, kind: str) -> Samples:
    """All images of a kind that are there."""
    files = shard_files(folder, kind)
    if not files:
        raise FileNotFoundError(f"no {kind} images in {folder}: render them first")
    return Samples.join([Samples.load(file) for file in files])
