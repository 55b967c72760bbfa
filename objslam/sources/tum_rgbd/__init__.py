"""TUM RGB-D: the options that such a folder takes.

How its two layouts are read is in `reader`, which is imported when a folder is read.
"""

from __future__ import annotations

from dataclasses import dataclass

from objslam.sources.options import Label, WithRange


@dataclass(frozen=True)
class TumOptions:
    """What the folder does not say: the label of boxes without a class ("object"), and whether they get a depth."""

    label: Label = None
    with_range: WithRange = True
