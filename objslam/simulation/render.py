"""Render drives of a robot with an RGB-D camera into log folders. The room has furniture and the paper's seven objects."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, InstanceOf, model_validator

from objslam import config
from objslam.config import NotNegative, Positive, Section
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera
from objslam.core.geometry import lift_se2, widest_angle
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Images, Log, Truth, TruthObject, label_table
from objslam.errors import ConfigError
from objslam.simulation.furniture import Room, furnish_room, object_sizes
from objslam.simulation.raycast import Cast, Caster
from objslam.simulation.sensor import Sensor, expose, exposures, measure_depth
from objslam.simulation.settings import CourseSettings, DriveSettings, PoseNoise, Probability, make_camera
from objslam.simulation.shapes import LABELS
from objslam.simulation.trajectory import Path as Course
from objslam.simulation.trajectory import frame_stamps, localization, odometry

TRUTH_BOXES = "boxes.jsonl"
"""The name of the file of true boxes, which is in the groundtruth folder. It has the format of detections.jsonl."""
ROUNDS = 40  # The largest number of random rooms that are tried. With more rooms, more settings lead to a good room.
LOOK_AHEAD = 4
"""The divisor of the width and the height of the images while a room is tried. With a larger divisor, the trial is faster
and less exact."""


class BoxLimits(Section):
    """The limits within which a true box counts. Boxes outside them are too small or too hidden for a detector."""

    visible: Probability = 0.6  # The least visible share of the pixels that the object would cover if nothing hid it.
    inside: Probability = 0.6  # The least share of the box area that is inside the image.
    long_side: NotNegative = 20.0  # The least length of a box's longer side, px.
    short_side: NotNegative = 10.0  # The least length of a box's shorter side, px.


class RenderSettings(CourseSettings):
    """The settings of a rendered drive. Furniture reaches 0.6 m into the room."""

    name: str = "rendered drive"
    room: tuple[Positive, Positive] = (6.0, 5.0)
    margin: Positive = 1.3
    frames: Annotated[int, Field(ge=2)] = 220
    laps: Positive = 1.0
    odometry: config.Odometry | PoseNoise | None = config.Odometry()
    localization: PoseNoise | None = PoseNoise(xy=0.02, yaw=0.005)
    camera: InstanceOf[Camera] = make_camera(focal=400.0, position=(0.1, 0.0, 1.0), pitch=-0.25)
    labels: tuple[str, ...] = LABELS  # The labels of the objects in the room. A label may be repeated.
    min_views: Annotated[int, Field(ge=0)] = 18
    """The least number of images in which each object has a good box. A good box is within `limits`, and the image's edge
    does not cut it off."""
    min_parallax_deg: NotNegative = 33.0  # The least parallax of each object over the images with a good box, degrees.
    limits: BoxLimits = BoxLimits()
    sensor: Sensor = Sensor()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        unknown = sorted(set(self.labels) - set(LABELS))
        if unknown:
            raise ValueError(f"no object is called {unknown[0]!r}; there are {', '.join(LABELS)}")
        self.motion  # noqa: B018  DriveSettings checks its own fields.
        return self

    @property
    def motion(self) -> DriveSettings:
        """The settings of the same drive without images."""
        course = {name: getattr(self, name) for name in CourseSettings.model_fields}
        return DriveSettings(**course, cameras=(self.camera,))


@dataclass(frozen=True)
class TrueBoxes:
    """The boxes around the visible pixels of the M objects in an image.

    object: (M,) the ids. box: (M, 4) x1, y1, x2, y2, px. A box around the one pixel (0, 0) is (0, 0, 1, 1), as in detectors.
    depth: (M,) the median z of the visible pixels, m. counts: (M,) whether the box is within `BoxLimits`.
    cut: (M,) whether the box touches the image's edge.
    """

    object: Ints
    box: Floats
    depth: Floats
    counts: Bools
    cut: Bools


def true_boxes(caster: Caster, cast: Cast, map_T_camera: Floats, limits: BoxLimits, scale: float = 1.0) -> TrueBoxes:
    """Return the true boxes of an image, sorted by object. The limits in px apply to an image that is `scale` times as
    large, because rooms are tried with small images."""
    owner = caster.owners(cast)
    rows, columns = np.nonzero(owner >= 0)
    objects, place, visible = np.unique(owner[rows, columns], return_inverse=True, return_counts=True)
    order = np.lexsort((cast.depth[rows, columns], place))
    first = np.cumsum(visible) - visible
    depth = cast.depth[rows, columns][order][first + visible // 2].astype(np.float64)
    x, y = columns[order], rows[order]
    low, high = np.minimum.reduceat, np.maximum.reduceat
    box = np.stack([low(x, first), low(y, first), high(x, first) + 1, high(y, first) + 1], axis=-1).astype(np.float64)
    size = box[:, 2:] - box[:, :2]
    cut = np.asarray((box[:, :2] <= 0).any(axis=1) | (box[:, 2:] >= owner.shape[::-1]).any(axis=1))
    large = (size.max(axis=1) * scale >= limits.long_side) & (size.min(axis=1) * scale >= limits.short_side)
    whole = visible >= limits.visible * caster.silhouettes(map_T_camera, objects)
    left = ~cut
    left[cut] = size[cut].prod(axis=1) >= limits.inside * caster.full_sizes(map_T_camera, objects[cut]).prod(axis=1)
    return TrueBoxes(objects, box, depth, large & whole & left, cut)


def render_drive(
    settings: RenderSettings,
    seed: int,
    out: Path,
    *,
    overwrite: bool = False,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render a drive and write it as a log folder with images, odometry, localisation and ground truth. Returns `out`.

    The same settings and seed give the same log for any number of workers (threads, by default one per core and at most 4).
    groundtruth/ holds the path, the centres of the objects' bounding boxes, the objects' sizes and yaws, and the true boxes
    (`TRUTH_BOXES`). progress: a function that gets the number of images rendered so far and the number of all images. Raises
    ConfigError if no room shows every object well enough, and OutputError if `check_target` refuses `out`.
    """
    import cv2

    from objslam.io.detections_jsonl import write_detections
    from objslam.sources.log_folder import TRUTH, beside, check_target, write_log_folder

    check_target(out, overwrite)
    seeds = np.random.SeedSequence(seed).spawn(5)
    path_rng, odometry_rng, localization_rng = (np.random.default_rng(s) for s in seeds[:3])
    motion = settings.motion
    course = Course.lay(motion, path_rng)
    stamps = frame_stamps(motion)[:, 0]
    map_T_base = lift_se2(course.at(stamps))
    map_T_camera = map_T_base @ settings.camera.base_T_camera
    room = _good_room(settings, map_T_camera, seeds[4])
    caster = Caster(room, settings.camera, seed)
    caster.prepare()
    gains = exposures(settings.sensor, settings.frames, np.random.default_rng(seeds[3]))
    grain_seeds = seeds[3].spawn(settings.frames)
    with beside(out) as work:
        rgb_files = tuple(work / "rgb" / f"{i:06d}.jpg" for i in range(settings.frames))
        depth_files = tuple(work / "depth" / f"{i:06d}.png" for i in range(settings.frames))
        for files in (rgb_files, depth_files):
            files[0].parent.mkdir()

        def render(i: int) -> TrueBoxes:
            rng = np.random.default_rng(grain_seeds[i])
            cast = caster.cast(map_T_camera[i])
            rgb = expose(settings.sensor, caster.shade(cast, map_T_camera[i, :3, 3]), gains[i], rng)
            depth = measure_depth(settings.sensor, cast.depth, rng)
            units = np.clip(depth * settings.camera.depth_scale + 0.5, 0, 65535).astype(np.uint16)
            jpg = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 93])[1]
            png = cv2.imencode(".png", units, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
            for file, content in ((rgb_files[i], jpg), (depth_files[i], png)):
                file.write_bytes(content.tobytes())
            return true_boxes(caster, cast, map_T_camera[i], settings.limits)

        boxes = []
        pool = ThreadPoolExecutor(workers or min(os.cpu_count() or 1, 4))
        try:
            for found in pool.map(render, range(settings.frames)):
                boxes.append(found)
                if progress is not None:
                    progress(len(boxes), settings.frames)
        finally:
            pool.shutdown(cancel_futures=True)  # After an error, no further frame is rendered.
        size, yaw = object_sizes(room)
        objects = tuple(TruthObject(i, label, room.middle[i], size[i], float(yaw[i])) for i, label in enumerate(room.labels))
        log = Log(
            name=settings.name,
            cameras=(CameraLog(settings.camera, None, Images(stamps, rgb_files), Images(stamps, depth_files)),),
            odometry=odometry(motion, course, stamps, odometry_rng),
            localization=localization(motion, course, stamps, localization_rng),
            truth=Truth(objects, Trajectory(stamps, map_T_base)),
        )
        write_log_folder(log, out, overwrite=overwrite)
        write_detections(_as_detections(boxes, stamps, room.labels), out / TRUTH / TRUTH_BOXES)
    return out


def drive_room(settings: RenderSettings, seed: int) -> Room:
    """Return the room that `render_drive` renders for the same settings and seed. Raises ConfigError if there is none."""
    seeds = np.random.SeedSequence(seed).spawn(5)
    course = Course.lay(settings.motion, np.random.default_rng(seeds[0]))
    stamps = frame_stamps(settings.motion)[:, 0]
    return _good_room(settings, lift_se2(course.at(stamps)) @ settings.camera.base_T_camera, seeds[4])


def _as_detections(frames: list[TrueBoxes], stamps: Floats, labels: tuple[str, ...]) -> Detections:
    """Return the true boxes within the limits as detections, with score 1 and the objects' ids as track ids."""
    names, label = label_table(labels)
    joined = {name: np.concatenate([getattr(f, name)[f.counts] for f in frames]) for name in ("object", "box", "depth")}
    frame = np.repeat(np.arange(len(frames)), [int(f.counts.sum()) for f in frames])
    track = joined["object"].astype(np.int64)
    return Detections(stamps, frame, joined["box"], label[track], np.ones(len(frame)), joined["depth"], track, names)


def _good_room(settings: RenderSettings, map_T_camera: Floats, seed: np.random.SeedSequence) -> Room:
    """Return the first random room in which the drive sees every object in enough images and with enough parallax."""
    camera = settings.camera
    matrix = camera.matrix.copy()
    matrix[:2] /= LOOK_AHEAD
    small = replace(camera, width=camera.width // LOOK_AHEAD, height=camera.height // LOOK_AHEAD, matrix=matrix)
    worst = ""
    for child in seed.spawn(ROUNDS):
        room = furnish_room(settings.room, settings.labels, np.random.default_rng(child))
        caster = Caster(room, small)
        views: list[list[Floats]] = [[] for _ in room.labels]
        for pose in map_T_camera:
            found = true_boxes(caster, caster.cast(pose), pose, settings.limits, LOOK_AHEAD)
            for number in found.object[found.counts & ~found.cut]:
                views[number].append(room.middle[number] - pose[:3, 3])
        poor = [i for i, seen in enumerate(views) if not _seen_well(np.array(seen).reshape(-1, 3), settings)]
        if not poor:
            return room
        worst = room.labels[poor[0]]
    raise ConfigError(
        f"in each of {ROUNDS} random rooms, an object is not seen well enough (in the last room: {worst})",
        where=settings.name,
        hint="set more frames or laps, or a lower min_views or min_parallax_deg",
    )


def _seen_well(towards: Floats, settings: RenderSettings) -> bool:
    if len(towards) < settings.min_views:
        return False
    directions = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return widest_angle(directions) >= np.deg2rad(settings.min_parallax_deg)
