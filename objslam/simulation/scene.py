"""Draw the standing and the moving objects of a simulated drive."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, count, islice

import numpy as np
from scipy.spatial import cKDTree

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.core.types import label_table
from objslam.errors import ConfigError
from objslam.simulation.detector import views
from objslam.simulation.settings import DriveSettings
from objslam.simulation.trajectory import START, Path

EXTENTS = {
    "cup": (0.09, 0.11), "bottle": (0.08, 0.26), "plant": (0.28, 0.38), "book": (0.16, 0.23),
    "clock": (0.25, 0.25), "vase": (0.14, 0.24), "backpack": (0.32, 0.42), "teddy bear": (0.26, 0.32),
    "laptop": (0.33, 0.23), "ball": (0.22, 0.22), "bowl": (0.18, 0.1), "lamp": (0.22, 0.4),
}  # fmt: skip
"""The width and height of each class, m. Drives use the classes in this order."""
OTHER_EXTENT = (0.2, 0.2)  # The width and height of objects of other classes, m.
WALL = 0.3  # The least distance of random objects from the walls, m.
CLEARANCE = 0.4  # The least horizontal distance of random objects from the path, m.
CHECKED_FRAMES = 500
"""The largest number of images of each camera in which the position of a new object is tested. These images are evenly
spaced."""
ROUNDS = 50  # The largest number of sets of random positions. With more sets, positions are found for more objects.


@dataclass(frozen=True)
class Scene:
    """The standing objects. label: (N,) indices into `classes`. position: (N, 3) the centres in map, m. extent: (N, 2) the
    width and height, m."""

    classes: tuple[str, ...]
    label: Ints
    position: Floats
    extent: Floats


@dataclass(frozen=True)
class Roamers:
    """The moving objects, which oscillate along each axis.

    label: (K,) indices into the classes of the scene. extent: (K, 2) width and height, m. middle (m), reach (m), rate
    (rad/s), phase (rad): (K, 3) the parameters of the oscillation along each axis.
    """

    label: Ints
    extent: Floats
    middle: Floats
    reach: Floats
    rate: Floats
    phase: Floats

    def at(self, stamps: Floats) -> Floats:
        """Return the positions (F, K, 3), m, in map at stamps (F,), s."""
        return self.middle + self.reach * np.sin(self.rate * (stamps - START)[:, None, None] + self.phase)


def furnish(settings: DriveSettings, path: Path, frame_stamps: Floats, rng: np.random.Generator) -> Scene:
    """Place the objects of `settings.placed`, and random objects at positions that the cameras see well.

    frame_stamps: (F, C) the stamps of the images of C cameras, s. Raises ConfigError if there are not enough such positions.
    """
    numbered = (f"{name} {number}" for number in count(2) for name in EXTENTS)
    names = list(islice(chain(EXTENTS, numbered), settings.classes or settings.objects))
    labels = [name for name, _ in settings.placed] + [names[i % len(names)] for i in range(settings.objects)]
    classes, label = label_table(labels)
    random_extent = _extents(labels[len(settings.placed) :])
    positions = np.array([place for _, place in settings.placed]).reshape(-1, 3)
    positions = np.concatenate([positions, _places(settings, path, frame_stamps, random_extent, rng)])
    return Scene(classes, label, positions, _extents(labels))


def roam(settings: DriveSettings, scene: Scene, rng: np.random.Generator) -> Roamers:
    """Draw objects that move through the whole room at about 0.3 m/s. They have the classes of the scene."""
    moving = settings.moving
    label = rng.integers(max(len(scene.classes), 1), size=moving)
    low, high = _bounds(settings)
    middle = np.column_stack([np.zeros((moving, 2)), rng.uniform(low[2], high[2], moving)])
    reach = np.tile([high[0], high[1], 0.0], (moving, 1))
    rate = rng.uniform(0.2, 0.4, (moving, 3)) / np.maximum(reach, 1.0)
    extent = _extents([scene.classes[i] for i in label])
    return Roamers(label, extent, middle, reach, rate, rng.uniform(0.0, 2 * np.pi, (moving, 3)))


def _extents(labels: Sequence[str]) -> Floats:
    return np.array([EXTENTS.get(label.rstrip(" 0123456789"), OTHER_EXTENT) for label in labels]).reshape(-1, 2)


def _bounds(settings: DriveSettings) -> tuple[Floats, Floats]:
    """Return the lower and the upper bounds of the positions of random objects, (3,) each, m."""
    half = np.array(settings.room) / 2 - WALL
    return np.array([*-half, settings.heights[0]]), np.array([*half, settings.heights[1]])


def _places(settings: DriveSettings, path: Path, frame_stamps: Floats, extent: Floats, rng: np.random.Generator) -> Floats:
    """Return random positions (N, 3) in map, m, that are good (`_good`) and at least `min_distance` apart.

    extent: (N, 2) the width and height of the objects, m. Raises ConfigError if there are not enough such positions.
    """
    places = np.zeros((0, 3))
    for _ in range(ROUNDS):
        if len(places) == settings.objects:
            break
        proposed = rng.uniform(*_bounds(settings), (4 * settings.objects + 64, 3))
        for place in proposed[_good(settings, path, frame_stamps, proposed, extent.max(axis=0))]:
            if len(places) < settings.objects and (np.linalg.norm(places - place, axis=1) >= settings.min_distance).all():
                places = np.vstack([places, place])
    if len(places) < settings.objects:
        raise ConfigError(
            f"only {len(places)} of {settings.objects} objects have a position that the cameras see well",
            where=settings.name,
            hint="set fewer objects, more frames, or a lower min_distance, min_view_share or min_parallax_deg",
        )
    return places


def _good(settings: DriveSettings, path: Path, frame_stamps: Floats, places: Floats, extent: Floats) -> Bools:
    """Return a mask (P,) of the good positions. A good position is far enough from the path, and enough images see it, with
    enough parallax. places: (P, 3) the positions in map, m. extent: (2,) the width and height of an object, m."""
    way = path.at(START + np.linspace(0.0, path.lap, 1000))[:, :2]
    free = cKDTree(way).query(places[:, :2])[0] >= CLEARANCE
    checked = np.linspace(0, settings.frames - 1, min(settings.frames, CHECKED_FRAMES)).astype(int)
    seen = np.zeros((len(checked), len(settings.cameras), len(places)), dtype=bool)
    directions = np.zeros((*seen.shape, 3))
    for i, camera in enumerate(settings.cameras):
        map_T_camera = lift_se2(path.at(frame_stamps[checked, i])) @ camera.base_T_camera
        view = views(settings, camera, map_T_camera, places, np.tile(extent, (len(places), 1)))
        seen[view.frame, i, view.object] = True
        directions[:, i] = places - map_T_camera[:, None, :3, 3]
    often = seen.sum(axis=(0, 1)) >= settings.min_view_share * len(checked)
    spread = _spread(directions.reshape(-1, len(places), 3), seen.reshape(-1, len(places)))
    return np.asarray(free & often & (spread >= np.deg2rad(settings.min_parallax_deg)))


def _spread(directions: Floats, seen: Bools) -> Floats:
    """Return a lower bound (P,), rad, of the widest angle between the V directions of each position.

    directions: (V, P, 3). seen: (V, P) a mask of the directions that count.
    """
    # Start at one direction. Twice, go to the direction that is furthest away. In a plane, this gives the widest angle.
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    pick = seen.argmax(axis=0)
    for _ in range(2):
        cosine = np.where(seen, np.abs(np.einsum("vci,ci->vc", unit, unit[pick, np.arange(len(pick))])), 1.0)
        pick = cosine.argmin(axis=0)
    return np.asarray(np.arccos(np.clip(cosine.min(axis=0), 0.0, 1.0)))
