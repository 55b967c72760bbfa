"""Appearance vectors of boxes, such as the embeddings of a network. They are unit vectors, compared by their cosine."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from objslam.core.arrays import Array, Bools, Floats32

MAX_FEATURES = 8192
"""The most numbers in an appearance vector. A larger bound accepts more wrong input, and needs more memory. The vectors of
common image encoders have at most half of this number."""
_COMPACT = 64
"""The length to which long vectors are shortened in association. A larger number keeps finer differences, and is slower."""
_SAMPLE = 20_000
"""The most vectors from which the directions of the shortened vectors are found. A larger number takes longer."""
_ROUNDING = 1e-6
"""The largest difference from 1 in the length of a vector that stays unchanged, bit by bit. A larger value leaves more
vectors inexact. The length of a unit vector that was rounded to 32 bits differs from 1 by a tenth of this."""
_UNIT = 1e-3  # How far the length of a stored vector may be from 1. A larger value accepts worse vectors.


@dataclass(frozen=True)
class FeatureTable:
    """The appearance vectors of the boxes of a log. vectors: (V, D), each of length 1. Rays store the index of their vector,
    so a selection of rays copies no vectors."""

    vectors: Floats32

    @cached_property
    def compact(self) -> Floats32:
        """(V, d) unit vectors with at most `_COMPACT` numbers, with nearly the same cosines as the vectors.

        These are the coordinates along the strongest directions (the largest eigenvalues of the second moments). Comparing
        them takes less time and memory.
        """
        if self.vectors.shape[1] <= _COMPACT:
            return self.vectors
        some = self.vectors[:: -(-len(self.vectors) // _SAMPLE)]
        _, directions = np.linalg.eigh(some.T @ some)
        units, _ = unit_vectors(self.vectors @ directions[:, -_COMPACT:])
        return np.nan_to_num(units)


def unit_vectors(values: Array) -> tuple[Floats32, Bools]:
    """Return vectors (M, D) scaled to length 1, and which of the vectors (M,) can be scaled.

    A vector that is zero, or has a number that is not finite, cannot be scaled. Its row is NaN.
    """
    given = np.asarray(values, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        largest = np.abs(given).max(axis=1, initial=0.0)
    good = np.asarray(np.isfinite(largest) & (largest > 0))
    largest = np.where(good, largest, np.nan)
    scaled = given / largest[:, None]  # The square of a large number would be infinite.
    length = np.linalg.norm(scaled, axis=1)
    exact = np.abs(length * largest - 1) <= _ROUNDING
    scaled = np.where(exact[:, None], given, scaled / length[:, None])
    return scaled.astype(np.float32), good


def are_unit_vectors(features: Floats32) -> bool:
    """Return whether each row (M, D) is a unit vector, or NaN in all numbers."""
    known = features[~np.isnan(features).all(axis=1)]
    return bool((np.abs(np.linalg.norm(known, axis=1) - 1) < _UNIT).all())


def short_numbers(vector: Floats32) -> list[float] | None:
    """Return a vector (D,) as the shortest decimal numbers that are read back as the same floats. None for a vector of
    NaN."""
    return None if np.isnan(vector[0]) else [float(text) for text in vector.astype(str)]


def vector_of_entry(entry: Mapping[str, Any]) -> Floats32 | None:
    """Return the unit vector (D,) under the key `features` of a JSON object, None without this key. ValueError if the value
    is no unit vector."""
    value = entry.get("features")
    if value is None:
        return None
    numbers = isinstance(value, list) and all(type(x) in (int, float) and abs(x) < 2 for x in value)
    if not numbers or not 0 < len(value) <= MAX_FEATURES or abs(np.linalg.norm(value) - 1) >= _UNIT:
        raise ValueError(f"features must be a list of at most {MAX_FEATURES} numbers whose squares add up to 1")
    return np.array(value, dtype=np.float32)


def ranked(vectors: Sequence[Floats32], query: ArrayLike, count: int) -> list[tuple[int, float]]:
    """Return the indices of the vectors (D,) with the largest cosines to a vector, and these cosines, the largest first.

    A vector with another number of elements than the query is left out. count: the most vectors to return. ValueError if the
    query is no vector or cannot be scaled, or if all vectors are left out.
    """
    given = np.asarray(query, dtype=np.float64)
    if given.ndim != 1 or not len(given):
        raise ValueError(f"the vector must be (D,) numbers, got the shape {given.shape}")
    (unit,), (good,) = unit_vectors(given[None])
    if not good:
        raise ValueError("the vector is zero or not finite")
    alike = [i for i, vector in enumerate(vectors) if len(vector) == len(given)]
    if len(vectors) and not alike:
        raise ValueError(f"the vector has {len(given)} numbers, but the vectors of the objects have {len(vectors[0])}")
    cosine = np.array([vectors[i] for i in alike], dtype=np.float64).reshape(-1, len(given)) @ unit.astype(np.float64)
    return [(alike[i], float(cosine[i])) for i in np.argsort(-cosine, kind="stable")[: max(count, 0)].tolist()]
