"""The merge of a site as a tree: groups of sessions, pairs of groups, pairs of pairs.

The sessions are in the order of time. The key of a node is a hash of the keys below it. So when sessions are added at the
end, only the nodes on the way from them to the root are new. The other nodes are not merged again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from objslam import __version__
from objslam.fleet.keys import key_of

LEAF = 4
"""The most sessions of one group. A larger number makes fewer tasks, and each of them longer."""
MERGES = "merges"
"""The folder of the nodes in the store."""


@dataclass(frozen=True, slots=True)
class Node:
    """A node of the tree. sessions: the keys of all sessions below it, in order. below: the keys of its two parts, none for
    a group of sessions."""

    key: str
    sessions: tuple[str, ...]
    below: tuple[str, ...] = ()


def tree_of(sessions: Sequence[str]) -> list[list[Node]]:
    """Return the nodes of a site, level by level. The last level is the root alone. A node without a partner is also in the
    next level.

    sessions: the keys of the results, one at least, in the order of time.
    """
    groups = [tuple(sessions[at : at + LEAF]) for at in range(0, len(sessions), LEAF)]
    levels = [[Node(key_of("leaf", __version__, *group), group) for group in groups]]
    while len(levels[-1]) > 1:
        last = levels[-1]
        pairs = [last[at : at + 2] for at in range(0, len(last), 2)]
        levels.append([_pair(*pair) if len(pair) == 2 else pair[0] for pair in pairs])
    return levels


def node_name(key: str) -> str:
    """Return the name of a node in the store."""
    return f"{MERGES}/{key}.json"


def _pair(a: Node, b: Node) -> Node:
    return Node(key_of("pair", __version__, a.key, b.key), a.sessions + b.sessions, (a.key, b.key))
