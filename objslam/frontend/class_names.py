"""Names of numbered classes, from a file or a known list. They replace labels that are class numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from objslam import config
from objslam.core.coco import COCO_NAMES
from objslam.core.diagnostics import Ledger
from objslam.core.types import CameraLog, Log
from objslam.errors import ConfigError

_GAPS = frozenset({0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83})  # The numbers among COCO's 91 that have no class.
_MOST = 100_000  # The class numbers in a dictionary of names must be below this number. The limit bounds memory.
_SHOWN = 5  # The most numbers without a name in a warning. A larger value makes a longer line.


def _coco91() -> dict[int, str]:
    return dict(zip((number for number in range(91) if number not in _GAPS), COCO_NAMES, strict=True))


KNOWN: dict[str, dict[int, str]] = {"coco": dict(enumerate(COCO_NAMES)), "coco91": _coco91()}
"""The known lists of class names, by the name of the list. A list has each class name by its number."""


def load_names(given: str, folders: Sequence[Path] = ()) -> dict[int, str]:
    """Return the names of classes by their numbers: from a known list or from a file.

    given: coco, coco91, or the path of a file. The path is tried as given, and then in `folders`. The file has a name in
    each line, or is YAML or JSON. YAML and JSON hold a list, a mapping by number, or either of them under the key `names`,
    as in the data.yaml of YOLO. ConfigError if the file is missing or unreadable, or a name is empty or not printable.
    """
    if given in KNOWN:
        return KNOWN[given]
    places = (Path(given), *(folder / given for folder in folders))
    file = next((place for place in places if config.is_file(place)), None)
    if file is None:
        looked = " and ".join(dict.fromkeys(str(place) for place in places))
        raise ConfigError(f"there is no names file {given}", hint=f"looked for {looked}; known lists: {', '.join(KNOWN)}")
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"the names cannot be read: {error}", where=str(file)) from error
    if file.suffix.lower() not in (".yaml", ".yml", ".json"):
        return checked(dict(enumerate(line.strip() for line in text.rstrip().splitlines())), str(file))
    try:
        data = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"not YAML: {str(error).splitlines()[0]}", where=str(file)) from error
    names = numbered(data.get("names", data) if isinstance(data, dict) else data)
    if names is None:
        raise ConfigError("no list of names in it", where=str(file), hint="names: [cup, book] or names: {0: cup, 1: book}")
    return checked(names, str(file))


def numbered(data: Any) -> dict[int, str] | None:
    """Return the names by number in a list of names or in a mapping by number. None if the data are something else."""
    pairs = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list | tuple) else ()
    try:
        names = {int(number): name for number, name in pairs}
        if not names or min(names) < 0 or max(names) >= _MOST or not all(isinstance(n, str | int) for n in names.values()):
            return None
        return {number: str(name).strip() for number, name in names.items()}
    except (TypeError, ValueError, OverflowError):  # ValueError also for a number of more than 4300 digits.
        return None


def checked(names: dict[int, str], where: str) -> dict[int, str]:
    """Return the names. ConfigError if there is no name, or a name is empty or not printable. where: their origin, for
    errors."""
    for number, name in names.items():
        if not name.strip() or not name.isprintable():
            raise ConfigError(f"the name of class {number} is empty or not printable", where=where)
    if not names:
        raise ConfigError("no name in it", where=where)
    return names


def named(label: str, names: Mapping[int, str]) -> str | None:
    """Return the name of a label that is a class number, None if the number has no name. Other labels are returned as they
    are."""
    if not (label.isascii() and label.isdigit()):
        return label
    return names.get(int(label)) if len(label) < len(str(_MOST)) else None


def with_names(log: Log, given: str, ledger: Ledger) -> Log:
    """Return the log with names in place of labels that are numbers. given: as for `load_names`.

    Labels whose number has no name do not change, and one warning counts their boxes. Labels of the ground truth also become
    names. ConfigError as for `load_names`.
    """
    names, unnamed = load_names(given), Counter[str]()
    cameras = tuple(_named_camera(one, names, unnamed) for one in log.cameras)
    if unnamed:
        labels = ", ".join(label for label, _ in unnamed.most_common(_SHOWN)) + ", ..." * (len(unnamed) > _SHOWN)
        boxes = "1 box keeps" if unnamed.total() == 1 else f"{unnamed.total()} boxes keep"
        ledger.warn(f"{boxes} a class number that {given} does not name: {labels}")
    truth = log.truth
    if truth is not None:
        objects = tuple(replace(one, label=named(one.label, names) or one.label) for one in truth.objects)
        truth = replace(truth, objects=objects)
    return replace(log, cameras=cameras, truth=truth)


def _named_camera(one: CameraLog, names: Mapping[int, str], unnamed: Counter[str]) -> CameraLog:
    found = one.detections
    if found is None:
        return one
    labels = [named(label, names) for label in found.label_names]
    count = np.bincount(found.label, minlength=len(labels))
    for old, new, boxes in zip(found.label_names, labels, count.tolist(), strict=True):
        if new is None and boxes:
            unnamed[old] += boxes
    kept = [new or old for old, new in zip(found.label_names, labels, strict=True)]
    distinct = tuple(dict.fromkeys(kept))  # Two labels may get one name, such as 41 and cup.
    index = np.array([distinct.index(label) for label in kept], dtype=np.int64)
    return replace(one, detections=replace(found, label=index[found.label], label_names=distinct))
