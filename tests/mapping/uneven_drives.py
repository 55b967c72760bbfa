"""Drives over ground that is not flat, past posts, with a localisation that says x, y and heading only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from objslam.core.arrays import Floats
from objslam.core.camera import Camera, project
from objslam.core.geometry import inverse, lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log, Truth, TruthObject
from objslam.simulation.settings import make_camera

FOCAL = 300.0
"""The focal length, px, of a camera that sees 94 degrees. A longer one sees fewer posts."""


def lasting_noise(rng: np.random.Generator, stamps: Floats, seconds: float) -> Floats:
    """Draw numbers (n,) with a standard deviation of 1, whose correlation is 1/e after a time. 0: independent numbers."""
    drawn = rng.normal(size=len(stamps))
    for i in range(1, len(stamps)) if seconds else ():
        stays = np.exp(-(stamps[i] - stamps[i - 1]) / seconds)
        drawn[i] = stays * drawn[i - 1] + np.sqrt(1 - stays**2) * drawn[i]
    return drawn


def uneven_drive(
    tilt: float,
    seconds: float = 0.0,
    seed: int = 0,
    *,
    posts: int = 22,
    frames: int = 400,
    mount: float = 0.0,
    hills: float = 0.0,
) -> Log:
    """Return a drive whose base rolls and pitches by `tilt` (rad, one standard deviation) for some seconds.

    mount: rad, by how much the camera looks up more than its calibration says. hills: m, the standard deviation of the
    height of the ground. The robot stands on it at each visit, and the true heights of posts are those above the ground.
    Each post has a label of its own. Boxes err by 2 px, poses by 2 cm and 0.3 deg.
    """
    rng = np.random.default_rng(seed)
    stamps = 100.0 + 0.25 * np.arange(frames)
    phase = 2 * np.pi * np.arange(frames) / 200
    path = np.column_stack([8 * np.sin(phase), 5 * np.sin(2 * phase)])
    yaw = np.unwrap(np.arctan2(10 * np.cos(2 * phase), 8 * np.cos(phase)))
    true = lift_se2(np.column_stack([path, yaw]))
    pitch, roll = (tilt * lasting_noise(rng, stamps, seconds) for _ in range(2))
    if hills:
        phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, 2)
        true[:, 2, 3], slope = _hills(path, phases)[0] * hills, _hills(path, phases)[1] * hills
        pitch -= np.arctan((slope * np.column_stack([np.cos(yaw), np.sin(yaw)])).sum(axis=1))
        roll += np.arctan((slope * np.column_stack([-np.sin(yaw), np.cos(yaw)])).sum(axis=1))
    true[:, :3, :3] = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).as_matrix()
    known, really = (make_camera(focal=FOCAL, position=(0.1, 0.0, 0.9), pitch=up) for up in (0.0, mount))
    place = np.column_stack([rng.uniform(-11, 11, 400), rng.uniform(-8, 8, 400), rng.uniform(0.3, 2.0, 400)])
    place = place[np.linalg.norm(place[:, None, :2] - path, axis=2).min(axis=1) > 1.5][:posts]
    noise = rng.normal(size=(frames, 3)) * [0.02, 0.02, 0.005]
    told = np.column_stack([true[:, :2, 3], yaw]) + noise
    # The odometry counts the way over ground, and is exact but for 1 % of its way.
    steps = np.diff(np.column_stack([true[:, :2, 3], yaw]), axis=0) * (1 + 0.01 * rng.normal(size=(frames - 1, 1)))
    wheels = lift_se2(told[0] + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)]))
    items = tuple(TruthObject(i, f"post {i}", place[i]) for i in range(posts))
    stands = np.column_stack([place[:, :2], place[:, 2] + _hills(place[:, :2], phases)[0] * hills]) if hills else place
    return Log(
        "uneven",
        (CameraLog(known, _boxes(rng, stamps, true, really, stands)),),
        Trajectory(stamps, inverse(wheels[0]) @ wheels),
        localization=Trajectory(stamps, lift_se2(told)),
        truth=Truth(items, Trajectory(stamps, true)),
    )


_WAVES = 18.0, 25.0
"""The lengths (m) of the waves of hilly ground along x and y. Longer waves are less curved, and tilt the robot less."""


def _hills(place: Floats, phases: Floats) -> tuple[Floats, Floats]:
    """Return the height (n,) of hilly ground with the standard deviation 1, and its slope (n, 2), at places (n, 2), m."""
    waves = 2 * np.pi / np.array(_WAVES)
    at = place * waves + phases
    return np.sin(at).sum(axis=1), np.cos(at) * waves


def shelf_drive(seed: int = 0) -> Log:
    """Return a drive on a flat floor along two shelves, with a camera that looks to the left from a metre away.

    The tags of a shelf are above each other on two boards, and have one label. In a frame, the detector finds one of them.
    Boxes err by 1 px, poses by 2 cm and 0.3 deg.
    """
    rng = np.random.default_rng(seed)
    along = np.linspace(0, 12, 150)
    there = np.column_stack([along, np.full(150, 0.1), np.zeros(150)])
    back = np.column_stack([along[::-1], np.full(150, -0.1), np.full(150, np.pi)])
    true = np.vstack([there, back, there * [1, -1, 1], back * [1, -1, 1]])
    stamps = 100.0 + 0.25 * np.arange(len(true))
    camera = make_camera(width=1280, height=720, focal=914.0, position=(0.0, 0.0, 1.0), yaw=np.pi / 2)
    column = rng.uniform(0, 12, 16)
    place = np.column_stack([np.tile(column, 2), np.tile([-1.14, 1.14], 16), np.repeat([0.85, 1.25], 16)])
    told = true + rng.normal(size=true.shape) * [0.02, 0.02, 0.005]
    boxes = _boxes(rng, stamps, lift_se2(true), camera, place, noise=1.0, half=(0.045, 0.03))
    seen = (boxes.label < 16) == (rng.random((len(stamps), 16)) < 0.5)[boxes.frame, boxes.label % 16]
    named = replace(boxes.take(seen), label=np.zeros(seen.sum(), dtype=np.int64), label_names=("tag",))
    return Log("shelves", (CameraLog(camera, named),), localization=Trajectory(stamps, lift_se2(told)))


def _boxes(
    rng: np.random.Generator,
    stamps: Floats,
    map_T_base: Floats,
    camera: Camera,
    place: Floats,
    *,
    noise: float = 2.0,
    half: tuple[float, float] = (0.1, 0.2),
) -> Detections:
    """Return the boxes of things at places (N, 3), m. noise: px. half: m, half the width and half the height of a thing."""
    local = np.einsum("kji,knj->kni", *_towards(map_T_base @ camera.base_T_camera, place))
    frame, post = np.nonzero((local[..., 2] > 1.0) & (local[..., 2] < 14.0))
    pixel = project(camera, local[frame, post]) + rng.normal(size=(len(frame), 2)) * noise
    reach = np.array(half) * camera.matrix[0, 0] / local[frame, post, 2:]
    boxes = np.hstack([pixel - reach, pixel + reach])
    inside = (boxes[:, :2] > 2).all(axis=1) & (boxes[:, 2:] < camera.size - 3).all(axis=1)
    frame, post, boxes = frame[inside], post[inside], boxes[inside]
    names, number = tuple(f"post {i}" for i in range(len(place))), len(frame)
    free = np.full(number, np.nan), np.full(number, -1)
    return Detections(stamps, frame, boxes, post, np.ones(number), *free, names)


def _towards(map_T_camera: Floats, place: Floats) -> tuple[Floats, Floats]:
    return map_T_camera[:, :3, :3], place[None] - map_T_camera[:, None, :3, 3]
