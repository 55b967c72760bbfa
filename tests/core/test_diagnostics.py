from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from objslam.core.diagnostics import Ledger

PLACES = tuple(f"a:{line}" for line in range(20))
drops = st.lists(
    st.tuples(st.sampled_from(["no pose", "bad box", "low score"]), st.integers(-2, 50), st.none() | st.sampled_from(PLACES))
)


@given(drops)
def test_drops_are_summed_by_reason_with_the_first_places(entries):
    ledger, expected = Ledger(), Counter()
    for reason, count, where in entries:
        ledger.drop(reason, count, where)
        expected[reason] += max(count, 0)
    assert ledger.dropped == {reason: count for reason, count in expected.items() if count}
    for reason, places in ledger.examples.items():
        told = [w for r, c, w in entries if r == reason and c > 0 and w is not None]
        assert places == list(dict.fromkeys(told))[:3]  # each once
    lines = ledger.lines()
    assert len(lines) == len(ledger.dropped)
    for line, (reason, count) in zip(lines, ledger.dropped.items(), strict=True):
        assert line.startswith(f"dropped {count}: {reason}")
        assert all(place in line for place in ledger.examples[reason])


def test_warnings_are_kept_once_and_come_after_the_drops():
    ledger = Ledger()
    for text in ("the clock jumps", "no odometry", "the clock jumps"):
        ledger.warn(text)
    ledger.drop("no pose", where="12.5")
    assert ledger.lines() == ["dropped 1: no pose (first: 12.5)", "the clock jumps", "no odometry"]


def test_ledgers_share_nothing():
    Ledger().drop("no pose")
    assert Ledger().lines() == []


def test_what_another_counted_is_taken_over() -> None:
    ledger, other = Ledger(), Ledger()
    ledger.drop("late", 2, "stamp 1")
    ledger.warn("slow")
    other.drop("late", 3, "stamp 2")
    other.drop("torn")
    other.warn("slow")
    other.warn("hot")
    ledger.add(other)
    assert ledger.dropped == {"late": 5, "torn": 1}
    assert ledger.examples == {"late": ["stamp 1", "stamp 2"], "torn": []}
    assert ledger.warnings == ["slow", "hot"]
