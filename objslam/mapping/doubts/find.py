"""Find all doubts about a result."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from objslam.core.result import DOUBT_KINDS, RunResult
from objslam.mapping.doubts.evidence import evidence_of
from objslam.mapping.doubts.groups import BoxGroups, find_groups
from objslam.mapping.doubts.pairs import Pairs, find_pairs
from objslam.mapping.doubts.splits import Splits, find_splits
from objslam.mapping.doubts.words import in_words

_DOUBLE = 0.5
"""The probability from which a pair that may be one counts in the assessment. With a larger value, more maps are good."""


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
    """Return the result with its doubts in words, and their counts by kind in the summary. A map with objects that are more
    likely doubles than not is not called good."""
    found = find_doubts(result)
    doubts = in_words(result, found.pairs, found.splits, found.groups)
    counts: dict[str, int] = {kind: sum(one.kind == kind for one in doubts) for kind in DOUBT_KINDS}
    summary = {**result.summary, "doubts": counts}
    doubles = int((found.pairs.probability >= _DOUBLE).sum())
    if doubles and "assessment" in summary:
        summary["assessment"] = _assessed(summary["assessment"], doubles)
    return replace(result, doubts=doubts, summary=summary)


def _assessed(assessment: dict[str, Any], doubles: int) -> dict[str, Any]:
    """Return the assessment of a map that may have doubles."""
    if assessment["level"] == "bad":
        return assessment
    reason = f"{doubles} objects may be doubles of neighbours: `objslam explain` names them."
    if doubles == 1:
        reason = "1 object may be a double of a neighbour: `objslam explain` names it."
    others = assessment["reasons"][assessment["level"] == "good" :]  # The first reason of a good map praises it.
    return {**assessment, "level": "check", "reasons": [reason, *others]}
