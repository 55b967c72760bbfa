"""Simulated drives among boxes, cylinders, balls and signs, with depths as a depth image shows them, and a truth.

A depth is read from a small depth image of each box: rays are cast against the true solid, by its own equations, and what
they miss is a wall behind. So the depths know nothing of the bodies that objslam fits.
"""

import numpy as np
from mapping.body_drives import FORWARD, drifting_odometry
from mapping.hiding_drives import CAMERA, Solid, image_of, long_yaw

from objslam.core.geometry import inverse, lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log, Truth, TruthObject
from objslam.frontend.box_depths import box_depth

SHAPES = ("cuboid", "cylinder", "ellipsoid", "sign")
PIXELS = 24  # The side of the small depth image of a box.
WALL = (1.0, 3.0)  # The least and largest distance, m, from a thing to what is behind it.
AROUND = (6, ((1.2, 1.2), (2.0, 2.0)))  # The number of the solids that a drive goes around, and their ellipses.
DEPTH_NOISE = (0.01, 0.01)  # The noise of the pixels of a depth image, m and m per m.


def depth_along(solid, pose, slopes):
    """The depths (P,) z, m, of a solid along rays with the slopes (P, 2) x / z and y / z, inf where they miss it."""
    turn = np.array([[np.cos(solid.yaw), np.sin(solid.yaw), 0], [-np.sin(solid.yaw), np.cos(solid.yaw), 0], [0, 0, 1]])
    ray = np.column_stack([slopes, np.ones(len(slopes))]) @ pose[:3, :3].T @ turn.T / solid.half
    start = turn @ (pose[:3, 3] - solid.centre) / solid.half
    with np.errstate(all="ignore"):
        flat, upright = {"ellipsoid": (3, 3), "cylinder": (2, 3), "cuboid": (0, 3)}[solid.shape]
        a, b, c = (ray[:, :flat] ** 2).sum(1), ray[:, :flat] @ start[:flat], (start[:flat] ** 2).sum() - 1
        root = np.sqrt(b * b - a * c) if flat else np.inf
        low, high = (np.broadcast_to((-b + sign * root) / a if flat else sign * np.inf, len(ray)) for sign in (-1, 1))
        ends = np.stack([(sign - start[flat:upright]) / ray[:, flat:upright] for sign in (-1, 1)])
        low = np.maximum(low, ends.min(axis=0).max(axis=1, initial=-np.inf))
        high = np.minimum(high, ends.max(axis=0).min(axis=1, initial=np.inf))
        return np.where((low <= high) & (low > 0), low, np.inf)


def surface_depth(solid, pose, box, rng):
    """The depth, m, of a solid in its box (4,), px, as read from a depth image with a wall behind."""
    x, y = (np.linspace(box[i], box[i + 2], PIXELS + 1)[:-1] + (box[i + 2] - box[i]) / PIXELS / 2 for i in (0, 1))
    focal, middle = np.diag(CAMERA.matrix)[:2], CAMERA.matrix[:2, 2]
    pixels = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
    depth = depth_along(solid, pose, (pixels - middle) / focal)
    wall = inverse(pose)[2, :3] @ solid.centre + inverse(pose)[2, 3] + np.max(solid.half) + rng.uniform(*WALL)
    depth = np.minimum(depth, wall)
    depth = depth + (DEPTH_NOISE[0] + DEPTH_NOISE[1] * depth) * rng.normal(size=depth.shape)
    wide = float((box[2:] - box[:2]).max())
    return box_depth(depth.reshape(PIXELS, PIXELS), np.array([0, 0, PIXELS, PIXELS]), focal[0] * PIXELS / wide)


def ring_of(rng, count=10, reach=((3.6, 3.0), (4.4, 3.6))):
    """Solids of 0.15 to 1.2 m on stands, between two ellipses around the origin. A sign is a cuboid 2 cm thick."""
    solids = []
    for turn in np.linspace(0, 2 * np.pi, count, endpoint=False) + rng.uniform(0, 1):
        shape, wide = str(rng.choice(SHAPES)), np.exp(rng.uniform(np.log(0.15), np.log(1.0)))
        half = wide * np.exp(rng.normal(0, 0.2, 3)) / 2
        yaw = float(rng.uniform(-1.5, 1.5))
        if shape == "ellipsoid" and rng.random() < 0.5:
            half[:] = wide / 2  # A ball.
        if shape == "sign":
            shape, half[0], yaw = "cuboid", 0.01, turn + rng.normal(0, 0.4)
        toward = np.array([np.cos(turn), np.sin(turn)]) * rng.uniform(*reach)
        centre = np.array([*toward, rng.uniform(0.3, 1.2) + half[2]])
        solids.append(Solid(shape, f"thing {len(solids)}", centre, half, yaw))
    return solids


def surface_drive(seed, *, ends="surface", frames=250, noise=2.0, wide=1.0, around=False):
    """One lap and a half inside a ring of solids, or around six. The odometry drifts and has a wrong scale.

    ends: "surface" for depths as `surface_depth` reads them, "centre" for depths of centres, None for no depths. wide: a
    factor on all sizes of things.
    """
    rng = np.random.default_rng([seed, 77])
    ring = ring_of(rng, *AROUND) if around else ring_of(rng)
    solids = [Solid(s.shape, s.label, s.centre, wide * s.half, s.yaw) for s in ring]
    turn = np.linspace(0, 3 * np.pi, frames)
    place = np.column_stack([1.8 * np.cos(turn), 1.5 * np.sin(turn)]) * (2.5 if around else 1.0)
    ahead = np.unwrap(np.arctan2(*np.gradient(place, axis=0).T[::-1]))
    yaw = ahead + (1.4 + 0.3 * np.sin(3.5 * turn) if around else 0.7 * np.sin(3.5 * turn) - 0.7)
    stamps, plane = 0.2 * np.arange(frames), np.column_stack([place, yaw])
    true = lift_se2(plane)
    odometry = np.array(drifting_odometry(true, rng))
    odometry[:, :2, 3] = odometry[0, :2, 3] + (odometry[:, :2, 3] - odometry[0, :2, 3]) * (1 + rng.normal(0, 0.015))
    localised = lift_se2(plane + [0.01, 0.01, 0.0035] * rng.standard_normal((frames, 3)))
    found = []
    for k, pose in enumerate(true @ FORWARD):
        for thing, solid in enumerate(solids):
            outline = image_of(solid.points, pose) if (solid.centre - pose[:3, 3]) @ pose[:3, 2] > 0.8 else None
            box = np.zeros(4) if outline is None else np.concatenate([outline.min(axis=0), outline.max(axis=0)])
            if (box[:2] > 2).all() and (box[2:] < CAMERA.size - 2).all():
                drawn = box + rng.normal(0, noise, 4)
                depth = np.nan
                if ends == "surface":
                    depth = surface_depth(solid, pose, drawn, rng)
                elif ends == "centre":
                    local = pose[:3, :3].T @ (solid.centre - pose[:3, 3])
                    depth = local[2] + (DEPTH_NOISE[0] + DEPTH_NOISE[1] * local[2]) * rng.normal()
                found.append((k, thing, drawn, depth))
    frame, thing, box, depth = (np.array([one[at] for one in found]) for at in range(4))
    names = tuple(s.label for s in solids)
    detections = Detections(stamps, frame, box, thing, np.ones(len(box)), depth, np.full(len(box), -1), names)
    often = np.bincount(thing, minlength=len(solids))
    things = [
        TruthObject(i, s.label, s.centre, np.array([*np.sort(2 * s.half[:2])[::-1], 2 * s.half[2]]), long_yaw(s))
        for i, s in enumerate(solids)
        if often[i] >= 8
    ]
    truth = Truth(tuple(things), Trajectory(stamps, true))
    paths = {"odometry": Trajectory(stamps, odometry), "localization": Trajectory(stamps, localised)}
    return Log("surfaces", (CameraLog(CAMERA, detections),), **paths, truth=truth)
