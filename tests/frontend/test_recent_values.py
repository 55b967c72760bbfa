"""The last values of a slow function."""

import gc

import pytest
from quick import NOTHING_DRAWN

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.frontend import known_errors
from objslam.frontend.odometry_bridge import bridge_of
from objslam.frontend.recent_values import RecentValues, ValuesOfObjects
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate


def test_a_value_is_computed_once_while_it_is_kept():
    kept: RecentValues[str] = RecentValues(2)
    computed = []

    def ask(number: float) -> str:
        def compute() -> str:
            computed.append(number)
            return f"value of {number}"

        return kept.get((number,), compute)

    assert [ask(1.0), ask(2.0), ask(1.0)] == ["value of 1.0", "value of 2.0", "value of 1.0"]
    assert computed == [1.0, 2.0]
    ask(3.0)  # in place of 2, which was asked for longest ago
    ask(1.0)
    assert computed == [1.0, 2.0, 3.0]
    ask(2.0)
    assert computed == [1.0, 2.0, 3.0, 2.0]


def test_the_value_of_an_object_is_computed_once_and_goes_with_the_object():
    class Path:
        def __init__(self, length):
            self.length = length

    computed = []
    length_of = ValuesOfObjects(lambda path: computed.append(path.length) or path.length)
    one, other = Path(1), Path(2)
    assert [length_of(path) for path in (one, other, one, other)] == [1, 2, 1, 2]
    assert computed == [1, 2]
    del one
    gc.collect()
    assert list(length_of._values.values()) == [2]


@pytest.mark.parametrize("function", [bridge_of, known_errors._in_plane])
def test_a_run_looks_at_a_whole_odometry_once(monkeypatch, function):
    """How it bends between its poses, and whether it lies in a plane."""
    log = simulate(preset("demo", frames=60, objects=4, classes=4, localization=None), 0)
    measured, compute = [], function._compute
    monkeypatch.setattr(function, "_compute", lambda path: measured.append(path) or compute(path))
    assert pipeline.run(log, load_settings(None, (*NOTHING_DRAWN, "mode=joint")), Ledger()).map.resolved()
    assert [path is log.odometry for path in measured] == [True]
