"""When a log is explored a second time: if its odometry is not what the first exploration took it for."""

from types import SimpleNamespace

import numpy as np
import pytest

from objslam.config import Settings
from objslam.core.calibration import Calibration
from objslam.core.noise import NoiseFactors
from objslam.core.types import Association
from objslam.mapping.exploration.second_exploration import finds_same_objects, with_loose_odometry

NAMES = ("odometry.scale", "odometry.turn_scale", "front.clock", "surface")


class Errors(SimpleNamespace):
    """Shared errors whose noise is open, and which were expected to be 0."""

    def at(self, values):
        return SimpleNamespace(values=values), "rays", "settings"

    def with_noise(self, noise):
        return Errors(**{**vars(self), "noise": noise})


def state(turn: float, *, agree: float = 0.88, clock: float = 0.0, surface: float = 0.0, noise: NoiseFactors | None = None):
    values = np.array([0.0, turn, clock, surface])
    found = Calibration(NAMES, values, np.diag([0.03, 0.007, 0.004, 0.1]) ** 2, np.array([0.03, 0.05, 0.1, 0.5]))
    errors = Errors(noise=noise or NoiseFactors(), unknown_noise=("odometry",), mean=np.zeros(4), names=NAMES)
    weights = np.arange(100) < 100 * agree
    estimate = SimpleNamespace(calibration=found)
    return SimpleNamespace(
        errors=errors,
        theta=values,
        estimate=estimate,
        agree=weights,
        attempt=lambda: Attempt(theta=None),
        settings=Settings(),
    )


class Attempt(SimpleNamespace):
    """Takes what `dataclasses.replace` would change."""

    def __replace__(self, **changes):
        return Attempt(**{**vars(self), **changes})


@pytest.fixture(autouse=True)
def replace_any(monkeypatch):
    from dataclasses import is_dataclass
    from dataclasses import replace as of_dataclass

    from objslam.mapping.exploration import second_exploration

    def replace(one, **changes):
        return of_dataclass(one, **changes) if is_dataclass(one) else one.__replace__(**changes)

    monkeypatch.setattr(second_exploration, "replace", replace)


@pytest.mark.parametrize(
    ("given", "again"),
    [
        ({"turn": -0.05}, True),
        ({"turn": -0.01}, False),
        ({"turn": -0.05, "agree": 0.97}, False),
        ({"turn": 0.0, "clock": 0.3}, False),
        ({"turn": 0.0, "agree": 0.97, "surface": 0.2}, False),
        ({"turn": 0.0, "agree": 0.97, "surface": -0.5}, True),
    ],
)
def test_a_robot_that_turns_less_than_its_odometry_says_is_explored_again(given, again):
    attempt = with_loose_odometry(state(**given), None)
    assert (attempt is not None) == again
    if attempt is not None:
        assert attempt.theta[1] == given["turn"]


def test_only_the_surfaces_are_taken_from_a_map_that_explains_nearly_all_rays():
    attempt = with_loose_odometry(state(turn=-0.05, agree=0.97, surface=-0.5, noise=NoiseFactors(turning=9.0)), None)
    assert attempt is not None
    np.testing.assert_array_equal(attempt.theta, [0.0, 0.0, 0.0, -0.5])
    assert attempt.errors.noise.turning == 1.0


def test_turns_that_the_exploration_began_with_are_no_reason_to_explore_again():
    assert with_loose_odometry(state(turn=-0.05), np.array([0.0, -0.045, 0.0, 0.0])) is None
    assert with_loose_odometry(state(turn=-0.05), np.array([0.0, 0.02, 0.0, 0.0])) is not None


@pytest.mark.parametrize(("turning", "sure", "again"), [(2.0, True, True), (2.0, False, False), (1.2, True, False)])
def test_noise_of_the_odometry_is_reason_enough_for_the_filter(turning, sure, again):
    """A map that shows objects twice can explain nearly all rays. Another exploration by the filter takes little time."""
    attempt = with_loose_odometry(state(turn=0.0, agree=0.97, noise=NoiseFactors(turning=turning)), None, sure)
    assert (attempt is not None) == again
    if attempt is not None:
        assert attempt.errors.noise.turning == turning


def test_a_log_is_not_explored_with_less_noise_than_the_settings_say():
    """The noise that a solve finds is that of a path which is solved together with its turns, perhaps to a wrong map."""
    quiet = NoiseFactors(rays=0.66, along=0.7, across=2.0, turning=0.5, shrinkage=0.02)
    attempt = with_loose_odometry(state(turn=-0.05, noise=quiet), None)
    assert attempt.errors.noise == NoiseFactors(across=2.0)


@pytest.mark.parametrize(
    ("other", "same"),
    [
        ([1] * 500 + [0] * 500, True),  # The objects have other numbers.
        ([0] * 500 + [1] * 500 + [2] * 30, True),  # A further object of rays that the map leaves without one.
        ([-1] * 100 + [0] * 400 + [1] * 500, True),
        ([0] * 505 + [1] * 495, True),
        ([0] * 450 + [2] * 50 + [1] * 500, False),  # An object twice.
        ([0] * 1000, False),  # Both objects in one.
        ([0] * 450 + [1] * 550, False),
    ],
)
def test_an_exploration_that_finds_the_objects_of_the_map_is_not_solved(other, same):
    """The map has two objects of 500 rays, and 30 rays of none."""
    rays = np.full(1030, -1)
    rays[:500], rays[500:1000] = 0, 1
    found = np.full(1030, -1)
    found[: len(other)] = other
    of_map, start = (Association(one, np.zeros(3, dtype=np.int64)) for one in (rays, found))
    assert finds_same_objects(SimpleNamespace(association=of_map), start) == same
