"""Write the map of a site: objects.json, summary.json and a picture, for each island of sessions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from objslam.core.geometry import split_se2
from objslam.io.atomic_files import encode, replace_files
from objslam.io.objects_json import dump_objects
from objslam.io.results import files
from objslam.io.results.files import dump_json
from objslam.mapping.sites.merge import Island
from objslam.output.plot.changes_plot import draw_site
from objslam.output.result_folder import RESULT_FILES, prepare_output

_MOST_ISLANDS = 100
"""The largest number of a folder island_N that is found from an earlier merge. With a larger number, more folders of a large
merge are found."""


def write_site(islands: Sequence[Island], names: Sequence[str], out: Path, warnings: Sequence[str] = ()) -> list[Path]:
    """Write the largest island into the folder `out`, the others into `out`/island_2 and so on. Return their folders.

    names: the names of all sessions, in their order. warnings: the texts that each summary.json gets. Raises OutputError if
    a folder cannot be written.
    """
    folders = [out if number == 0 else out / f"island_{number + 1}" for number in range(len(islands))]
    for folder, island in zip(folders, islands, strict=True):
        prepare_output(folder)
        summary = {**summarise_site(island, names), "islands": len(islands), "warnings": list(warnings)}
        replace_files(
            folder,
            RESULT_FILES,
            {
                files.OBJECTS: partial(_write, encode(dump_objects(island.objects))),
                files.PICTURE: partial(_write, draw_site(island.objects)),
                files.SUMMARY: partial(_write, encode(dump_json(summary))),
            },
        )
    return folders


def islands_of_earlier_merges(out: Path, count: int) -> list[Path]:
    """Return the folders of islands in `out` that a merge with `count` islands does not replace."""
    names = (f"island_{number + 1}" for number in range(count, _MOST_ISLANDS))
    return [out / name for name in names if (out / name / files.SUMMARY).is_file()]


def summarise_site(island: Island, names: Sequence[str]) -> dict[str, Any]:
    """Return the content of summary.json for an island: counts, and the pose of each session in the first one's frame."""
    objects = island.objects
    sigma = np.sqrt(np.diagonal(island.covariance, axis1=1, axis2=2)) * [1, 1, 1, np.degrees(1)]
    planar = split_se2(island.site_T_session)[0]
    sessions = [
        {
            "name": names[s],
            "x": float(pose[0, 3]),
            "y": float(pose[1, 3]),
            "z": float(pose[2, 3]),
            "yaw_deg": float(np.degrees(place[2])),
            "sigma": dict(zip(("x", "y", "z", "yaw_deg"), one.tolist(), strict=True)),
            "log_odds": float(odds),
            "common_objects": common,
        }
        for s, pose, place, one, odds, common in zip(
            island.sessions, island.site_T_session, planar, sigma, island.log_odds, island.common, strict=True
        )
    ]
    counts = {"objects": len(objects), "unresolved": 0, "gone": len(objects.gone), "sessions": len(sessions)}
    return {"map_frame": files.SITE_FRAME, "counts": counts, "sessions": sessions}


def _write(data: bytes, file: Path) -> None:
    file.write_bytes(data)
