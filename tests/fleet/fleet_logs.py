"""Small logs of a fleet, and a store that fails now and then."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
from fsspec.implementations.local import LocalFileSystem

from objslam.core.geometry import lift_se2
from objslam.core.types import Log
from objslam.mapping.localization import moved_log
from objslam.simulation import preset, simulate
from objslam.sources.log_folder import write_log_folder

LAYOUT = "{site}/{robot}/{day}/{log}"
HOUR = 3600.0


def write_logs(folder: Path, numbers: range, sites: int = 2, robots: int = 2) -> list[Path]:
    """Write small logs of sites that differ, each in a frame and at a time of its own."""
    return [_write(folder, k, k % sites, f"robot_{k % robots}", "2026-11-20" if k < 2 else "2026-11-21") for k in numbers]


def _write(folder: Path, number: int, site: int, robot: str, day: str) -> Path:
    truth = simulate(preset("demo", objects=14), 50 + site).truth
    assert truth is not None
    things = tuple((o.label, tuple(o.position)) for o in truth.objects)
    log = simulate(preset("demo", objects=0, placed=things, frames=200), 1000 + number)
    log = moved_log(later(log, number * HOUR), lift_se2(np.random.default_rng(number).uniform(-3, 3, 3)))
    path = folder / f"site_{site}" / robot / day / f"log_{number}"
    write_log_folder(replace(log, truth=None), path)
    return path


def later(log: Log, seconds: float) -> Log:
    """The log at a later time."""

    def path(one: Any) -> Any:
        return None if one is None else replace(one, stamps=one.stamps + seconds)

    cameras = tuple(
        replace(c, detections=replace(c.detections, frame_stamps=c.detections.frame_stamps + seconds), mount=path(c.mount))
        for c in log.cameras
        if c.detections is not None
    )
    return replace(log, cameras=cameras, odometry=path(log.odometry), localization=path(log.localization))


class Flaky(LocalFileSystem):
    """A disk on which every 20th call throws."""

    protocol = "flaky"
    calls = itertools.count(1)

    @classmethod
    def _strip_protocol(cls, path: Any) -> Any:
        if isinstance(path, list):
            return [cls._strip_protocol(one) for one in path]
        return LocalFileSystem._strip_protocol(str(path).replace("flaky://", "file://"))

    def _open(self, path: str, mode: str = "rb", **options: Any) -> Any:
        if next(self.calls) % 20 == 0:
            raise OSError("the store is busy")
        return super()._open(path, mode, **options)

    def ls(self, path: str, detail: bool = False, **options: Any) -> Any:
        if next(self.calls) % 20 == 0:
            raise OSError("the store is busy")
        return super().ls(path, detail, **options)


fsspec.register_implementation("flaky", Flaky, clobber=True)
