"""The declaration of command line options by sources, and the options that several sources share.

Each source declares its options as the fields of a frozen dataclass. `--help` imports every file that declares options. Such
a file must therefore not import slow packages at its top, not even numpy.
"""

from collections.abc import Collection
from dataclasses import dataclass, fields
from typing import Annotated, Any, get_type_hints


@dataclass(frozen=True)
class Option:
    """The command line option of a field, as in `stride: Annotated[int, Option("--stride", "Every Nth frame.")] = 1`.

    A field without an Option can only be set from Python. The option of a tuple field may be given several times.
    flag: the option's name. For a bool, "--rectified/--raw" names the options for True and False. A single name for a bool
    sets the opposite of the default. help: the text in `--help`. metavar: the name of the value in `--help`.
    """

    flag: str
    help: str
    metavar: str | None = None


WithRange = Annotated[bool, Option("--without-range", "MRCLAM, TUM, ROS bags: boxes without depths (bearings only).")]
Label = Annotated[str | None, Option("--label", "Label of boxes that have no class.")]
DETECTOR = Option("--detector", "ONNX model that finds boxes in the rgb images. Its boxes replace the boxes of the log.")
"""The option that chooses the detector, in `objslam run` and in live sessions."""


NAMES = Option(
    "--names",
    "Names of classes that a log or a model only numbers: coco, coco91, or a file (a name in each line, or YAML or JSON).",
    metavar="FILE|coco",
)
"""The option that gives the names of numbered classes. All recordings, adapters and detectors have this option."""
_KINDS = "Kind of the recording, such as ros or mrclam. A wrong name lists all. Default: found from its content."


@dataclass(frozen=True)
class AnyOptions:
    """The options of every source.

    format: the name of the source. With None, the content of the recording determines the source. class_names: the names for
    labels that are numbers, as an argument of `frontend.class_names.load_names`. None keeps the numbers. begin, end: the
    first and the last stamp of the recording that are used, s. None sets no limit.
    """

    format: Annotated[str | None, Option("--format", _KINDS)] = None
    class_names: Annotated[str | None, NAMES] = None
    begin: Annotated[float | None, Option("--begin", "Use the recording from this stamp on, s.", metavar="STAMP")] = None
    end: Annotated[float | None, Option("--end", "Use the recording up to this stamp, s.", metavar="STAMP")] = None


def names(*kinds: type[Any] | None) -> frozenset[str]:
    """Return the names of all fields of the option classes `kinds`. None among the classes is ignored."""
    return frozenset(field.name for kind in kinds if kind is not None for field in fields(kind))


def flags(kind: type[Any]) -> dict[str, tuple[Any, Option]]:
    """Return the type and the Option of each field that has an Option, by field name and in the order of `--help`."""
    hints = get_type_hints(kind, include_extras=True)
    extras = {field.name: getattr(hints[field.name], "__metadata__", ()) for field in fields(kind)}
    return {name: (hints[name].__origin__, e) for name, found in extras.items() for e in found if isinstance(e, Option)}


def unused(options: Any, kind: type[Any], taken: Collection[str]) -> list[str]:
    """Return the flags of the options that are set but not used.

    options: an instance of the class `kind`. taken: the names of the fields that are used. An option is set if its value is
    not the default. For a field without an Option, the flag is made from the field's name.
    """
    called = {name: option.flag.partition("/")[0] for name, (_, option) in flags(kind).items()}
    return [
        called.get(field.name, f"--{field.name.replace('_', '-')}")
        for field in fields(kind)
        if field.name not in taken and getattr(options, field.name) != field.default
    ]
