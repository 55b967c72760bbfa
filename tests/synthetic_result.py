"""A made-up RunResult for the tests of the writers: a drive through a room, with every kind of ray and object."""

from __future__ import annotations

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.geometry import inverse, lift_se2, make_pose
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.result import RunResult
from objslam.core.trajectory import Trajectory
from objslam.core.types import Association, Keyframes, Rays, Truth, TruthObject

OPTICAL = make_pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.0, 0.4]))


def synthetic_result(
    positions: Floats,
    labels: list[str],
    *,
    keyframes: int = 40,
    room: tuple[float, float] = (10.0, 15.0),
    unresolved: tuple[int, ...] = (),
    sigma: float = 0.03,
    seed: int = 0,
    start: float = 100.0,
    settings: Settings | None = None,
) -> tuple[RunResult, Truth]:
    """A result with objects near the true positions (N, 3), and that truth.

    A tenth of the rays are outliers of weight 0.1, a fifteenth belong to no object.
    """
    rng = np.random.default_rng(seed)
    stamps = start + 0.1 * np.arange(keyframes)
    turn = np.linspace(0, 4 * np.pi, keyframes)
    radius = 0.5 + 0.35 * np.sin(1.7 * turn)
    xy = np.stack(
        [room[0] * (0.5 + 0.8 * (radius - 0.4) * np.cos(turn)), room[1] * (0.5 + 0.8 * (radius - 0.4) * np.sin(turn))], 1
    )
    heading = np.unwrap(np.arctan2(*np.gradient(xy, axis=0).T[::-1]))
    after = lift_se2(np.column_stack([xy, heading]))
    drift = lift_se2(np.column_stack([0.1 * turn, -0.05 * turn, 0.01 * turn]))
    before = drift @ after
    n = len(positions)
    mapped = positions + rng.normal(scale=sigma, size=(n, 3))
    cameras = after @ OPTICAL

    object_ = np.tile(np.arange(n), keyframes) if n else np.zeros(keyframes, dtype=np.int64)
    keyframe = np.repeat(np.arange(keyframes), max(n, 1))
    target = mapped[object_] if n else np.tile([1.0, 1.0, 1.0], (keyframes, 1))
    direction = target + rng.normal(scale=0.02, size=target.shape) - cameras[keyframe, :3, 3]
    wild, loose = (
        rng.permutation(len(keyframe))[: len(keyframe) // 10],
        rng.permutation(len(keyframe))[: len(keyframe) // 15],
    )
    weight = np.ones(len(keyframe))
    weight[wild] = 0.1
    direction[wild] += rng.normal(scale=0.6, size=(len(wild), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    label_names = tuple(sorted(set(labels))) or ("thing",)
    label = np.array([label_names.index(labels[j]) for j in object_] if n else [0] * keyframes, dtype=np.int64)
    index = object_.copy() if n else np.full(keyframes, -1)
    index[loose] = -1
    off = target - cameras[keyframe, :3, 3]
    cosine = (off * direction).sum(1) / np.linalg.norm(off, axis=1)
    count = len(keyframe)
    rays = Rays(
        keyframe=keyframe,
        direction=np.einsum("rij,rj->ri", inverse(cameras)[keyframe, :3, :3], direction),
        sigma=np.full(count, 0.005),
        range=np.full(count, np.nan),
        range_sigma=np.full(count, np.nan),
        range_bias=np.full(count, np.nan),
        label=label,
        score=np.full(count, 0.9),
        box=np.tile([10.0, 10.0, 40.0, 40.0], (count, 1)),
        track_id=np.full(count, -1),
        label_names=label_names,
    )
    objects = []
    for j in range(n):
        a = rng.normal(size=(3, 3))
        open_ = j in unresolved
        origin = cameras[0, :3, 3]
        away = (mapped[j] - origin) / np.linalg.norm(mapped[j] - origin)
        objects.append(
            MapObject(
                id=3 * j + 1,
                label=labels[j],
                position=mapped[j],
                covariance=None if open_ else sigma**2 * (0.3 * a @ a.T + 0.1 * np.eye(3)),
                status="unresolved" if open_ else "ok",
                rays=int((index == j).sum()),
                frames=keyframes,
                parallax_deg=1.2 if open_ else 41.0,
                rms_deg=0.4,
                first_seen=float(stamps[0]),
                last_seen=float(stamps[-1]),
                extent=(0.2, 0.3) if j % 2 else None,
                ray=(origin, away) if open_ else None,
            )
        )
    origins, directions = rays.in_map(cameras)
    result = RunResult(
        map=ObjectMap(tuple(objects)),
        keyframes=Keyframes(
            stamps,
            np.zeros(keyframes, dtype=np.int64),
            np.arange(keyframes),
            np.tile(OPTICAL, (keyframes, 1, 1)),
            before,
        ),
        map_T_base=after,
        rays=rays,
        association=Association(index, np.array([label_names.index(x) for x in labels], dtype=np.int64)),
        origins=origins,
        directions=directions,
        residual=np.where(index < 0, np.nan, np.arccos(np.clip(cosine, -1, 1))),
        weight=weight,
        summary={"mode": "joint", "counts": {"rays": count}, "warnings": ["the clock of the camera runs 0.04 s late"]},
        settings=settings or Settings(mode="joint"),
        cameras=(Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), base_T_camera=OPTICAL),),
        path=Trajectory(stamps, before),
        path_after=Trajectory(stamps, after),
    )
    truth = Truth(
        tuple(TruthObject(j, labels[j], positions[j]) for j in range(n)),
        Trajectory(stamps, after),
    )
    return result, truth


def clusters(seed: int = 1) -> tuple[Floats, list[str]]:
    """15 landmarks in clusters of 0.1-0.25 m in a room of 10 x 15 m, each with a label of its own."""
    rng = np.random.default_rng(seed)
    centres = np.array([[1.0, 2.0], [8.5, 3.0], [5.0, 13.5], [2.0, 11.0], [9.0, 9.0]])
    offsets = rng.uniform(-0.12, 0.12, size=(5, 3, 2))
    positions = np.concatenate([(centres[:, None] + offsets).reshape(-1, 2), np.full((15, 1), 0.3)], axis=1)
    return positions, [f"landmark_{i}" for i in range(6, 21)]
