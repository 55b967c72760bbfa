"""Message makers, made once: registering types takes a while."""

import pytest
from bag_writer import Maker


@pytest.fixture(scope="session")
def makers() -> dict[str, Maker]:
    """By the layout of vision_msgs; "1" makes messages of ROS 1."""
    return {vision: Maker(vision) for vision in "1234"}
