"""Rendered drives: a robot with an RGB-D camera among furniture and the paper's seven objects, written as a log folder."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, InstanceOf, model_validator

from objslam import config
from objslam.config import NotNegative, Positive, Section
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera
from objslam.core.geometry import lift_se2, widest_angle
from objslam.core.types import CameraLog, Detections, Images, Log, Trajectory, Truth, TruthObject, label_table
from objslam.errors import ConfigError, OutputError
from objslam.simulation.furniture import Room, furnish_room
from objslam.simulation.raycast import Cast, Caster, Reals
from objslam.simulation.sensor import Sensor, expose, exposures, measure_depth
from objslam.simulation.settings import DriveSettings, PoseNoise, Probability, make_camera
from objslam.simulation.shapes import LABELS
from objslam.simulation.trajectory import START, localization, odometry
from objslam.simulation.trajectory import Path as Course

TRUTH_BOXES = "boxes.jsonl"
"""The true boxes of a rendered drive, in its groundtruth folder, in the format of detections.jsonl."""

ROUNDS = 40
LOOK_AHEAD = 4
"""The look at a room before it is rendered takes one pixel in this many."""


class BoxLimits(Section):
    """Which true boxes count: the others are too hidden or too small to ask a detector for."""

    visible: Probability = 0.6
    """share of an object's pixels in the image that nothing hides,"""
    inside: Probability = 0.6
    """and share of its whole box (by area) that the image's edge leaves."""
    long_side: NotNegative = 20.0
    """px; the longer side of a box at least,"""
    short_side: NotNegative = 10.0
    """and the shorter one."""


class RenderSettings(Section):
    """A rendered drive: the room, the robot and its camera, and every error."""

    name: str = "rendered drive"
    room: tuple[Positive, Positive] = (6.0, 5.0)
    """m along x and y; the map's origin is the middle of the floor. Furniture reaches 0.6 m into it."""
    path: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (2, 3)
    """swings along x and y in a lap (a Lissajous curve, no common divisor)."""
    margin: Positive = 1.3
    """m between the path and the walls."""
    frames: Annotated[int, Field(ge=2)] = 220
    frame_rate: Positive = 5.0
    """Hz."""
    laps: Positive = 1.0
    camera: InstanceOf[Camera] = make_camera(focal=400.0, position=(0.1, 0.0, 1.0), pitch=-0.25)
    labels: tuple[str, ...] = LABELS
    """the objects in the room, one each; a label may come more than once."""
    min_views: Annotated[int, Field(ge=0)] = 18
    """every object is seen, whole and within the limits, in this many frames at the least,"""
    min_parallax_deg: NotNegative = 33.0
    """and under at least this parallax."""
    limits: BoxLimits = BoxLimits()
    sensor: Sensor = Sensor()
    odometry: config.Odometry | PoseNoise | None = config.Odometry()
    localization: PoseNoise | None = PoseNoise(xy=0.02, yaw=0.005)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        unknown = sorted(set(self.labels) - set(LABELS))
        if unknown:
            raise ValueError(f"no object is called {unknown[0]!r}; there are {', '.join(LABELS)}")
        self.motion  # noqa: B018  its own checks
        return self

    @property
    def motion(self) -> DriveSettings:
        """The settings of the same drive without images."""
        names = ("name", "room", "path", "margin", "frames", "frame_rate", "laps", "odometry", "localization")
        return DriveSettings(**{name: getattr(self, name) for name in names}, cameras=(self.camera,))


@dataclass(frozen=True)
class TrueBoxes:
    """The boxes of the objects' visible pixels in one image.

    object: (M,). box: (M, 4) px, x1, y1, x2, y2; as detectors have them, the pixel (0, 0) fills the box (0, 0, 1, 1).
    depth: (M,) median z of the visible pixels, m. counts: (M,) whether the box is within the limits. cut: (M,) whether it
    ends at the image's edge.
    """

    object: Ints
    box: Floats
    depth: Floats
    counts: Bools
    cut: Bools


def true_boxes(caster: Caster, cast: Cast, map_T_camera: Floats, limits: BoxLimits, scale: float = 1.0) -> TrueBoxes:
    """The boxes of all objects with a visible pixel, by ascending object; limits are for an image `scale` times as large."""
    owner = caster.owners(cast)
    rows, columns = np.nonzero(owner >= 0)
    objects, place, visible = np.unique(owner[rows, columns], return_inverse=True, return_counts=True)
    order = np.lexsort((cast.depth[rows, columns], place))
    first = np.cumsum(visible) - visible
    depth = cast.depth[rows, columns][order][first + visible // 2].astype(np.float64)
    box = np.zeros((len(objects), 4))
    if len(objects):
        x, y = columns[order], rows[order]
        low, high = np.minimum.reduceat, np.maximum.reduceat
        box[:] = np.stack([low(x, first), low(y, first), high(x, first) + 1, high(y, first) + 1], axis=-1)
    size = box[:, 2:] - box[:, :2]
    height, width = owner.shape
    cut = np.asarray((box[:, :2] <= 0).any(axis=1) | (box[:, 2:] >= np.array([width, height])).any(axis=1))
    large = (size.max(axis=1) * scale >= limits.long_side) & (size.min(axis=1) * scale >= limits.short_side)
    whole = visible >= limits.visible * caster.silhouettes(map_T_camera, objects)
    left = ~cut
    left[cut] = size[cut].prod(axis=1) >= limits.inside * caster.full_sizes(map_T_camera, objects[cut]).prod(axis=1)
    return TrueBoxes(objects, box, depth, large & whole & left, cut)


def render_frame(
    caster: Caster, map_T_camera: Floats, sensor: Sensor, gain: Floats, limits: BoxLimits, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], Reals, TrueBoxes]:
    """One frame from a camera at map_T_camera (4, 4): RGB (H, W, 3), measured depth (H, W) m, and the true boxes."""
    cast = caster.cast(map_T_camera)
    rgb = expose(sensor, caster.shade(cast, map_T_camera[:3, 3]), gain, rng)
    return rgb, measure_depth(sensor, cast.depth, rng), true_boxes(caster, cast, map_T_camera, limits)


def render_drive(
    settings: RenderSettings,
    seed: int,
    out: Path,
    *,
    overwrite: bool = False,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render a drive and write it as a log folder with rgb, depth, odometry, localisation and truth; returns `out`.

    The same settings and seed give the same log, however many workers (threads; None: one a core, at most 4).
    groundtruth/ holds the objects (the middles of their bounding boxes), the path, and the true boxes (`TRUTH_BOXES`).
    progress: called with frames done and frames in all. ConfigError where no room shows every object well enough;
    OutputError where `out` holds something already (and no `overwrite`).
    """
    if out.exists() and not overwrite and (not out.is_dir() or any(out.iterdir())):
        raise OutputError("there is something already", where=str(out), hint="name another folder, or ask to overwrite it")
    from objslam.io.detections_jsonl import write_detections
    from objslam.sources.log_folder import TRUTH, write_log_folder

    seeds = np.random.SeedSequence(seed).spawn(5)
    path_rng, odometry_rng, localization_rng = (np.random.default_rng(s) for s in seeds[:3])
    sensor_seed = seeds[3]
    motion = settings.motion
    course = Course.lay(motion, path_rng)
    stamps = _stamps(settings)
    map_T_base = lift_se2(course.at(stamps))
    map_T_camera = map_T_base @ settings.camera.base_T_camera
    caster = Caster(drive_room(settings, seed), settings.camera, seed)
    caster.prepare()
    out.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        gains = exposures(settings.sensor, settings.frames, np.random.default_rng(sensor_seed))
        for kind, _ in _KINDS:
            (work / kind).mkdir()
        grain_seeds = sensor_seed.spawn(settings.frames)

        def render(i: int) -> TrueBoxes:
            rng = np.random.default_rng(grain_seeds[i])
            rgb, depth, found = render_frame(caster, map_T_camera[i], settings.sensor, gains[i], settings.limits, rng)
            _write_images(work, i, rgb, depth * settings.camera.depth_scale)
            return found

        boxes = []
        pool = ThreadPoolExecutor(workers or min(os.cpu_count() or 1, 4))
        try:
            for found in pool.map(render, range(settings.frames)):
                boxes.append(found)
                if progress is not None:
                    progress(len(boxes), settings.frames)
        finally:
            pool.shutdown(cancel_futures=True)  # a drive that is given up ends at once
        rgb_files, depth_files = (tuple(work / kind / f"{i:06d}.{end}" for i in range(len(stamps))) for kind, end in _KINDS)
        room = caster.room
        objects = tuple(TruthObject(i, label, room.middle[i]) for i, label in enumerate(room.labels))
        log = Log(
            name=settings.name,
            cameras=(CameraLog(settings.camera, rgb=Images(stamps, rgb_files), depth=Images(stamps, depth_files)),),
            odometry=odometry(motion, course, stamps, odometry_rng),
            localization=localization(motion, course, stamps, localization_rng),
            truth=Truth(objects, Trajectory(stamps, map_T_base)),
        )
        write_log_folder(log, out, overwrite=overwrite)
        write_detections(_as_detections(boxes, stamps, room.labels), out / TRUTH / TRUTH_BOXES)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return out


_KINDS = (("rgb", "jpg"), ("depth", "png"))


def drive_room(settings: RenderSettings, seed: int) -> Room:
    """The room of the drive that `render_drive` makes of the same settings and seed; ConfigError as there."""
    seeds = np.random.SeedSequence(seed).spawn(5)
    course = Course.lay(settings.motion, np.random.default_rng(seeds[0]))
    return _good_room(settings, lift_se2(course.at(_stamps(settings))) @ settings.camera.base_T_camera, seeds[4])


def _stamps(settings: RenderSettings) -> Floats:
    return START + np.arange(settings.frames) / settings.frame_rate


def _write_images(folder: Path, number: int, rgb: NDArray[np.uint8], depth: Reals) -> None:
    import cv2

    contents = (
        cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 93])[1],
        cv2.imencode(".png", np.clip(depth + 0.5, 0, 65535).astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1],
    )
    for (kind, end), content in zip(_KINDS, contents, strict=True):
        (folder / kind / f"{number:06d}.{end}").write_bytes(content.tobytes())


def _as_detections(frames: list[TrueBoxes], stamps: Floats, labels: tuple[str, ...]) -> Detections:
    """The boxes that count, as detections with score 1 and the objects' ids as track ids."""
    names, label = label_table(labels)
    joined = {name: np.concatenate([getattr(f, name)[f.counts] for f in frames]) for name in ("object", "box", "depth")}
    frame = np.repeat(np.arange(len(frames)), [int(f.counts.sum()) for f in frames])
    track = joined["object"].astype(np.int64)
    return Detections(stamps, frame, joined["box"], label[track], np.ones(len(frame)), joined["depth"], track, names)


def _good_room(settings: RenderSettings, map_T_camera: Floats, seed: np.random.SeedSequence) -> Room:
    """A room in which the drive sees every object often and widely enough."""
    step = LOOK_AHEAD
    camera = settings.camera
    matrix = camera.matrix.copy()
    matrix[:2] /= step
    small = replace(camera, width=camera.width // step, height=camera.height // step, matrix=matrix)
    worst = ""
    for child in seed.spawn(ROUNDS):
        room = furnish_room(settings.room, settings.labels, np.random.default_rng(child))
        caster = Caster(room, small)
        views: list[list[Floats]] = [[] for _ in room.labels]
        for pose in map_T_camera:
            found = true_boxes(caster, caster.cast(pose), pose, settings.limits, scale=step)
            for number in found.object[found.counts & ~found.cut]:
                views[number].append(room.middle[number] - pose[:3, 3])
        poor = [i for i, seen in enumerate(views) if not _seen_well(np.array(seen).reshape(-1, 3), settings)]
        if not poor:
            return room
        worst = room.labels[poor[0]]
    hint = "more frames or laps, or a lower min_views or min_parallax_deg"
    raise ConfigError(
        f"in {ROUNDS} rooms some object is not seen well enough (lastly {worst})", where=settings.name, hint=hint
    )


def _seen_well(towards: Floats, settings: RenderSettings) -> bool:
    if len(towards) < settings.min_views:
        return False
    directions = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return (
        widest_angle(directions) >= np.deg2rad(settings.min_parallax_deg)
        if len(towards) > 1
        else settings.min_parallax_deg == 0
    )
