"""Every factor that is to be in a growing graph, by its kind and number."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import gtsam

Factors = Sequence[gtsam.NonlinearFactor]


class Stored(NamedTuple):
    """The factors of one measurement, and the keys of the variables that they are about."""

    keys: frozenset[int]
    factors: Factors


def _no_factors() -> dict[str, dict[int, Stored]]:
    return {kind: {} for kind in ("motion", "absolute", "landmark", "ray")}


@dataclass
class FactorStore:
    """The factors by kind, then by number; kinds in the order in which a graph gets them.

    A `motion` has the number of the keyframe that it leads to, an `absolute` pose that of its keyframe, the prior of a
    `landmark` that of the landmark, a `ray` its own. Any other kind has numbers of its caller's choice.
    """

    kinds: dict[str, dict[int, Stored]] = field(default_factory=_no_factors)

    def add(self, kind: str, numbers: Sequence[int], groups: Sequence[Factors]) -> None:
        """Store the factors of some measurements, in place of those that have their numbers."""
        stored = self.kinds.setdefault(kind, {})
        for number, group in zip(numbers, groups, strict=True):
            keys = [key for factor in group for key in factor.keys()]  # noqa: SIM118 (no dict)
            stored[number] = Stored(frozenset(keys), group)

    def drop(self, kind: str, numbers: Iterable[int]) -> None:
        """Forget measurements of a kind."""
        for number in numbers:
            self.kinds[kind].pop(number, None)

    def drop_variables(self, keys: frozenset[int]) -> None:
        """Forget all measurements of some variables."""
        for kind, stored in self.kinds.items():
            self.kinds[kind] = {number: one for number, one in stored.items() if one.keys.isdisjoint(keys)}

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """All of them."""
        graph = gtsam.NonlinearFactorGraph()
        for stored in self.kinds.values():
            for one in stored.values():
                for factor in one.factors:
                    graph.push_back(factor)
        return graph

    def copy(self) -> FactorStore:
        """The same factors, in tables of their own."""
        return FactorStore({kind: dict(stored) for kind, stored in self.kinds.items()})
