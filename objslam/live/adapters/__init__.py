"""Adapters, a file each: what brings messages to a session. run(stop) returns when stop is set, or all has been read.

`ADAPTERS` is the table of them for `objslam live SOURCE`: a new one is one more file, one more row here, and a function that
makes it. What is not in the table is a recording, which is replayed.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from objslam.ledger import Ledger
from objslam.live.interface import Sink, Snapshot

if TYPE_CHECKING:
    from objslam.config import Settings


class Adapter(Protocol):
    """What brings messages."""

    @property
    def ledger(self) -> Ledger:
        """What was dropped before it could be pushed, and warnings."""
        ...

    def run(self, stop: threading.Event) -> None:
        """Push messages until stop is set, or there are no more."""
        ...


@dataclass(frozen=True)
class LiveOptions:
    """What the command line says. more: options of single adapters, by name."""

    settings: Settings
    detector: Path | None = None
    more: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Feed:
    """An adapter, what else wants to see the snapshots, and what to close in the end."""

    adapter: Adapter
    views: tuple[Callable[[Snapshot], None], ...] = ()
    close: tuple[Callable[[], None], ...] = ()


def _stdin(sink: Sink, options: LiveOptions) -> Feed:
    import sys

    from objslam.live.adapters.stdin import StdinAdapter

    return Feed(StdinAdapter(sink, sys.stdin.buffer))


ADAPTERS: dict[str, Callable[[Sink, LiveOptions], Feed]] = {
    "stdin": _stdin,
}
"""What makes the adapter that a name of `objslam live` stands for."""
