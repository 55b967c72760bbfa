"""Where in iSAM2's tree variables go, so that the next keyframe has little of it eliminated again.

An update eliminates again all cliques between the variables that it observes and the root.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from objslam.graph.variables import L0, X0


def elimination_groups(
    keyframes: list[int], coming: Iterable[int], shown: Iterable[int], known: Callable[[int], bool]
) -> dict[int, int]:
    """Keys that are to be eliminated last, the higher their number the later; those that are not known are left out.

    keyframes: the last three or fewer, the newest first, each tied to the next by a motion. coming: landmarks that may soon
    be observed. shown: those that the newest keyframe observes.

    The newest keyframe k and what it shows make the root, what is coming the clique below it. GTSAM makes a clique one with
    its parent where it is about all of the parent's variables, and what lies below these two is dense; so each has a pose
    that nothing below it is about: X(k) in the root, tied to X(k-1) alone, and X(k-1), tied to X(k-2), in what is coming.
    """
    groups = {X0 + k: 1 for k in keyframes}
    groups.update((L0 + j, 2) for j in coming)
    groups.update((L0 + j, 3) for j in shown)
    groups.update((X0 + k, 3) for k in keyframes[:2])
    groups = {key: group for key, group in groups.items() if known(key)}
    number = {group: i for i, group in enumerate(sorted(set(groups.values())), start=1)}
    # CCOLAMD wants them in a row, from 0 for all others, and less than there are variables
    return {key: number[group] for key, group in groups.items()} if len(number) < len(groups) else {}
