"""Store every factor of a growing graph by its kind and number."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import gtsam

from objslam.graph.optimizers import build_graph

Factors = Sequence[gtsam.NonlinearFactor]


_OWN_KINDS = ("motion", "absolute", "landmark", "ray")
"""The kinds of factors that every growing graph has. Their variables are poses X and points L only."""


class Stored(NamedTuple):
    """The factors of one measurement, and the keys of their variables."""

    keys: frozenset[int]
    factors: Factors


@dataclass
class FactorStore:
    """The factors by kind, then by number. A graph gets the kinds in the order of `kinds`.

    The number of a `motion` is the number of the keyframe at its end. An `absolute` pose has the number of its keyframe, and
    a `landmark` prior has the number of its landmark. A `ray` has its own number. The caller numbers other kinds.
    """

    kinds: dict[str, dict[int, Stored]] = field(default_factory=lambda: {kind: {} for kind in _OWN_KINDS})

    def add(self, kind: str, numbers: Sequence[int], groups: Sequence[Factors]) -> None:
        """Store one group of factors for each number. A group replaces the stored factors of its kind and number."""
        stored = self.kinds.setdefault(kind, {})
        for number, group in zip(numbers, groups, strict=True):
            stored[number] = Stored(frozenset(key for factor in group for key in factor.keys()), group)  # noqa: SIM118 (no dict)

    def drop(self, kind: str, numbers: Iterable[int]) -> None:
        """Remove the factors of a kind that have these numbers."""
        for number in numbers:
            self.kinds[kind].pop(number, None)

    def drop_variables(self, keys: frozenset[int]) -> None:
        """Remove the factors of every measurement that involves one of these variables."""
        for kind, stored in self.kinds.items():
            self.kinds[kind] = {number: one for number, one in stored.items() if one.keys.isdisjoint(keys)}

    def variables(self) -> set[int]:
        """Return the keys of the variables in the factors of all kinds that the caller numbers."""
        numbered = (stored for kind, stored in self.kinds.items() if kind not in _OWN_KINDS)
        return {key for stored in numbered for one in stored.values() for key in one.keys}

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Return a graph with all factors."""
        return build_graph(*(one.factors for stored in self.kinds.values() for one in stored.values()))

    def copy(self) -> FactorStore:
        """Return a copy with tables of its own. The factors themselves are shared."""
        return FactorStore({kind: dict(stored) for kind, stored in self.kinds.items()})
