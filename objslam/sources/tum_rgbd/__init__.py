"""The options of TUM RGB-D datasets. The folders are read in `reader`, which `--help` does not import."""

from dataclasses import dataclass

from objslam.sources.options import Label, WithRange


@dataclass(frozen=True)
class TumOptions:
    """Choices that the folder leaves open: the label of boxes without a class, and whether depth images give ranges."""

    label: Label = None
    with_range: WithRange = True
