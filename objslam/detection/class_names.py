"""Find the class names of a model. They come from the settings, from the model's metadata, or from COCO if the number of
classes matches."""

import ast
import json
import warnings
from collections.abc import Mapping
from pathlib import Path

from objslam.errors import DetectorError
from objslam.frontend import class_names
from objslam.frontend.class_names import checked, load_names, numbered

_BACKGROUND = frozenset({"background", "__background__", "n/a", "no object"})  # The class names that mean no object.

KNOWN = {
    key: tuple(names.get(number, "N/A") for number in range(max(names) + 1)) for key, names in class_names.KNOWN.items()
}
"""The lists of class names that `detector.names` accepts by name."""


def is_background(name: str) -> bool:
    """Return whether a class name means that there is no object."""
    return name.strip().lower() in _BACKGROUND


def names_from_settings(given: tuple[str, ...] | str | None, model: Path) -> tuple[str, ...] | None:
    """Return the class names of the setting `detector.names`, or None if it is not set.

    given: the setting, which is a tuple of names, coco, coco91 or a file. A file is looked up as given, then in the folder
    of the model. Raises ConfigError if the file is missing or unreadable, or if a name is empty or not printable.
    """
    if given is None:
        return None
    if isinstance(given, tuple):
        return _in_order(checked(dict(enumerate(given)), "detector.names"))
    return KNOWN[given] if given in KNOWN else _in_order(load_names(given, (model.parent,)))


def names_from_metadata(text: str | None, model: Path) -> tuple[str, ...] | None:
    """Return the class names in a model's metadata, or None if there is no text. text: a list, or a dictionary by class
    number, written in Python or JSON. Raises DetectorError for any other text, and ConfigError if a name is empty or not
    printable."""
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
    names = numbered(data)
    if names is None:
        message = f"the names in the model's metadata are no list of names: {text[:60]!r}"
        raise DetectorError(message, where=str(model), hint="set detector.names")
    return _in_order(checked(names, f"{model}, metadata"))


def default_names(count: int) -> tuple[tuple[str, ...], str] | None:
    """Return the COCO list with `count` names, and a warning that the list is a guess. Return None if no list has `count`
    names."""
    for key, names in KNOWN.items():
        if len(names) == count:
            return names, f"the model names no classes: the {count} names of {key} are used, because it has {count} classes"
    return None


def _in_order(names: Mapping[int, str]) -> tuple[str, ...]:
    return tuple(names.get(number, f"class_{number}") for number in range(max(names) + 1))
