"""Measure whether the sigmas of the calibration are right, on simulated drives with shared errors drawn from their priors.

    python tools/bench_calibration.py [--modes fixed joint] [--drives 20]

The errors are those that a run with default settings estimates. Each drive is also solved without errors, and without
calibration. In the mode fixed, the poses are from a localisation. In the mode joint, they are from odometry, with ranges and
without. There, a map begins in the frame of the odometry at the first image with boxes. So the odometry of a drive has no
error there.

found, missing, false: the objects that are ok, the true objects without one, and the objects beyond the first of a label.
level: the error in x and y. From bearings at known poses, no run can see the height of a camera, so the height of all
objects has its error.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import Any

import numpy as np
from added_errors import add_shared_errors

from objslam.config import Settings, load_settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import align, interpolate, inverse
from objslam.core.result import RunResult
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate

CHI2_95 = 7.815  # chi-squared, 3 degrees of freedom
CAMERA = {"front.clock": 0.1, "front.roll": 0.02, "front.tilt": 0.02, "front.yaw": 0.03}
ODOMETRY = {"odometry.scale": 0.03, "odometry.turn_scale": 0.05, "odometry.turn_bias": 0.003, "odometry.turn_slip": 0.02}
JOINT = {**ODOMETRY, "range_scale": 0.02, "range_offset": 0.05, **CAMERA}
LENS_AND_PLACE = {"front.focal": 0.02, "front.cx": 0.02, "front.cy": 0.02, "front.x": 0.05, "front.y": 0.05, "front.z": 0.05}
FIXED = {**CAMERA, **LENS_AND_PLACE}
UNSEEN = 0.5  # s at the start of a drive without boxes, so that no clock error moves a used frame beyond the odometry


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--modes", nargs="+", default=["fixed", "joint"], choices=["fixed", "joint"])
    parser.add_argument("--drives", type=int, default=20)
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--first", type=int, default=0, help="the seed of the first drive")
    options = parser.parse_args()
    for mode in options.modes:
        for ranged in (True, False) if mode == "joint" else (False,):
            rows = [drive(options.first + seed, options.frames, mode, ranged) for seed in range(options.drives)]
            kind = "bearings and ranges" if ranged else "bearings"
            print(f"== {mode}, {kind}, {options.drives} drives of {options.frames} frames")
            table(rows, FIXED if mode == "fixed" else JOINT)


def table(rows: list[dict[str, Any]], priors: dict[str, float]) -> None:
    """Print the maps of each kind of run, and the parameters."""
    for kind in ("errors, calibrated", "errors, not calibrated", "none, calibrated", "none or known, not calibrated"):
        off, squared, variance, aligned, seconds, missing, false = (
            np.concatenate([row[kind][i] for row in rows]) for i in range(7)
        )
        whole, level, promised, own = (
            np.sqrt(np.mean(of)) for of in ((off**2).sum(axis=1), (off[:, :2] ** 2).sum(axis=1), variance, aligned**2)
        )
        inside, middle = np.mean(squared < CHI2_95), np.median(squared)
        print(
            f"{kind:29s} found {len(off)}, missing {missing.sum():.0f}, false {false.sum():.0f}; RMSE {whole:.3f} m, level "
            f"{level:.3f} m (promised {promised:.3f}; after SE(2) alignment {own:.3f}); inside the 95 % ellipsoid "
            f"{inside:.3f}, squared Mahalanobis median {middle:.2f} (honest: 2.37); {np.mean(seconds):.2f} s of CPU",
            flush=True,
        )
    for name in rows[0]["parameters"]:
        deviations = np.array([row["parameters"][name][0] for row in rows])
        sigma = np.mean([row["parameters"][name][1] for row in rows])
        within, size = np.mean(deviations < 3), np.sqrt(np.mean(deviations**2))
        print(
            f"  {name:22s} sigma {sigma:.4f} of prior {priors[name]:.4f}; within 3 sigma {within:.2f}, RMS {size:.2f} sigma",
            flush=True,
        )


def drive(seed: int, frames: int, mode: str, ranged: bool) -> dict[str, Any]:
    """One drive, solved in four ways: what `solved` says of each.

    Known errors are taken out of the log. So the drive with known errors, not calibrated, is the drive without errors.
    """
    rng = np.random.default_rng((seed, 7))
    priors = FIXED if mode == "fixed" else JOINT
    errors = {name: sigma * rng.standard_normal() for name, sigma in priors.items() if ranged or name != "range_scale"}
    settings = load_settings(
        None, (f"mode={mode}", "output.recording=false", f"depth.use={str(ranged).lower()}", "depth.bias=0")
    )
    changes: dict[str, Any] = {"frames": frames, "pixel_sigma": 3.0, "objects": 12, "classes": 12}
    changes |= {"odometry": None} if mode == "fixed" else {"localization": None, "odometry": settings.odometry}
    if ranged:
        from objslam.simulation.settings import DepthNoise

        changes["depth"] = DepthNoise()
    clean = simulate(preset("demo", **changes), seed)
    if mode == "joint":
        clean = anchored(clean)
    wrong, off = (
        add_shared_errors(clean, errors),
        settings.model_copy(update={"calibration": settings.calibration.model_copy(update={"use": False})}),
    )
    found = solved(wrong, settings)
    parameters = found[0].summary["calibration"]["parameters"]
    return {
        "errors, calibrated": found[1:],
        "errors, not calibrated": solved(wrong, off)[1:],
        "none, calibrated": solved(clean, settings)[1:],
        "none or known, not calibrated": solved(clean, off)[1:],
        "parameters": {
            name: (abs(one["value"] - errors[name]) / one["sigma"], one["sigma"])
            for name, one in parameters.items()
            if name in errors
        },
    }


def anchored(log: Log) -> Log:
    """The log without the boxes of its first half second, with an odometry that is right at the first box after it."""
    (camera,), odometry = log.cameras, log.odometry
    true = None if log.truth is None else log.truth.trajectory
    assert camera.detections is not None
    assert odometry is not None
    assert true is not None
    found = camera.detections
    stamps = found.frame_stamps[found.frame]
    left = stamps > odometry.stamps[0] + UNSEEN
    is_, said = (interpolate(one.stamps, one.poses, stamps[left].min(keepdims=True), 1.0)[0][0] for one in (true, odometry))
    moved = Trajectory(odometry.stamps, is_ @ inverse(said) @ odometry.poses)
    return replace(log, odometry=moved, cameras=(replace(camera, detections=found.take(left)),))


def solved(log: Log, settings: Settings) -> tuple[RunResult, Floats, Floats, Floats, Floats, Floats, Floats, Floats]:
    """Run, and compare with the truth.

    Returns the result, the errors (n, 3) m of the objects nearest to the true object of their label, their squared
    Mahalanobis distances (n,), the variances (n,) m^2 that their covariances promise, the errors (n,) m after an SE(2)
    alignment, the CPU seconds (1,), and the numbers (1,) of true objects without one, and of further objects.
    """
    begin = time.process_time()
    result = pipeline.run(log, settings, Ledger())
    seconds = time.process_time() - begin
    assert log.truth is not None
    objects, true = [], []
    resolved = result.map.resolved()
    for one in log.truth.objects:
        mine = [o for o in resolved if o.label == one.label]
        if mine:
            objects.append(min(mine, key=lambda o: float(np.linalg.norm(o.position - one.position))))
            true.append(one.position)
    there = np.array(true).reshape(-1, 3)
    found = np.array([o.position for o in objects]).reshape(-1, 3)
    covariance = np.array([o.covariance for o in objects]).reshape(-1, 3, 3)
    off = found - there
    squared = np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., None])[..., 0])
    there_T_map = align(found, there, "se2")[0] if len(found) > 2 else np.eye(4)
    aligned = np.linalg.norm(found @ there_T_map[:3, :3].T + there_T_map[:3, 3] - there, axis=1)
    variance = np.trace(covariance, axis1=1, axis2=2)
    counts = (np.array([float(n)]) for n in (len(log.truth.objects) - len(found), len(resolved) - len(found)))
    return result, off, squared, variance, aligned, np.array([seconds]), *counts


if __name__ == "__main__":
    main()
