"""Drives that never happened: a robot, cameras and objects in a room, with every error of a real log, and the truth.

The same settings and seed give the same log. Each part (path, objects, every noise) draws from a random generator of its
own, so that switching one noise on leaves the others as they were.
"""

from __future__ import annotations

import numpy as np

from objslam.core.geometry import lift_se2
from objslam.core.types import CameraLog, Log, Trajectory, Truth, TruthObject
from objslam.simulation.detector import Boxes, detect, detections, imagine, views
from objslam.simulation.scene import furnish, roam
from objslam.simulation.settings import PRESETS, DepthNoise, DriveSettings, PoseNoise, make_camera, pair, preset
from objslam.simulation.trajectory import START, Path, localization, odometry

__all__ = ["PRESETS", "DepthNoise", "DriveSettings", "PoseNoise", "make_camera", "pair", "preset", "simulate"]


def simulate(settings: DriveSettings, seed: int) -> Log:
    """A log of the drive, with its truth: the objects, and map_T_base at the stamps of the frames.

    odom is where map is at the first pose, from which odometry drifts. ConfigError where the objects find no place that
    the path sees well enough.
    """
    seeds = np.random.SeedSequence(seed).spawn(6)
    path_rng, scene_rng, roam_rng, odometry_rng, localization_rng = (np.random.default_rng(s) for s in seeds[:5])
    path = Path.lay(settings, path_rng)
    cameras = len(settings.cameras)
    turns = np.arange(settings.frames)[:, None] + np.arange(cameras) / cameras  # cameras of a robot fire one after the other
    frame_stamps = START + turns / settings.frame_rate
    scene = furnish(settings, path, frame_stamps, scene_rng)
    roamers = roam(settings, scene, roam_rng)

    logs = []
    for camera, stamps, seed_of_camera in zip(settings.cameras, frame_stamps.T, seeds[5].spawn(cameras), strict=True):
        map_T_camera = lift_se2(path.at(stamps)) @ camera.base_T_camera
        standing = views(settings, camera, map_T_camera, scene.position, scene.extent)
        moving = views(settings, camera, map_T_camera, roamers.at(stamps), roamers.extent)
        standing_seed, moving_seed, false_seed = seed_of_camera.spawn(3)
        boxes = Boxes.join(
            detect(settings, camera, standing, scene.label, standing_seed),
            detect(settings, camera, moving, roamers.label, moving_seed, first_id=len(scene.label)),
            imagine(settings, camera, len(scene.classes), false_seed),
        )
        logs.append(CameraLog(camera, detections(settings, boxes, stamps, scene.classes)))

    labelled = zip(scene.label, scene.position, strict=True)
    stamps = frame_stamps.ravel()
    return Log(
        name=settings.name,
        cameras=tuple(logs),
        odometry=odometry(settings, path, stamps, odometry_rng),
        localization=localization(settings, path, stamps, localization_rng),
        truth=Truth(
            objects=tuple(TruthObject(i, scene.classes[label], place) for i, (label, place) in enumerate(labelled)),
            trajectory=Trajectory(stamps, lift_se2(path.at(stamps))),
        ),
    )
