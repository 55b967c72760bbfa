"""The number of threads and the device that torch uses."""

from collections.abc import Iterator
from contextlib import contextmanager

from objslam.errors import ConfigError


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Restrict torch to one thread, because a thread pool waits actively while other processes need the cores.

    On two cores, one of which was busy, a run took 4 s with one thread and up to 18 s with two. One thread is enough,
    because the batches are small.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def torch_device(device: str, worth: bool = True) -> str:
    """Return "cpu" or "cuda" for the setting `triangulation.device`.

    The setting "auto" gives CUDA if torch sees a CUDA device and `worth` says that the work is large enough for it. The
    setting "cuda" raises ConfigError if torch sees no CUDA device.
    """
    import torch

    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise ConfigError("torch sees no CUDA device", hint="set triangulation.device=auto")
    return ("cuda" if available and worth else "cpu") if device == "auto" else device
