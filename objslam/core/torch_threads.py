"""How many threads torch may use, and on which device it works."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from objslam.errors import ConfigError


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


def torch_device(device: str, worth: bool = True) -> str:
    """ "cpu" or "cuda", as the setting `triangulation.device` says; "auto" takes CUDA where it is there and worth it.

    Raises:
        ConfigError: when CUDA is asked for and is not there.
    """
    import torch

    there = torch.cuda.is_available()
    if device == "cuda" and not there:
        raise ConfigError("torch sees no CUDA device", hint="set triangulation.device=auto")
    return ("cuda" if there and worth else "cpu") if device == "auto" else device
