"""The last values of a slow function."""

from objslam.frontend.recent_values import RecentValues


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
