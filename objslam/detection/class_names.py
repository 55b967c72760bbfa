"""The class names of a model: from the settings, from the model's metadata, or from COCO if the number of classes
matches."""

import ast
import json
import warnings
from pathlib import Path
from typing import Any

import yaml

from objslam import config
from objslam.core.coco import COCO_NAMES
from objslam.errors import ConfigError, DetectorError

_GAPS = frozenset({0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83})  # The numbers among COCO's 91 that have no class.
_BACKGROUND = frozenset({"background", "__background__", "n/a", "no object"})  # The class names that mean no object.
_MOST = 100_000  # The class numbers in a dictionary of names must be below this number. The limit bounds memory.


def _coco91() -> tuple[str, ...]:
    names = iter(COCO_NAMES)
    return tuple("N/A" if number in _GAPS else next(names) for number in range(91))


KNOWN = {"coco": COCO_NAMES, "coco91": _coco91()}
"""The lists of class names that `detector.names` accepts by name."""


def is_background(name: str) -> bool:
    """Return whether a class name means that there is no object."""
    return name.strip().lower() in _BACKGROUND


def names_from_settings(given: tuple[str, ...] | str | None, model: Path) -> tuple[str, ...] | None:
    """Return the class names of the setting `detector.names`: a list, coco, coco91 or a file. A file is looked up as given,
    then in the model's folder. Raises ConfigError if the file is missing or unreadable, or a name is empty or not
    printable."""
    if given is None:
        return None
    if isinstance(given, tuple):
        return _checked(given, "detector.names")
    if given in KNOWN:
        return KNOWN[given]
    places = (Path(given), model.parent / given)
    file = next((place for place in places if config.is_file(place)), None)
    if file is None:
        looked = " and ".join(dict.fromkeys(str(place) for place in places))
        raise ConfigError(f"there is no names file {given}", hint=f"looked for {looked}; known lists: {', '.join(KNOWN)}")
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"the names cannot be read: {error}", where=str(file)) from error
    if file.suffix.lower() not in (".yaml", ".yml", ".json"):
        return _checked(tuple(line.strip() for line in text.rstrip().splitlines()), str(file))
    try:
        data = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"not YAML: {str(error).splitlines()[0]}", where=str(file)) from error
    names = _as_names(data.get("names", data) if isinstance(data, dict) else data)
    if names is None:
        raise ConfigError("no list of names in it", where=str(file), hint="names: [cup, book] or names: {0: cup, 1: book}")
    return _checked(names, str(file))


def names_from_metadata(text: str | None, model: Path) -> tuple[str, ...] | None:
    """Parse the names in a model's metadata, a list or dictionary in Python or JSON. Return None if there is no text.
    Raises DetectorError if the text is something else, and ConfigError if a name is empty or not printable."""
    if not text:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python also warns of some texts that it cannot parse.
            data = ast.literal_eval(text)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        try:
            data = json.loads(text)
        except (ValueError, RecursionError):
            data = None
    names = _as_names(data)
    if names is None:
        message = f"the names in the model's metadata are no list of names: {text[:60]!r}"
        raise DetectorError(message, where=str(model), hint="set detector.names")
    return _checked(names, f"{model}, metadata")


def default_names(count: int) -> tuple[tuple[str, ...], str] | None:
    """Return the COCO list with `count` names, and a warning that the list is a guess. Return None if no list has `count`
    names."""
    for key, names in KNOWN.items():
        if len(names) == count:
            return names, f"the model names no classes: the {count} names of {key} are used, because it has {count} classes"
    return None


def _as_names(data: Any) -> tuple[str, ...] | None:
    if isinstance(data, dict):
        try:
            numbered = {int(number): name for number, name in data.items()}
        except (TypeError, ValueError, OverflowError):
            return None
        if not numbered or min(numbered) < 0 or max(numbered) >= _MOST:
            return None
        data = [numbered.get(number, f"class_{number}") for number in range(max(numbered) + 1)]
    if not isinstance(data, list | tuple) or not data or not all(isinstance(name, str | int) for name in data):
        return None
    try:
        return tuple(str(name).strip() for name in data)
    except ValueError:  # A number of more than 4300 digits.
        return None


def _checked(names: tuple[str, ...], where: str) -> tuple[str, ...]:
    for number, name in enumerate(names):
        if not name.strip() or not name.isprintable():
            raise ConfigError(f"the name of class {number} is empty or not printable", where=where)
    if not names:
        raise ConfigError("no name in it", where=where)
    return names
