"""Put each kind of mistake into a simulated log, and with --log into a recorded one, and print what the checks say of it."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from objslam.config import Odometry, Settings, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import align
from objslam.core.types import Log
from objslam.errors import ObjslamError
from objslam.mapping import pipeline
from objslam.mapping.checks.diagnosis import diagnose
from objslam.simulation import DepthNoise, PoseNoise, preset, simulate
from objslam.simulation.wrong_inputs import MISTAKES, join
from objslam.sources import SourceOptions, read

ROOM = {"objects": 10, "classes": 10, "pixel_sigma": 2.0, "missed": 0.1, "false": 0.01, "frames": 300}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--log", type=Path, help="a recorded log with poses, which gets the same mistakes")
    parser.add_argument("--robot", type=int, help="the robot of an MRCLAM folder")
    parser.add_argument("--label", help="the label of the boxes of a TUM RGB-D folder")
    parser.add_argument("--modes", nargs="+", default=["fixed", "joint"], choices=["fixed", "joint"])
    parser.add_argument("--cases", nargs="+", help="the names of the mistakes, by default all", metavar="NAME")
    parser.add_argument("--clean", type=int, default=0, metavar="N", help="count false alarms in N logs a mode instead")
    parser.add_argument(
        "--map", action="store_true", help="also map each log, and compare errors with sigmas (takes minutes)"
    )
    options = parser.parse_args()
    if options.clean:
        clean(options.clean, options.modes)
        return
    recorded = None
    if options.log is not None:
        recorded = read(options.log, Ledger(), SourceOptions(robot=options.robot, label=options.label))
    print("mode  | log       | case                           | said, and median and worst error / sigma of ok objects")
    for mode in options.modes:
        settings = load_settings(None, (f"mode={mode}", "output.recording=false", "reconstruction.use=false"))
        for name in options.cases or ["none", *MISTAKES, "half the boxes of another day", "half the log of another day"]:
            print(f"{mode:5s} | simulated | {name:30s} | {told(simulated(mode, name), settings, options.map)}", flush=True)
            if recorded is not None and name in {"none", *MISTAKES}:
                log = MISTAKES[name](recorded) if name != "none" else recorded
                print(f"{mode:5s} | recorded  | {name:30s} | {told(log, settings, options.map)}", flush=True)


def drive(mode: str, seed: int, *, depth: bool = False) -> Log:
    """A drive with localisation for `fixed`, with odometry alone for `joint`."""
    changes = {**ROOM, "depth": DepthNoise() if depth else None}
    changes |= {"odometry": None} if mode == "fixed" else {"odometry": Odometry(), "localization": None}
    if mode == "fixed":
        changes["localization"] = PoseNoise(xy=0.02, yaw=0.005)
    return simulate(preset("demo", **changes), seed)


def simulated(mode: str, name: str) -> Log:
    """A simulated log with a mistake."""
    log = drive(mode, 0, depth="depth" in name)
    if name.startswith("half the"):
        return join(log, drive(mode, 1), interleaved="boxes" in name)
    return MISTAKES[name](log) if name != "none" else log


def told(log: Log, settings: Settings, solve: bool) -> str:
    """What the checks say of a log, and how the errors of a map compare with its sigmas."""
    try:
        if not solve:
            return "; ".join(finding.message for finding in diagnose(log, settings, Ledger()).findings) or "-"
        ledger = Ledger()
        result = pipeline.run(log, settings, ledger)
    except ObjslamError as error:
        return f"refused: {error}"
    said = "; ".join(ledger.warnings) or "-"
    return f"{said} | {against_sigma(result.map.resolved(), log, settings.mode)}"


def against_sigma(objects: tuple, log: Log, mode: str) -> str:  # type: ignore[type-arg]
    """The errors of objects in their sigmas. Joint maps from odometry are laid on the truth first."""
    if log.truth is None or not log.truth.objects:
        return f"{len(objects)} ok, no truth"
    true = {item.label: item.position for item in log.truth.objects}
    pairs = [item for item in objects if item.label in true]
    if not pairs:
        return "0 ok"
    found, place = np.array([item.position for item in pairs]), np.array([true[item.label] for item in pairs])
    if mode == "joint" and log.localization is None:
        pose, _ = align(found, place, "se2")
        found = found @ pose[:3, :3].T + pose[:3, 3]
    off = np.linalg.norm(found - place, axis=1)
    sigmas = off / np.array([item.sigma for item in pairs])
    return f"{len(objects)} ok, error {np.median(off):.3f} m, {np.median(sigmas):.1f} and {sigmas.max():.1f} sigmas"


def drives(number: int, modes: list[str]) -> Iterator[tuple[str, Log]]:
    for seed in range(number):
        for mode in modes:
            yield mode, drive(mode, 100 + seed, depth=seed % 2 == 1)


def clean(number: int, modes: list[str]) -> None:
    """Print how many clean logs are found fault with."""
    alarms, logs = 0, 0
    for mode, log in drives(number, modes):
        found = diagnose(log, load_settings(None, (f"mode={mode}",)), Ledger(), thorough=True).findings
        alarms, logs = alarms + bool(found), logs + 1
        for finding in found:
            print(f"{mode}: {finding.message}", flush=True)
    print(f"{alarms} false alarms in {logs} clean logs")


if __name__ == "__main__":
    main()
