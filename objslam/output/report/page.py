"""Make the HTML page of a result folder. This module collects the data, and a template arranges them."""

import json
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from objslam.config import Settings, dump_settings, load_settings
from objslam.core.bodies.body import UNKNOWN_YAW
from objslam.core.diagnostics import is_drop
from objslam.core.validity import is_date
from objslam.errors import ConfigError, LogError, OutputError
from objslam.evaluation.alignment import lay_truth
from objslam.evaluation.evaluate_folder import evaluate_folder
from objslam.io.atomic_files import write_file
from objslam.io.rays_parquet import RaysTable
from objslam.io.results.files import CONFIG, PICTURE, REPORT
from objslam.io.results.read import (
    is_site,
    load_doubts,
    load_evaluation,
    load_map,
    load_path,
    load_rays,
    load_summary,
    load_truth,
)
from objslam.mapping.checks.assessment import HEADLINES
from objslam.output.report.cards import make_cards
from objslam.output.report.charts import histogram
from objslam.output.report.crops import Kind, choose_rays, choose_unexplained, cut_crops, images_of, spread_over_time
from objslam.output.report.render import render
from objslam.output.report.scene import scene_data
from objslam.output.report.site_page import write_site_report
from objslam.output.report.trends import trends

_BINS = 32  # The number of bars in the histogram of all rays. More bars show more detail, and each bar has fewer rays.
_LABELS = 12  # The most labels for which the page shows boxes of no object. A longer list would not be read.
_KNOWN_YAW = 0.999 * UNKNOWN_YAW  # The standard deviation (rad) from which a yaw counts as unknown.
_COUNTS = {
    "images": "colour images",
    "detection_frames": "camera frames",
    "frames_on_path": "camera frames on the path",
    "keyframes": "keyframes (with a usable box)",
    "detections": "boxes",
    "rays": "usable boxes (rays)",
    "rays_rejected": "rays rejected as outliers",
    "rays_unexplained": "rays that no object explains",
    "objects": "objects",
    "unresolved": "unresolved objects",
}
"""The words that the page shows for the counts in summary.json."""


def write_report(
    out: Path,
    *,
    log: Path | None = None,
    crops: int = 4,
    images_needed: bool = False,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Path:
    """Write report.html into the result folder `out` and return its path. The map of a site gets another kind of page.

    Args:
        log: the path of the run's log, which has the images for the pictures. The default is the path in summary.json.
        crops: the largest number of pictures of the best boxes of an object, 0 for no pictures. The worst boxes and the
            rejected boxes of an object each get half of this number. The boxes of no object get `crops` for each label.
        images_needed: whether a log without images is an error. If not, the page states why it has no pictures.
        progress: a function that gets the name of the stage, the number of steps done and the number of all steps.
    Raises:
        OutputError: the result cannot be read, or the page cannot be written.
        LogError: the ground truth cannot be read, or `images_needed` and there are no images.
    """
    if is_site(out):
        return write_site_report(out)
    progress("reading the result", 0, 0)
    objects, rays, summary = load_map(out), load_rays(out), load_summary(out)
    try:
        settings = load_settings(out / CONFIG)
    except ConfigError as error:
        raise OutputError(error.message.splitlines()[0], where=error.where) from error
    errors, scores = _evaluation(out)
    path = load_path(out)
    truth = load_truth(out)
    laid = None if truth is None else lay_truth(objects, truth)
    up = summary.get("up", "z")
    chosen = {o.id: choose_rays(rays, np.flatnonzero(rays.object == o.id), crops) for o in objects}
    unexplained = _unexplained(rays, crops)
    doubts = load_doubts(out) or ()
    of_doubt = [spread_over_time(rays, one.rays[one.rays < len(rays)], crops) for one in doubts]
    counts = summary.get("counts", {})
    where, number = (summary.get("log_path"), counts.get("images")) if log is None else (log, None)
    images, no_images = images_of(where, number) if crops else ({}, None)
    if images_needed and no_images is not None:
        raise LogError(no_images)
    wanted: dict[int, Kind] = {}
    for some in (*chosen.values(), *unexplained.values(), *of_doubt):
        wanted |= some
    pictures = cut_crops(rays, wanted, images, lambda done, total: progress("pictures", done, total))
    if images and wanted and not pictures:
        no_images = "No image of the log can be read at the times of the boxes: is it the log of this run?"
    crops_of = {number: [pictures[i] for i in index if i in pictures] for number, index in chosen.items()}
    begin = float(rays.stamp.min()) if len(rays) else 0.0
    cards = make_cards(objects, rays, crops_of, errors, path.poses[:, :3, 3], up)
    picture, examples = out / PICTURE, summary.get("dropped_examples", {})
    page = render(
        "page.html.jinja",
        scene=scene_data(objects, rays, path, laid, up) if len(objects) else None,
        name=str(summary.get("log", out.resolve().name)),
        folder=out.resolve().name,
        mode=settings.mode,
        frame=objects.frame,
        start=datetime.fromtimestamp(begin, UTC).strftime("%Y-%m-%d %H:%M:%S UTC") if is_date(begin) else None,
        duration=float(rays.stamp.max()) - begin if len(rays) else 0.0,
        picture=picture.read_bytes() if picture.is_file() else None,
        cards=cards,
        ids={o.id for o in objects},
        with_errors=any(card.error is not None for card in cards),
        with_size=any(o.body is not None or o.tag is not None for o in objects),
        unknown_yaw=_KNOWN_YAW,
        with_existence=any(card.object.existence is not None for card in cards),
        histogram=histogram(np.degrees(rays.residual), rays.weight, _BINS),
        trends=trends(rays),
        calibration=summary.get("calibration"),
        assessment=summary.get("assessment"),
        headlines=HEADLINES,
        localisation=summary.get("localisation"),
        scores=scores,
        no_images=no_images,
        counts=[(_COUNTS.get(key, key), value) for key, value in counts.items()],
        unexplained=summary.get("unexplained_share", {}),
        of_no_object={
            label: (int(((rays.object < 0) & (rays.label == label)).sum()), [pictures[i] for i in index if i in pictures])
            for label, index in unexplained.items()
        },
        doubts=[(one, [pictures[i] for i in index if i in pictures]) for one, index in zip(doubts, of_doubt, strict=True)],
        dropped=[(why, n, "; ".join(examples.get(why, []))) for why, n in summary.get("dropped", {}).items()],
        warnings=[line for line in summary.get("warnings", []) if not is_drop(line)],  # These have a table of their own.
        **{key: summary.get(key, {}) for key in ("seconds", "versions")},
        costs={key: summary[key] for key in ("cost_before", "cost_after", "iterations") if summary.get(key) is not None},
        changed=_changed(settings),
        settings=dump_settings(settings),
    )
    write_file(out / REPORT, page.encode("utf-8", errors="replace"))
    return out / REPORT


def _unexplained(rays: RaysTable, crops: int) -> dict[str, dict[int, Kind]]:
    """Return the labels with the most boxes of no object, the most frequent first, each with the rays for its pictures."""
    labels, counts = np.unique(rays.label[rays.object < 0].astype(str), return_counts=True)
    most = labels[np.argsort(-counts, kind="stable")][:_LABELS]
    return {str(label): choose_unexplained(rays, str(label), crops) for label in most}


def _evaluation(out: Path) -> tuple[dict[int, tuple[float, str]], dict[str, Any] | None]:
    """Return two values: the errors of the matched objects, and the content of evaluation.json.

    The errors map the id of each matched object to its error, m, and a text that names its match. If evaluation.json does
    not exist, the map is compared with the ground truth as `objslam eval` does by default. Without a ground truth, the
    errors are empty, and the content is None.
    """
    scores = load_evaluation(out)
    if scores is None:
        if load_truth(out) is None:
            return {}, None
        scores = evaluate_folder(out).to_dict()
    matched = scores.get("objects", [])
    whose = "to id {} there" if scores.get("truth") else "truth id {}"
    return {o["id"]: (float(o["error"]), whose.format(o["truth_id"])) for o in matched}, scores


def _changed(settings: Settings) -> list[tuple[str, str, str]]:
    """Return the name, the value and the default of each setting that differs from its default."""
    now, default = _flat(settings.model_dump(mode="json")), _flat(Settings().model_dump(mode="json"))
    shown = partial(json.dumps, ensure_ascii=False)
    return [(key, shown(value), shown(default.get(key))) for key, value in now.items() if value != default.get(key)]


def _flat(data: dict[str, Any], before: str = "") -> dict[str, Any]:
    """Return nested mappings as one mapping. Its keys start with `before` and join the nested keys with dots."""
    flat: dict[str, Any] = {}
    for key, value in data.items():
        flat |= _flat(value, f"{before}{key}.") if isinstance(value, dict) else {f"{before}{key}": value}
    return flat
