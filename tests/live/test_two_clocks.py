"""A session whose odometry and localisation have two clocks says so at its end."""

import pytest
from driving import feed
from turning_drive import of_two_clocks

from objslam.config import load_settings
from objslam.live.session.session import Session


@pytest.mark.parametrize("offset", [0.0, 0.25])
def test_a_session_warns_of_two_clocks_only_if_there_are_two(offset: float) -> None:
    settings = load_settings(None, ("bodies.use=false", "checks.use=false"))
    result = feed(Session(settings, patient=True).start(), of_two_clocks(offset)).stop()
    said = [line for line in result.summary["warnings"] if "the odometry's stamps are" in line]
    assert len(said) == (offset > 0)
    assert all(line.startswith("the odometry's stamps are 0.25 s early") for line in said)
