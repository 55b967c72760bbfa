"""The options of UTIAS MRCLAM datasets. The module `reader` reads the folders. `--help` does not import `reader`."""

from dataclasses import dataclass
from typing import Annotated

from objslam.sources.options import Option, WithRange


@dataclass(frozen=True)
class MrclamOptions:
    """The options of an MRCLAM dataset: the robot, the use of ranges, and whether all landmarks have the same label."""

    robot: Annotated[int | None, Option("--robot", "MRCLAM: the number of the robot.")] = None
    with_range: WithRange = True
    anonymous: Annotated[bool, Option("--anonymous", "MRCLAM: every landmark gets the same label.")] = False
