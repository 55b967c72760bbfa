"""How many threads torch may use."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """One thread for torch: our batches are small or cut to fit the cache, and a pool spins beside other busy processes.

    On a machine of two cores with one of them busy, a run that one thread does in 4 s took two threads up to 18 s.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
