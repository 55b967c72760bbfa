"""The options of TUM RGB-D datasets. The module `reader` reads the folders. `--help` does not import `reader`."""

from dataclasses import dataclass

from objslam.sources.options import Label, WithRange


@dataclass(frozen=True)
class TumOptions:
    """The options of a TUM dataset. label: the label of boxes without a class. with_range: whether boxes get depths from the
    depth images."""

    label: Label = None
    with_range: WithRange = True
