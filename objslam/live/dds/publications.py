"""Keeps the publishers that the discovery of DDS found, up to a largest number."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any

from objslam.ros.messages.topic_types import is_tags

MOST = 1000
"""The most publishers that are kept. With a larger number, many made-up publishers slow down the choice of topics more."""
Kind = tuple[bool, bool]
"""The QoS of a publisher: whether it is reliable, and whether old messages are kept (transient-local)."""


@dataclass
class Publication:
    """A publisher. type_id: the id of its type, or None if it declares none. own: whether this session is the publisher."""

    topic: str
    type: str
    kind: Kind
    type_id: Any
    own: bool = False


class Publications:
    """The publishers by handle, at most `MOST`.

    Above this number, a publisher of the type with the most publishers is removed. So one type with very many publishers
    cannot remove all others. Within this type, the publisher whose topic has the longest name is removed, because
    `TopicChoice` prefers short names. All types of tags count as one type, because a program can invent more of them.
    """

    def __init__(self, kept: Callable[[], Collection[str]]) -> None:
        """kept: returns the topics whose publishers are never removed, such as topics that the user chose."""
        self._kept, self._found = kept, dict[int, Publication]()
        self._gone: dict[int, Kind] = {}  # The kinds of the publishers that left last. Their messages may still wait.
        self._count: Counter[str] = Counter()
        self._longest: dict[str, int] = {}  # The handle that is removed first, by group. It is searched when needed.

    def __len__(self) -> int:
        return len(self._found)

    def __iter__(self) -> Iterator[Publication]:
        return iter(list(self._found.values()))

    def kind(self, handle: int) -> Kind | None:
        """Return the kind of the publisher with a handle, even if the publisher has left recently. Return None if its kind
        is not kept."""
        return self._found[handle].kind if handle in self._found else self._gone.get(handle)

    def remove(self, handle: int) -> Publication | None:
        """Forget a publisher, and return it. Return None if it is not kept."""
        gone = self._found.pop(handle, None)
        if gone is not None:
            self._gone[handle] = gone.kind
            if len(self._gone) > MOST:
                del self._gone[next(iter(self._gone))]
            self._count[_group(gone)] -= 1
            if not self._count[_group(gone)]:
                del self._count[_group(gone)]
            self._longest.pop(_group(gone), None)
        return gone

    def add(self, handle: int, new: Publication) -> Publication | None:
        """Keep a publisher. Return the publisher that is removed, which may be the new one, or None if all are kept."""
        out = self.remove(handle)
        if out is None and len(self) >= MOST:
            worst = self._gives_way(new)
            if worst is None:
                return new
            out = self.remove(worst)
        else:
            out = None
        self._found[handle] = new
        self._count[_group(new)] += 1
        longest = self._longest.get(_group(new))
        if longest is not None and _rank(new) > _rank(self._found[longest]):
            del self._longest[_group(new)]
        return out

    def _gives_way(self, new: Publication) -> int | None:
        """Return the handle of the publisher that is removed for a new one, or None if no publisher may be removed."""
        kept = self._kept()
        chosen = new.topic in kept
        crowd, most = self._count.most_common(1)[0]
        other = chosen or self._count[_group(new)] + 1 < most
        group = crowd if other else _group(new)
        handle = self._longest.get(group)
        if handle is None or self._found[handle].topic in kept:
            mine = (h for h, p in self._found.items() if _group(p) == group and p.topic not in kept)
            handle = max(mine, key=lambda h: _rank(self._found[h]), default=None)
            if handle is None:
                return None
            self._longest[group] = handle
        return handle if other or _rank(new) < _rank(self._found[handle]) else None


def _group(publication: Publication) -> str:
    return "tags" if is_tags(publication.type) else publication.type


def _rank(publication: Publication) -> tuple[int, str]:
    return len(publication.topic), publication.topic
