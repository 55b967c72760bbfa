"""Appearance vectors: they are scaled once, compared by their cosine, and what cannot be compared is told apart."""

import numpy as np
import pytest

from objslam.core.appearance.features import are_unit_vectors, ranked, unit_vectors


def test_vectors_of_any_length_become_unit_vectors() -> None:
    given = np.array([[3.0, 4.0], [1e200, 0.0], [-1e-200, 0.0], [0.0, 0.0], [np.nan, 1.0], [np.inf, 1.0]])
    units, good = unit_vectors(given)
    assert good.tolist() == [True, True, True, False, False, False]
    assert units.dtype == np.float32
    np.testing.assert_allclose(units[:3], [[0.6, 0.8], [1.0, 0.0], [-1.0, 0.0]], atol=1e-7)
    assert np.isnan(units[3:]).all()
    assert are_unit_vectors(units)
    assert not are_unit_vectors(2 * units)


def test_a_unit_vector_stays_bit_by_bit() -> None:
    units, _ = unit_vectors(np.random.default_rng(0).normal(size=(200, 96)))
    np.testing.assert_array_equal(unit_vectors(units)[0], units)


def test_the_ranking_is_that_of_the_angles() -> None:
    angles = np.radians([90.0, 10.0, 180.0, 30.0])
    vectors = np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32)
    found = ranked(vectors, [5.0, 0.0], 3)
    assert [i for i, _ in found] == [1, 3, 0]
    np.testing.assert_allclose([cosine for _, cosine in found], np.cos(np.radians([10.0, 30.0, 90.0])), atol=1e-6)


@pytest.mark.parametrize("query", [[1.0], [[1.0, 0.0]], [0.0, 0.0], [np.nan, 1.0], []])
def test_a_query_that_cannot_be_compared_is_refused(query: list[float]) -> None:
    with pytest.raises(ValueError, match="the vector"):
        ranked(np.eye(2, dtype=np.float32), query, 1)
