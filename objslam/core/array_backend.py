"""The library, device and number of threads for a batch of array work."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from objslam.core.array_module import Backend
from objslam.errors import ConfigError


@contextmanager
def array_backend(device: str, large: bool) -> Iterator[Backend]:
    """Give the backend for the setting `triangulation.device`, and prepare its library.

    A batch that is not `large` runs in numpy, without an import of torch. The setting "auto" gives CUDA to a large batch if
    torch sees a CUDA device. The setting "cuda" gives CUDA to every batch, and raises ConfigError if torch sees no CUDA
    device.

    numpy, like torch, does not warn of divisions by zero. torch gets one thread, because a thread pool waits actively while
    other processes need the cores. On two cores, one of which was busy, a run took 4 s with one thread and up to 18 s with
    two.
    """
    if device != "cuda" and not large:
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            yield "numpy"
        return
    import torch

    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise ConfigError("torch sees no CUDA device", hint="set triangulation.device=auto")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield "cuda" if device != "cpu" and available else "cpu"
    finally:
        torch.set_num_threads(before)
