"""Measure whether maps are honest on robots whose errors come from hardware, not from the noise model of the package.

    python tools/bench_robots.py [--kinds wheels gyro vio slow mecanum] [--robots 8] [--first 0] [--unnamed]
        [--classes 6] [--cameras 3] [--localised filter] [--live]

Each robot drives to random points of a room, with stops. wheels: encoders with ticks, wrong radii, a wrong track width, slip
and sudden slips. gyro: the same wheels, and the heading of a gyroscope with a bias. vio: a 6-DoF path that drifts. slow:
wheels, but only one or two odometry poses in a second. mecanum: wheels with rollers, on which the robot drives in all
directions, and slips sideways. The camera has a wrong clock, yaw, tilt and roll. Boxes are rounded
to pixels, sit beside the object by a share of its size that depends on the side, and 1 % have a wrong name. Robots with an
even number measure depths too, of surfaces that are before the centres by 0 to 1 times half the width. All settings are the
defaults of joint mode. A line for each robot, then for each kind. Then,
for each parameter of the calibration, the robots whose true value is within 1.96 and within 3 of its standard deviations.

With --unnamed, all objects of a robot have one label, so the map must also find out which box is of which object. With
--classes 6, they have six labels by chance, as a detector would give them.

With --localised, each robot has a localisation too, that errs for seconds. All settings are the defaults, and maps are
compared without an alignment. filter: AMCL by tf, which steps when it corrects the odometry. poses: the poses of AMCL at its
corrections alone. slam: a scan matcher. satellites: positions that err by up to more than a metre.

With --live, a session maps each robot while it drives. The map of its last snapshot has lines of its own. The CPU time is
that of the session and of the processes beside it.
"""

from __future__ import annotations

import argparse
import resource
import time
from typing import Any

import localisations
import mecanum
import numpy as np
from live_parts.common import replayed
from log_parts import with_classes, without_names

from objslam.config import Settings, load_settings
from objslam.core.arrays import Floats
from objslam.core.calibration import Calibration
from objslam.core.camera import Camera, project
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse, lift_se2, make_pose
from objslam.core.object_map import ObjectMap
from objslam.core.result import RunResult
from objslam.core.rotation import rotation_from_vector
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log, Truth, TruthObject
from objslam.errors import ObjslamError
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline

KINDS = ("wheels", "gyro", "vio", "slow", "mecanum")
STEP = 0.005  # s, of the simulated motion
SIDES = 0.04  # the offset of a box from its object, as a share of the size of the object, for each of five terms
SURFACES = 0.2  # the spread over things of the distance from surface to centre, as a share of half the width
CLOCKS = 0.05  # s, the spread of the clocks of the cameras of one robot
SLIPS = 90.0  # s between sudden slips, on average
RADIUS, FAR_RADIUS, UNNAMED_RADIUS = 3.0, 6.0, 0.5
"""The radius of a match, m: with labels, with labels at positions that err by metres, and without. Labels identify objects,
so a large error is no missed object."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--robots", type=int, default=8, help="robots of each kind")
    parser.add_argument("--first", type=int, default=0, help="the seed of the first robot")
    parser.add_argument("--unnamed", action="store_true", help="one label for all objects of a robot")
    parser.add_argument("--classes", type=int, default=0, help="this number of labels for all objects of a robot, by chance")
    parser.add_argument("--cameras", type=int, default=1, help="cameras that look around, each with a clock of its own")
    parser.add_argument("--live", action="store_true", help="a session maps each robot while it drives")
    parser.add_argument("--localised", choices=localisations.KINDS, help="the localisation of the robots")
    options = parser.parse_args()
    settings = load_settings(
        None, ("output.recording=false",) if options.localised else ("mode=joint", "output.recording=false")
    )
    for kind in options.kinds:
        rows: dict[tuple[str, bool], list[tuple[float, ...]]] = {}
        errors: dict[str, list[float]] = {}
        for seed in range(options.first, options.first + options.robots):
            log, true = robot(seed, kind, options.localised, options.cameras)
            ranged, begin = seed % 2 == 0, cpu_seconds()
            log = without_names(log) if options.unnamed else log
            log = with_classes(log, options.classes, seed) if options.classes else log
            try:
                result, last = mapped(log, settings, options.live)
            except ObjslamError as error:
                print(f"{kind} {seed}: {error}")
                continue
            seconds = cpu_seconds() - begin
            for what, found in (("the last snapshot", last), ("", result.map)):
                if found is None:
                    continue
                of = (*scores(found, log, options), seconds)
                rows.setdefault((what, ranged), []).append(of)
                matched, objects, false, inside, rmse, squared, _ = of
                print(
                    f"{kind} {seed}, {'range' if ranged else 'bearings'}{what and ', ' + what}: {matched:.0f} of "
                    f"{objects:.0f} objects, {false:.0f} false, {inside:.0f} inside 95 %, RMSE {rmse:.3f} m, "
                    f"squared Mahalanobis median {squared:.2f}, {seconds:.1f} s of CPU",
                    flush=True,
                )
            off = deviations(result.calibration, true)
            for name, by in off.items():
                errors.setdefault(name, []).append(by)
            print("    " + ", ".join(f"{name} {by:+.1f} sigma" for name, by in off.items()), flush=True)
        for (what, ranged), of_kind in sorted(rows.items(), reverse=True):
            matched, objects, false, inside, rmse, squared, seconds = np.array(of_kind).T
            print(
                f"== {kind}, {'range' if ranged else 'bearings'}{what and ', ' + what}: {len(of_kind)} robots, "
                f"{matched.sum():.0f} of {objects.sum():.0f} objects, {false.sum():.0f} false, inside 95 %: "
                f"{inside.sum() / matched.sum():.1%}, "
                f"RMSE median {np.nanmedian(rmse):.3f} m, largest {np.nanmax(rmse):.3f} m, "
                f"{np.median(seconds):.1f} s of CPU",
                flush=True,
            )
        for name, of_name in errors.items():
            size = np.abs(of_name)
            print(
                f"== {kind}, {name}: of {len(size)} robots, {(size <= 1.96).sum()} within 1.96 sigma, "
                f"{(size <= 3).sum()} within 3, root mean square {np.sqrt((size**2).mean()):.2f}, largest {size.max():.1f}",
                flush=True,
            )


def mapped(log: Log, settings: Settings, live: bool) -> tuple[RunResult, ObjectMap | None]:
    """Return the result of a log, and the map of the last snapshot if a session maps it."""
    if not live:
        return pipeline.run(log, settings, Ledger()), None
    session = replayed(log, settings)
    last = session.snapshot().map
    return session.stop(), last


def scores(found: ObjectMap, log: Log, options: argparse.Namespace) -> tuple[float, ...]:
    """Return the numbers of matched, true and false objects, and of those inside their 95 % ellipsoids. Also the RMSE,
    m, and the median of the squared Mahalanobis distances."""
    assert log.truth is not None
    radius = FAR_RADIUS if options.localised == "satellites" else RADIUS
    radius = UNNAMED_RADIUS if options.unnamed or options.classes else radius
    score = evaluate(found, log.truth, align="none" if options.localised else "se2", radius=radius).to_dict()
    matched = score["matched"]
    inside = (score["inside_95_3d"] or 0.0) * matched
    rmse, squared = (score[name] if matched else np.nan for name in ("position_rmse", "mahalanobis_median"))
    return matched, len(log.truth.objects), score["false"], inside, rmse, np.nan if squared is None else squared


def cpu_seconds() -> float:
    """Return the CPU time, s, of this process and of those that it started and that have ended."""
    of_children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + of_children.ru_utime + of_children.ru_stime


def deviations(found: Calibration | None, true: dict[str, float]) -> dict[str, float]:
    """Return the errors of the estimated parameters with a known true value, in their standard deviations."""
    if found is None:
        return {}
    at = {name: (value, sigma) for name, value, sigma in zip(found.names, found.values, found.sigma, strict=True)}
    return {name: float((at[name][0] - value) / at[name][1]) for name, value in true.items() if name in at}


def robot(seed: int, kind: str, localised: str | None = None, cameras: int = 1) -> tuple[Log, dict[str, float]]:
    """Draw a robot of a kind, a room and a drive. The same seed and kind give the same log.

    localised: the kind of localisation, if the robot has one. cameras: how many there are. They take their images at nearly
    the same times, but their clocks differ. Also returns the true values of its calibration, by the names
    of the parameters.
    """
    rng = np.random.default_rng([seed, 1 + KINDS.index(kind)])
    room, speed, seconds = rng.uniform(5, 15, 2), rng.uniform(0.2, 1.0), rng.uniform(120, 500)
    if kind == "mecanum":
        stamps, path, speeds = mecanum.drive(rng, room, speed, seconds, STEP)
        odometry, true = mecanum.odometry(rng, stamps, speeds, float(rng.choice([10, 20, 50])))
    else:
        stamps, path, forward, turning = drive(rng, room, speed, seconds)
    if kind == "vio":
        odometry, true = vio(rng, stamps, path, float(rng.choice([10, 20, 30])))
    elif kind != "mecanum":
        rate = float(rng.choice([1, 2]) if kind == "slow" else rng.choice([10, 20, 50]))
        odometry, true = wheels(rng, stamps, forward, turning, kind == "gyro", rate)
    camera, base_T_camera, turns = mounted(rng)
    clock = rng.normal(0, 0.08)
    rate = float(rng.choice([2, 5, 10, 15]))
    fired = np.arange(1.0, seconds - 1.0, 1 / rate)
    fired = fired + rng.uniform(0, 0.004, len(fired))
    map_T_base = lift_se2(np.column_stack([np.interp(fired, stamps, column) for column in path.T]))
    number = int(rng.integers(8, 20))
    places = np.column_stack([rng.uniform(-room / 2 - 1.5, room / 2 + 1.5, (number, 2)), rng.uniform(0, 1.6, number)])
    names = tuple(f"thing_{i}" for i in range(number))
    detections = boxes_of(rng, camera, map_T_base @ base_T_camera, places, fired - clock, names, ranged=seed % 2 == 0)
    truth = Truth(
        objects=tuple(TruthObject(i, name, place) for i, (name, place) in enumerate(zip(names, places, strict=True))),
        trajectory=Trajectory(fired - clock, map_T_base),
    )
    true |= {f"{camera.name}.clock": clock} | {f"{camera.name}.{axis}": turn for axis, turn in turns.items()}
    localization = None
    if localised is not None:
        rng = np.random.default_rng([seed, 77])
        localization = localisations.localised(rng, localised, stamps, path, odometry)
    found = [CameraLog(camera, detections)]
    for i in range(1, cameras):
        rng = np.random.default_rng([seed, 55, i])
        camera, base_T_camera, turns = mounted(rng, f"camera{i}", 2 * np.pi * i / cameras)
        other = clock + rng.normal(0, CLOCKS)
        detections = boxes_of(rng, camera, map_T_base @ base_T_camera, places, fired - other, names, ranged=seed % 2 == 0)
        found.append(CameraLog(camera, detections))
        true |= {f"{camera.name}.clock": other} | {f"{camera.name}.{axis}": turn for axis, turn in turns.items()}
    return Log(f"{kind}{seed}", tuple(found), localization=localization, odometry=odometry, truth=truth), true


def drive(rng: np.random.Generator, room: Floats, speed: float, seconds: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Drive to random points of a room (2,), m. Returns stamps (n,), the path (n, 3) x, y, yaw, and both speeds (n,)."""
    count = int(seconds / STEP)
    x, y, yaw, v, w, wait = 0.0, 0.0, float(rng.uniform(-np.pi, np.pi)), 0.0, 0.0, 1.0
    goal, fastest = (rng.uniform(-0.5, 0.5, 2) * room).tolist(), float(rng.uniform(0.6, 1.5))
    moments = []
    for _ in range(count):  # In plain numbers, which takes a third of the time of small arrays.
        moments.append((x, y, yaw, v, w))
        ahead, left = goal[0] - x, goal[1] - y
        if np.hypot(ahead, left) < 0.4:
            goal = (rng.uniform(-0.5, 0.5, 2) * room).tolist()
            if rng.random() < 0.4:
                wait = float(rng.uniform(1, 5))
        off = (float(np.arctan2(left, ahead)) - yaw + np.pi) % (2 * np.pi) - np.pi
        wanted_w, wanted_v = min(max(1.5 * off, -fastest), fastest), speed * max(float(np.cos(off)), 0.0) ** 2
        if wait > 0:
            wait, wanted_w, wanted_v = wait - STEP, 0.0, 0.0
        v += min(max(wanted_v - v, -0.8 * STEP), 0.8 * STEP)
        w += min(max(wanted_w - w, -3 * STEP), 3 * STEP)
        x, y, yaw = x + v * float(np.cos(yaw)) * STEP, y + v * float(np.sin(yaw)) * STEP, yaw + w * STEP
    path, forward, turning = np.split(np.array(moments), [3, 4], axis=1)
    return np.arange(count) * STEP, path, forward[:, 0], turning[:, 0]


def wheels(
    rng: np.random.Generator, stamps: Floats, forward: Floats, turning: Floats, gyro: bool, rate: float
) -> tuple[Trajectory, dict[str, float]]:
    """The odometry of two wheels, with the heading of a gyroscope if there is one, and its errors. rate: poses in a second.

    Unequal wheels turn the odometry as they roll, which is no constant bias, so wheels alone have none.
    """
    track, slip, tick = rng.uniform(0.2, 0.6), rng.uniform(0.003, 0.02), rng.uniform(0.0005, 0.003)
    both, wide = rng.normal(0, 0.015), 1 + rng.normal(0, 0.03)
    moved, longer = [], []
    for side in (-1, 1):
        way = (forward + side * turning * track / 2) * STEP
        longer.append(1 + both + rng.normal(0, 0.003))
        way = way * longer[-1] + slip * np.sqrt(np.abs(way)) * rng.normal(size=len(way))
        moved.append(np.diff(np.floor(np.cumsum(way) / tick) * tick, prepend=0.0))
    ahead, turn, aside = (moved[0] + moved[1]) / 2, (moved[1] - moved[0]) / (track * wide), np.zeros(len(stamps))
    slipped = np.flatnonzero((rng.random(len(stamps)) < STEP / SLIPS) & (forward > 0.05))
    turn[slipped] += rng.normal(0, np.radians(2), len(slipped))
    aside[slipped] += rng.normal(0, 0.02, len(slipped))
    faster, bias = float(np.mean(longer)) / wide, 0.0
    if gyro:
        noise = rng.uniform(0.0005, 0.003) * np.sqrt(STEP) * rng.normal(size=len(turn))
        faster, bias = 1 + rng.normal(0, 0.01), rng.normal(0, 0.002)
        turn = (turning * faster + bias) * STEP + noise
    yaw = np.cumsum(turn)
    c, s = np.cos(yaw - turn / 2), np.sin(yaw - turn / 2)
    pose = np.column_stack([np.cumsum(ahead * c - aside * s), np.cumsum(ahead * s + aside * c), yaw])
    every = max(round(1 / (rate * STEP)), 1)
    true = {"odometry.scale": 1 / float(np.mean(longer)) - 1, "odometry.turn_scale": 1 / faster - 1}
    true |= {"odometry.turn_bias": -bias / faster} if gyro else {}
    return Trajectory(stamps[::every], lift_se2(pose[::every])), true


def vio(rng: np.random.Generator, stamps: Floats, path: Floats, rate: float) -> tuple[Trajectory, dict[str, float]]:
    """A path with a wrong scale, and with drift in all six directions, and its errors."""
    every = max(round(1 / (rate * STEP)), 1)
    poses = lift_se2(path[::every])
    steps = inverse(poses[:-1]) @ poses[1:]
    root = np.sqrt(np.linalg.norm(steps[:, :3, 3], axis=1) + 1e-6)[:, None]
    turn = rng.uniform(0.001, 0.003) * root * rng.normal(size=(len(steps), 3)) * [0.3, 0.3, 1]
    way = rng.uniform(0.002, 0.01) * root * rng.normal(size=(len(steps), 3)) * [1, 1, 0.5]
    longer = 1 + rng.normal(0, 0.01)
    steps[:, :3, 3] *= longer
    found = [poses[0]]
    for step in steps @ make_pose(rotation_from_vector(turn), way):
        found.append(found[-1] @ step)
    true = {"odometry.scale": 1 / longer - 1, "odometry.turn_scale": 0.0, "odometry.turn_bias": 0.0}
    return Trajectory(stamps[::every], np.array(found)), true


def mounted(rng: np.random.Generator, name: str = "front", side: float = 0.0) -> tuple[Camera, Floats, dict[str, float]]:
    """A camera that looks ahead, or to a side (rad), as its calibration says, where it really is (4, 4) on the robot, and
    its turns, rad."""
    focal, height = rng.uniform(350, 700), rng.uniform(0.2, 1.2)
    roll, tilt, yaw = rng.normal(0, [0.01, 0.015, 0.02])
    ahead = rotation_from_vector(np.array([0, 0, side])) @ [[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    turns = rotation_from_vector(np.array([[0, 0, yaw], [0, tilt, 0], [roll, 0, 0]]))
    place = np.array([0.15, 0.0, height])
    matrix = np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1]])
    camera = Camera(name, 640, 480, matrix, base_T_camera=make_pose(ahead, place))
    true = {"roll": float(roll), "tilt": float(tilt), "yaw": float(yaw)}
    return camera, make_pose(turns[0] @ turns[1] @ turns[2] @ ahead, place), true


def boxes_of(
    rng: np.random.Generator,
    camera: Camera,
    map_T_camera: Floats,
    places: Floats,
    stamps: Floats,
    names: tuple[str, ...],
    *,
    ranged: bool,
) -> Detections:
    """The boxes of objects at places (N, 3), m, in images from poses (F, 4, 4). stamps: (F,) s, of the images."""
    number = len(places)
    size, noise = rng.uniform(0.08, 0.6, number), rng.uniform(1, 3)
    away = places[None] - map_T_camera[:, None, :3, 3]
    local, distance = np.einsum("kji,knj->kni", map_T_camera[:, :3, :3], away), np.linalg.norm(away, axis=2)
    with np.errstate(all="ignore"):
        pixels = project(camera, local.reshape(-1, 3)).reshape(*local.shape[:2], 2)
    side = np.arctan2(-away[..., 1], -away[..., 0])
    waves = np.stack([np.ones_like(side), np.cos(side), np.sin(side), np.cos(2 * side), np.sin(2 * side)])
    beside = SIDES * size[:, None] * np.einsum("wkn,nwa->kna", waves, rng.normal(size=(number, 5, 2)))
    focal = camera.matrix[0, 0]
    pixels = pixels + beside * focal / distance[..., None] + noise * rng.normal(size=pixels.shape)
    half = (size * focal / distance / 2)[..., None]
    whole = ((pixels - half > 1) & (pixels + half < camera.size - 2)).all(axis=2)
    frame, thing = np.nonzero((local[..., 2] > 0.3) & (distance < 7) & whole & (rng.random(distance.shape) < 0.8))
    at, reach, depth = pixels[frame, thing], half[frame, thing], local[frame, thing, 2]
    measured: Any = np.full(len(frame), np.nan)
    if ranged:
        measured = depth * (1 + rng.normal(0, 0.01)) + np.hypot(0.02, 0.01 * depth) * rng.normal(size=len(frame))
        measured = measured + np.where(rng.random(len(frame)) < 0.05, rng.uniform(0.2, 2, len(frame)), 0.0)
    wrong = rng.random(len(frame)) < 0.01
    label = np.where(wrong, rng.integers(0, number, len(frame)), thing)
    behind = size / 2 * np.maximum(rng.uniform(0, 1) + SURFACES * rng.normal(size=number), 0.0)
    measured = measured - (behind[:, None] * (local[..., 2] / distance).T)[thing, frame]
    return Detections(
        frame_stamps=stamps,
        frame=frame,
        boxes=np.concatenate([at - reach, at + reach], axis=1).round(),
        label=label,
        scores=np.ones(len(frame)),
        depths=measured,
        track_ids=np.full(len(frame), -1),
        label_names=names,
    )


if __name__ == "__main__":
    main()
