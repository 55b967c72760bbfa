"""Simulated drives between large objects, as logs with boxes and a truth."""

from functools import cache

import numpy as np
from outlines import from_axes, outline_box, visible_box

from objslam.config import load_settings
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse, lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log, Truth, TruthObject
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.triangulation.bodies.ellipsoid import half_axes, heading

FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0.8], [0, 0, 0, 1]])
"""A camera that looks ahead, 0.8 m above the floor."""


def drifting_odometry(true: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """The poses (K, 4, 4) as wheels tell them, with the noise of the settings."""
    steps = inverse(true[:-1]) @ true[1:]
    far = np.sqrt(np.linalg.norm(steps[:, :2, 3], axis=1))[:, None]
    steps = steps @ lift_se2(far * [0.02, 0.005, 0.02] * rng.standard_normal((len(steps), 3)))
    odometry = [true[0]]
    for step in steps:
        odometry.append(odometry[-1] @ step)
    return odometry


@cache
def drive(seed, frames=200, objects=8, short=None, laps=1):
    """Laps on an ellipse inside a ring of objects of 0.7 to 1.6 m, with boxes of 2 px noise and drifting odometry.

    short: by which share of its size the detector ends a box short of the image's edge that cuts it off. Without it, there
    are no cut off boxes.
    """
    rng = np.random.default_rng(seed)
    camera = Camera("front", 640, 480, np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]]), base_T_camera=FORWARD)
    turn = np.linspace(0, 2 * np.pi * laps, frames)
    place = np.column_stack([2.5 * np.cos(turn), 2.0 * np.sin(turn)])
    yaw = np.unwrap(np.arctan2(*np.gradient(place, axis=0).T[::-1])) + 0.5 * np.sin(5 * turn)
    true, stamps = lift_se2(np.column_stack([place, yaw])), 0.2 * np.arange(frames)
    odometry = drifting_odometry(true, rng)
    around, reach = np.linspace(0, 2 * np.pi, objects, endpoint=False) + 0.2, rng.uniform(4.0, 4.8, objects)
    half = np.exp(rng.uniform(np.log(0.35), np.log(0.8), (objects, 3)))
    centre = np.column_stack([reach * np.cos(around), 0.85 * reach * np.sin(around), half[:, 2]])
    bodies = from_axes(centre, half, rng.uniform(-1.5, 1.5, objects))
    found = []
    for i, pose in enumerate(true @ FORWARD):
        local = (centre - pose[:3, 3]) @ pose[:3, :3]
        for j in np.flatnonzero((local[:, 2] > 0.5) & (np.abs(local[:, 0]) < local[:, 2])).tolist():
            box = outline_box(camera, bodies[j], pose)
            if box is not None and (box[:2] >= 2).all() and (box[2:] <= [637, 477]).all():
                found.append((i, j, box + rng.normal(0, 2, 4)))
            elif short is not None and box is not None:
                shown = visible_box(camera, bodies[j], pose)
                if shown is not None and (shown[2:] - shown[:2]).prod() > 0.25 * (box[2:] - box[:2]).prod():
                    found.append((i, j, cut_box(shown, camera, short, rng)))
    frame, label, box = (np.array(column) for column in zip(*found, strict=True))
    names, count = tuple(f"thing {j}" for j in range(objects)), len(frame)
    unknown = np.full(count, np.nan), np.full(count, -1)
    detections = Detections(stamps, frame, box, label, np.ones(count), *unknown, names)
    things = zip(names, centre, 2 * half_axes(bodies), heading(bodies).tolist(), strict=True)
    truth = Truth(tuple(TruthObject(j, *thing) for j, thing in enumerate(things)), Trajectory(stamps, true))
    return Log("drive", (CameraLog(camera, detections),), Trajectory(stamps, np.array(odometry)), truth=truth)


def cut_box(shown, camera, short, rng):
    """A noisy box of the visible part of a body, which ends short of the image's edge by a random share of its size.

    A detector clips its boxes, so an edge at the image's edge has no noise of its own.
    """
    size = np.tile(shown[2:] - shown[:2], 2)
    at_edge = np.concatenate([shown[:2] <= 0, shown[2:] >= camera.size - 1])
    inward = at_edge * short * rng.uniform(0, 1, 4) * size * [1, 1, -1, -1]
    return np.clip(shown + inward + np.where(at_edge, 0, rng.normal(0, 2, 4)), 0, np.tile(camera.size - 1, 2))


def scores(log, *changes):
    """The evaluation of a joint run."""
    less = ("calibration.use=false", "checks.use=false", "output.recording=false")
    settings = load_settings(None, ("mode=joint", *less, *changes))
    result = pipeline.run(log, settings, Ledger())
    return result, evaluate(result.map, log.truth, result.path_after, align="se2", radius=1.0).to_dict()
