"""The options of UTIAS MRCLAM datasets. The folders are read in `reader`, which `--help` does not import."""

from dataclasses import dataclass
from typing import Annotated

from objslam.sources.options import Option, WithRange


@dataclass(frozen=True)
class MrclamOptions:
    """Choices that the folder leaves open: the robot, the use of ranges, and whether all landmarks share one label."""

    robot: Annotated[int | None, Option("--robot", "MRCLAM: the number of the robot.")] = None
    with_range: WithRange = True
    anonymous: Annotated[bool, Option("--anonymous", "MRCLAM: every landmark gets the same label.")] = False
