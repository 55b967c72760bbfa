"""The result of a run for users: the map, the path and the rays, from memory or from a result folder."""

from __future__ import annotations

from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Self

import numpy as np

from objslam.api.inputs import Trajectory
from objslam.core import types
from objslam.core.result import Doubt, RunResult
from objslam.errors import OutputError
from objslam.io.rays_parquet import RaysTable
from objslam.io.results.object_map import ObjectMap
from objslam.io.views_parquet import Views
from objslam.mapping.checks.assessment import Assessment


@dataclass(frozen=True)
class _Run:
    """The data from which `Result.save` writes a result folder. detected: whether this run made boxes or appearance vectors.
    If so, the folder contains all boxes."""

    result: RunResult
    log: types.Log | None
    detected: bool


@dataclass(frozen=True, eq=False)
class Result:
    """The result of a run.

    objects: the map. poses: the poses map_T_base, m, at each camera frame that had a usable box. path: the poses map_T_base
    at the full rate of the log. rays: all rays, with their objects and residuals. summary: the content of summary.json.
    folder: the folder from which the result was loaded, None for a result from memory.
    """

    objects: ObjectMap
    poses: Trajectory
    path: Trajectory
    rays: RaysTable
    summary: dict[str, Any]
    folder: Path | None = None
    _run: _Run | None = field(default=None, repr=False, compare=False)

    @classmethod
    def of(cls, result: RunResult, log: types.Log | None = None, *, detected: bool = False) -> Self:
        """Return the result of a mapping as a `Result`. log: the log that was mapped. detected: whether this run made the
        boxes of the log, or their appearance vectors."""
        from objslam.output.result_folder import rays_table

        stamps, first = np.unique(result.keyframes.stamps, return_index=True)
        return cls(
            ObjectMap.of(result.map),
            Trajectory(stamps, result.map_T_base[first]),
            Trajectory(result.path_after.stamps, result.path_after.poses),
            rays_table(result),
            result.summary,
            _run=_Run(result, log, detected),
        )

    @classmethod
    def load(cls, folder: str | PathLike[str]) -> Self:
        """Load a result folder. OutputError names what is missing or damaged."""
        from objslam.io.results import read

        at = Path(folder)
        poses, path = read.load_trajectory(at), read.load_path(at)
        return cls(
            ObjectMap.load(at),
            Trajectory(poses.stamps, poses.poses),
            Trajectory(path.stamps, path.poses),
            read.load_rays(at),
            read.load_summary(at),
            at,
        )

    def save(self, folder: str | PathLike[str]) -> tuple[str, ...]:
        """Write the result folder as `objslam run` does, and replace an older result in it. For a loaded result, copy its
        files.

        Return the names of the older result's files that were deleted and not replaced. OutputError if the folder cannot be
        written, or if it holds a log or files that no run wrote.
        """
        from objslam.output.result_folder import copy_result, write_result

        to = Path(folder)
        if self._run is None:
            assert self.folder is not None  # a result is from memory or from a folder
            return copy_result(self.folder, to)
        log = self._run.log
        truth = None if log is None else log.truth
        return write_result(self._run.result, to, truth, detected=log.cameras if log and self._run.detected else ())

    @property
    def assessment(self) -> Assessment:
        """The assessment of the result: whether the map can be used, and the reasons. OutputError for a result of an older
        version."""
        found = self.summary.get("assessment")
        if found is None:
            raise OutputError("this result is from an older version, without an assessment", hint="run again")
        return Assessment(found["level"], tuple(found.get("reasons", ())))

    @property
    def views(self) -> Views | None:
        """The camera poses at which the images were taken. None for a live session, or for a result of an older version."""
        from objslam.io.results import read

        if self._run is None:
            return None if self.folder is None else read.load_views(self.folder)
        run = self._run.result
        return None if run.views is None else Views.of(run.views, run.cameras, run.settings)

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """The doubts about the map, in words and numbers. Empty for a result of an older version."""
        from objslam.io.results import read

        if self._run is not None:
            return self._run.result.doubts
        return () if self.folder is None else read.load_doubts(self.folder) or ()

    @property
    def localised(self) -> bool:
        """Whether the drive was found in the map of another day. If so, the result is in the frame of that map."""
        return bool(self.summary.get("localisation", {}).get("localised", False))

    @property
    def warnings(self) -> tuple[str, ...]:
        """The warnings of the run as the terminal shows them, one line each. Warnings about dropped data come first."""
        return tuple(self.summary.get("warnings", ()))

    @property
    def dropped(self) -> dict[str, int]:
        """The number of dropped data for each reason."""
        return dict(self.summary.get("dropped", {}))

    def __repr__(self) -> str:
        judged = f"verdict: {self.assessment}\n" if "assessment" in self.summary else ""
        return f"Result: {len(self.poses)} poses, {len(self.rays)} rays\n{judged}{self.objects!r}"
