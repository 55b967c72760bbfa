"""Find all doubts about a result."""

from __future__ import annotations

from dataclasses import dataclass, replace

from objslam.core.result import DOUBT_KINDS, RunResult
from objslam.mapping.doubts.evidence import evidence_of
from objslam.mapping.doubts.groups import BoxGroups, find_groups
from objslam.mapping.doubts.pairs import Pairs, find_pairs
from objslam.mapping.doubts.splits import Splits, find_splits
from objslam.mapping.doubts.words import in_words


@dataclass(frozen=True)
class Doubts:
    """The doubts about a result: pairs of objects that may be one, objects that may be two, and groups of boxes that became
    no object."""

    pairs: Pairs
    splits: Splits
    groups: BoxGroups


def find_doubts(result: RunResult) -> Doubts:
    """Return the doubts about a result. The result and its rays stay as they are."""
    evidence = evidence_of(result)
    return Doubts(find_pairs(evidence), find_splits(evidence), find_groups(evidence, result.settings))


def with_doubts(result: RunResult) -> RunResult:
    """Return the result with its doubts in words, and their counts by kind in the summary."""
    found = find_doubts(result)
    doubts = in_words(result, found.pairs, found.splits, found.groups)
    counts: dict[str, int] = {kind: sum(one.kind == kind for one in doubts) for kind in DOUBT_KINDS}
    return replace(result, doubts=doubts, summary={**result.summary, "doubts": counts})
