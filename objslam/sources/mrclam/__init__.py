"""UTIAS MRCLAM: the options that such a folder takes.

How the folder is read is in `reader`, which is imported when a folder is read.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from objslam.sources.options import Option, WithRange


@dataclass(frozen=True)
class MrclamOptions:
    """What the folder does not say: the robot, whether its ranges are used, and whether landmarks hide who they are."""

    robot: Annotated[int | None, Option("--robot", "MRCLAM: which robot.")] = None
    with_range: WithRange = True
    anonymous: Annotated[bool, Option("--anonymous", "MRCLAM: every landmark gets the same label.")] = False
