"""Simulate drives of a robot among objects in a room, with the errors of real logs and with ground truth. The path, the
objects and each kind of error have their own random generators, so a change of one error leaves the others unchanged.
"""

from dataclasses import replace

import numpy as np

from objslam.core.geometry import lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Log, Truth, TruthObject
from objslam.simulation.detector import Boxes, detect, detections, imagine, order_of, views, with_features
from objslam.simulation.scene import furnish, roam
from objslam.simulation.settings import (
    PRESETS,
    AppearanceNoise,
    DepthNoise,
    DriveSettings,
    PoseNoise,
    make_camera,
    pair,
    preset,
)
from objslam.simulation.trajectory import Path, frame_stamps, localization, odometry

__all__ = [
    "PRESETS",
    "AppearanceNoise",
    "DepthNoise",
    "DriveSettings",
    "PoseNoise",
    "make_camera",
    "pair",
    "preset",
    "simulate",
]


def simulate(settings: DriveSettings, seed: int) -> Log:
    """Simulate a drive. The same settings and seed give the same log.

    The ground truth holds the objects, and map_T_base at the stamps of the images. The coordinate frames odom and map
    coincide at the start. Raises ConfigError if too few positions for objects are seen well from the path.
    """
    seeds = np.random.SeedSequence(seed).spawn(6)
    path_rng, scene_rng, roam_rng, odometry_rng, localization_rng = (np.random.default_rng(s) for s in seeds[:5])
    path = Path.lay(settings, path_rng)
    fired = frame_stamps(settings)
    scene = furnish(settings, path, fired, scene_rng)
    roamers = roam(settings, scene, roam_rng)
    logs, objects = [], []
    for camera, stamps, seed_of_camera in zip(settings.cameras, fired.T, seeds[5].spawn(len(settings.cameras)), strict=True):
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
        objects.append(boxes.object[order_of(boxes)])
    if settings.appearance is not None:
        seen = with_features([c.detections for c in logs if c.detections is not None], objects, settings.appearance, seed)
        logs = [replace(c, detections=found) for c, found in zip(logs, seen, strict=True)]
    labelled = zip(scene.label, scene.position, strict=True)
    stamps = np.unique(fired)
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
