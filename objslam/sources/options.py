"""How a source declares an option of its own, and the options that several sources share.

A source's options are the fields of a frozen dataclass in the source's own file or folder. The command line shows those of
all sources, so a file that declares options may import nothing heavy at its top, not even numpy.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, fields
from typing import Annotated, Any, get_type_hints


@dataclass(frozen=True)
class Option:
    """What the command line calls a field: `stride: Annotated[int, Option("--stride", "Every Nth frame.")] = 1`.

    A field without an Option is for Python alone. A field that is a tuple may be given several times.

    Attributes:
        flag: its name; "--rectified/--raw" names both values of a bool. The one name of a bool stands for the opposite of
            the default.
        help: what `--help` says.
        metavar: what `--help` calls the value.
    """

    flag: str
    help: str
    metavar: str | None = None


WithRange = Annotated[bool, Option("--without-range", "MRCLAM: bearings only.")]
Label = Annotated[str | None, Option("--label", "Label for boxes that come without one.")]
DETECTOR = Option("--detector", "ONNX model that finds the boxes in the rgb images, in place of those of the log.")
"""What finds boxes in images: an option of `objslam run`, and of a robot that is heard live."""


@dataclass(frozen=True)
class AnyOptions:
    """What may be said of any recording: the name of its source, None to guess it."""

    format: Annotated[str | None, Option("--format", "What the recording is; guessed if not given.")] = None


def names(*kinds: type[Any] | None) -> frozenset[str]:
    """The names of the fields of classes of options."""
    return frozenset(field.name for kind in kinds if kind is not None for field in fields(kind))


def flags(kind: type[Any]) -> dict[str, tuple[Any, Option]]:
    """The type and the Option of each field of a class of options that has one, in the order of `--help`."""
    hints = get_type_hints(kind, include_extras=True)
    extras = {field.name: getattr(hints[field.name], "__metadata__", ()) for field in fields(kind)}
    return {name: (hints[name].__origin__, e) for name, found in extras.items() for e in found if isinstance(e, Option)}


def unused(options: Any, kind: type[Any], taken: Collection[str]) -> list[str]:
    """What the command line calls those fields of `kind` that `options` sets, though their names are not in `taken`."""
    called = {name: option.flag.partition("/")[0] for name, (_, option) in flags(kind).items()}
    return [
        called.get(field.name, f"--{field.name.replace('_', '-')}")
        for field in fields(kind)
        if field.name not in taken and getattr(options, field.name) != field.default
    ]
