"""Evaluate a result folder: find the ground truth, choose the alignment for the map's frame, and write evaluation.json."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

from objslam.errors import LogError
from objslam.evaluation.alignment import Alignment
from objslam.evaluation.evaluate import Evaluation, check_radius, evaluate
from objslam.io.atomic_files import write_file
from objslam.io.results.files import EVALUATION, GROUNDTRUTH, OBJECTS, SITE_FRAME, TRAJECTORY, dump_json
from objslam.io.results.read import load_map, load_summary, load_trajectory, load_truth

AlignmentChoice = Literal["auto", "none", "se2", "sim2", "se3", "sim3"]
"""An alignment, or `auto`: the alignment that the frame of the map needs (see `choose_alignment`)."""

_IN_SPACE = "the map has the frame of the odometry, which is not planar"


def choose_alignment(out: Path) -> tuple[Alignment, str]:
    """Return the alignment that the frame of the result in `out` needs, and the reason for it.

    A map in the frame of a localisation or of an older map needs none. A map in the frame of the odometry has its own origin
    and heading, and needs se2. If its path is not planar, the direction of gravity may be unknown too, and the map needs
    se3. A map of several sessions has the frame of the first session, and needs se2. A map of an unknown frame gets none.
    """
    summary = load_summary(out)
    if summary.get("map_frame") == "localization":
        return "none", "the map has the frame of the localisation"
    if summary.get("map_frame") == "map":
        return "none", "the drive was found in an older map, and has its frame"
    if summary.get("map_frame") == SITE_FRAME:
        return "se2", "the map has the frame of its first session"
    if summary.get("map_frame") == "odometry":
        planar = summary.get("planar") is not False
        return ("se2", "the map has the frame of the odometry") if planar else ("se3", _IN_SPACE)
    return "none", "the result does not say in which frame its map is"


def evaluate_folder(
    out: Path, truth: Path | None = None, *, align: AlignmentChoice = "auto", radius: float = 0.5
) -> Evaluation:
    """Compare the result folder `out` with the ground truth at the path `truth` (see `load_truth`).

    By default, the ground truth of the result's log is used. radius: the largest distance of a match, m. Raises LogError if
    there is no truth, OutputError if the result cannot be read, and ConfigError if the radius is not positive.
    """
    check_radius(radius)
    map_, known = load_map(out), load_truth(truth or out)
    path = None if load_summary(out).get("map_frame") == SITE_FRAME else load_trajectory(out)  # A site has no path.
    if known is None:
        if truth is None:
            raise LogError("the log of this result has no ground truth", where=str(out), hint="give --truth FILE")
        message = f"no ground truth here: looked for {GROUNDTRUTH}/{OBJECTS} or {GROUNDTRUTH}/{TRAJECTORY}"
        raise LogError(message, where=str(truth), hint="give an objects file, or a folder with such a file")
    if not known.objects and known.trajectory is None:
        raise LogError("the ground truth is empty", where=str(truth or out), hint="give --truth FILE")
    kind, why = choose_alignment(out) if align == "auto" else (align, "as asked")
    evaluation = evaluate(map_, known, path, align=kind, radius=radius)
    return replace(evaluation, why=why, truth=None if truth is None else str(truth))


def write_evaluation(evaluation: Evaluation, out: Path) -> None:
    """Write evaluation.json into the result folder `out`. Raises OutputError if the file cannot be written."""
    write_file(out / EVALUATION, dump_json(evaluation.to_dict()).encode())
