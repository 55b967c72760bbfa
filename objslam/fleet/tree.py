"""The tree in which the sessions of a site are merged. Its nodes are groups of sessions, then pairs of groups, then pairs of
such pairs.

The sessions are in the order of time. The key of a node is a hash of the keys below it. If sessions are added at the end,
only the nodes between the added sessions and the root get new keys. All other nodes are not merged again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from objslam import __version__
from objslam.fleet.keys import key_of

LEAF = 4
"""The largest number of sessions in one group. With a larger number, there are fewer tasks, and each task takes longer."""
MERGES = "merges"
"""The name of the folder of the nodes in the store."""


@dataclass(frozen=True, slots=True)
class Node:
    """A node of the tree. sessions: the keys of all sessions below the node, in the order of time. below: the keys of the
    two nodes that it joins, empty for a group of sessions."""

    key: str
    sessions: tuple[str, ...]
    below: tuple[str, ...] = ()


def tree_of(sessions: Sequence[str]) -> list[list[Node]]:
    """Return the nodes of a site, level by level. The first level has the groups. The last level has only the root. A node
    without a partner is also in the next level.

    sessions: the keys of at least one result, in the order of time.
    """
    groups = [tuple(sessions[at : at + LEAF]) for at in range(0, len(sessions), LEAF)]
    levels = [[Node(key_of("leaf", __version__, *group), group) for group in groups]]
    while len(levels[-1]) > 1:
        last = levels[-1]
        pairs = [last[at : at + 2] for at in range(0, len(last), 2)]
        levels.append([_pair(*pair) if len(pair) == 2 else pair[0] for pair in pairs])
    return levels


def node_name(key: str) -> str:
    """Return the name of a node's file in the store. key: the key of the node."""
    return f"{MERGES}/{key}.json"


def _pair(a: Node, b: Node) -> Node:
    return Node(key_of("pair", __version__, a.key, b.key), a.sessions + b.sessions, (a.key, b.key))
