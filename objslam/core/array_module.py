"""Functions that work on numpy arrays and on torch tensors, and the choice between the two libraries.

Code for both libraries gets the library of an array from `module_of`. It calls functions of the library with `axis=` and
positional arguments, which both libraries accept. torch is imported only if it may be used.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from types import ModuleType
from typing import Any, Literal

import numpy as np

from objslam.core.arrays import Array
from objslam.errors import ConfigError

Tensor = Any
"""A numpy array or a torch tensor."""

Backend = Literal["numpy", "cpu", "cuda"]
"""What computes a batch: numpy, torch on the CPU ("cpu"), or torch on a CUDA device ("cuda")."""


def chosen_backend(device: str, large: bool) -> Backend:
    """Choose numpy or torch on CUDA for a batch. device: the setting `triangulation.device`.

    With "auto", a `large` batch runs on CUDA if torch sees a CUDA device. All other batches, and all batches with "cpu", run
    in numpy. torch on a CPU is never chosen. For 50,000 to 1,000,000 rays, it took 1.2 to 2.6 times the CPU time of numpy.
    Only tests use it, to run the code for CUDA.

    Raises:
        ConfigError: the setting is "cuda", and torch is not installed or sees no CUDA device.
    """
    if device == "cpu" or (device == "auto" and not large):
        return "numpy"  # This is for most batches. Some batches take no longer than the search for torch.
    installed = find_spec("torch") is not None
    if device == "cuda" and not installed:
        raise ConfigError("triangulation.device=cuda needs torch", hint='pip install "objslam[torch]"')
    if not installed or (device == "auto" and not _has_driver()):
        return "numpy"
    import torch

    if torch.cuda.is_available():
        return "cuda"
    if device == "cuda":
        raise ConfigError("torch sees no CUDA device", hint="set triangulation.device=auto")
    return "numpy"


def _has_driver() -> bool:
    """Return whether the driver of CUDA can be loaded. Without the driver, the import of torch (1.4 s) is left out."""
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


@contextmanager
def array_backend(device: str, large: bool) -> Iterator[Backend]:
    """Prepare the library that `chosen_backend` chooses for a batch.

    The warnings of numpy about divisions by zero, overflows and invalid values are off, because torch has no such warnings.
    torch gets one thread, because the threads of a pool use their cores even while they wait. With one of two cores busy, a
    run took 4 s with one thread and up to 18 s with two.
    """
    chosen = chosen_backend(device, large)
    if chosen == "numpy":
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            yield chosen
        return
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield chosen
    finally:
        torch.set_num_threads(before)


def module_of(array: Tensor) -> ModuleType:
    """Return the library of an array: numpy or torch."""
    return np if isinstance(array, np.ndarray | np.generic) else sys.modules["torch"]


def backend_of(array: Tensor) -> Backend:
    """Return the backend of an array."""
    return "numpy" if isinstance(array, np.ndarray) else array.device.type


def as_tensor(array: Array, backend: Backend) -> Tensor:
    """Return a numpy array as an array of the backend."""
    if backend == "numpy":
        return array
    import torch

    return torch.from_numpy(np.ascontiguousarray(array)).to(backend)


def as_numpy(array: Tensor) -> Array:
    """Return an array as a numpy array on the CPU, which may share the memory of the array."""
    return array if isinstance(array, np.ndarray) else np.asarray(array.cpu().numpy())


def as_type(array: Tensor, like: Any) -> Tensor:
    """Return an array with the element type of the array `like`."""
    return array.astype(like.dtype) if isinstance(array, np.ndarray) else array.to(like.dtype)


def as_single(array: Tensor) -> Tensor:
    """Return an array in single precision."""
    return array.astype(np.float32) if isinstance(array, np.ndarray) else array.float()


def indices_of(mask: Tensor) -> Tensor:
    """Return the indices at which a mask (N,) is true."""
    return mask.nonzero()[0] if isinstance(mask, np.ndarray) else mask.nonzero()[:, 0]


def sorted_last(array: Tensor) -> Tensor:
    """Return an array sorted along its last axis."""
    return np.sort(array) if isinstance(array, np.ndarray) else array.sort(dim=-1).values


def take_along(array: Tensor, index: Tensor, axis: int) -> Tensor:
    """Return the elements of an array at indices along one axis, as numpy.take_along_axis does."""
    if isinstance(array, np.ndarray):
        return np.take_along_axis(array, index, axis)
    return module_of(array).take_along_dim(array, index, axis)


def contiguous(array: Tensor) -> Tensor:
    """Return an array whose elements are contiguous in memory, in the order of its axes. The array is copied only if
    needed."""
    return np.ascontiguousarray(array) if isinstance(array, np.ndarray) else array.contiguous()


def rows(array: Tensor, index: Tensor) -> Tensor:
    """Return the rows of an array (R, C) at indices (...), as (..., C)."""
    return array.take(index, axis=0) if isinstance(array, np.ndarray) else array[index]  # numpy's take is twice as fast.


def group_sum(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Return the sum (N,) or (N, C) of the values (R,) or (R, C) of each group.

    index: (R,) the group of each value. count: the number of groups, N.
    """
    if not isinstance(values, np.ndarray):
        return values.new_zeros((count, *values.shape[1:])).index_add_(0, index, values)
    if values.ndim == 1:
        return np.bincount(index, values, count)
    return np.stack([np.bincount(index, column, count) for column in values.T], axis=1)


def length(vectors: Tensor, axis: int = -1) -> Tensor:
    """Return the Euclidean norms of vectors along one axis."""
    return (vectors * vectors).sum(axis=axis) ** 0.5
