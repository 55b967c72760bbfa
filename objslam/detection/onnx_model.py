"""Load and run a network. A network is an ONNX model in an onnxruntime session, with its inputs, outputs and metadata.

A file of some kB can describe tensors of any size. Therefore, the size of the images, the size of the outputs and the memory
of a run are limited.
"""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from objslam import config
from objslam.core.arrays import Array
from objslam.errors import ConfigError, DetectorError, first_line

_KINDS: dict[str, type[np.generic]] = {
    "float": np.float32,
    "float16": np.float16,
    "double": np.float64,
    "uint8": np.uint8,
    "int32": np.int32,
    "int64": np.int64,
    "bool": np.bool_,
}
_PIXELS = ("float", "float16", "double", "uint8")
_MASK, _SIZES = "pixel_mask", "orig_target_sizes"
_FED = {_MASK: 3, _SIZES: 2}  # The inputs that exported DETR models need besides the image, with their numbers of axes.
_NOT_A_MODEL = "INVALID_PROTOBUF"  # The error code of onnxruntime for a file that is no ONNX model.
_CUDA, _CPU = "CUDAExecutionProvider", "CPUExecutionProvider"
_GIB = 1 << 30  # The number of bytes in 1 GiB.
_MOST_MEMORY = 8 * _GIB
"""The limit (bytes) of the main memory that all models of a process take together. On a computer with less than 16 GiB, the
limit is half of its memory. A larger value allows larger models, but a damaged model can then take the memory from all other
programs. YOLO12n with images of 640 px takes 0.1 GiB."""
_MOST_PIXELS = 1 << 26
"""The largest number of pixels of all images that a model takes at once: height times width times number of images. A value
that the model does not fix counts as 1. The limit is that of one image of 8192x8192. With a larger limit, more memory is
taken before the model runs."""
_MOST_VALUES = 1 << 28
"""The largest number of values in an output. A larger number takes more memory. A float64 copy of an output of this size
takes 2 GiB. The output of YOLO with 80 classes for an image of 8192x8192 is less than half as large."""


@dataclass(frozen=True)
class Tensor:
    """The declaration of an input or output. shape: the size of each axis, None for a free size. kind: the type of the
    values, such as "float" or "uint8"."""

    name: str
    shape: tuple[int | None, ...]
    kind: str

    def __str__(self) -> str:
        return f"{self.name} [{', '.join('?' if n is None else str(n) for n in self.shape)}] {self.kind}"


@dataclass(frozen=True)
class ImageInput:
    """The layout of the image input. If `channels_last` is True, an image is (H, W, 3), else (3, H, W). A batch, height or
    width of None is free. A batch of 0 means that the input has no batch axis."""

    tensor: Tensor
    batch: int | None
    height: int | None
    width: int | None
    channels_last: bool


@dataclass(frozen=True)
class Network:
    """An ONNX model in an onnxruntime session. digest: the SHA-256 of the model. extras: the inputs besides the image."""

    path: Path
    session: Any
    digest: str
    metadata: Mapping[str, str]
    image: ImageInput
    extras: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]

    def run(self, blob: Array) -> list[Array]:
        """Run the model on images (B, 3, H, W). Return the arrays of `outputs`. Raises DetectorError if the run fails."""
        count, _, height, width = blob.shape
        array = blob.transpose(0, 2, 3, 1) if self.image.channels_last else blob
        if self.image.batch == 0:
            array = array[0]
        feed = {self.image.tensor.name: np.ascontiguousarray(array, dtype=_KINDS[self.image.tensor.kind])}
        for extra in self.extras:
            feed[extra.name] = _extra(extra, count, height, width)
        try:
            outputs = [np.asarray(output) for output in self.session.run(None, feed)]
        except Exception as error:
            if _is_refused_memory(error):
                raise DetectorError(
                    f"on images of {width}x{height}, the model needs more than {_memory() / _GIB:.1f} GiB of memory",
                    where=str(self.path),
                    hint="if the model is not damaged, set a smaller detector.size or detector.batch=1",
                ) from error
            message = f"onnxruntime cannot run the model on images of {width}x{height}: {first_line(error)}"
            raise DetectorError(message, where=str(self.path)) from error
        for tensor, output in zip(self.outputs, outputs, strict=True):
            if output.size > _MOST_VALUES:
                message = f"the output {tensor.name} has {output.size} values, objslam takes at most {_MOST_VALUES}"
                raise DetectorError(message, where=str(self.path))
        return outputs


def open_network(path: Path, settings: config.Detector) -> Network:
    """Load an ONNX model. The settings give the device and the number of threads. Raises DetectorError if the file is
    missing or is no ONNX model, if the model needs inputs that an image does not give, or if it takes too large images.
    Raises ConfigError if the device is cuda, but CUDA cannot be used."""
    import onnxruntime

    try:
        digest = _digest(path)
    except OSError as error:
        raise DetectorError(f"the model cannot be read: {error.strerror or error}", where=str(path)) from error
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # errors are raised, so onnxruntime need not print them
    options.intra_op_num_threads = settings.threads
    # Spinning threads would take the cores from the threads that decode the images.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if _limit_memory():
        options.add_session_config_entry("session.use_env_allocators", "1")
    providers = _providers(onnxruntime, settings.device)
    try:
        # Without CUDA, the fallback of onnxruntime would only load the same file again, and print a message.
        session = onnxruntime.InferenceSession(str(path), options, providers=providers, enable_fallback=_CUDA in providers)
    except Exception as error:
        why = "" if _NOT_A_MODEL in str(error) else f": {first_line(error)}"
        raise DetectorError(f"not an ONNX model that onnxruntime loads{why}", where=str(path)) from error
    if settings.device == "cuda" and _CUDA not in session.get_providers():
        raise ConfigError("detector.device is cuda, but onnxruntime cannot start CUDA", hint="check its CUDA libraries")
    try:
        inputs, outputs = ([_tensor(node) for node in nodes] for nodes in (session.get_inputs(), session.get_outputs()))
        metadata = session.get_modelmeta().custom_metadata_map
    except UnicodeDecodeError as error:
        raise DetectorError("a name or the metadata of the model is not UTF-8", where=str(path)) from error
    images = [image for image in map(_as_image, inputs) if image is not None]
    extras = tuple(t for t in inputs if _FED.get(t.name) == len(t.shape) and t.kind in _KINDS)
    if len(images) != 1 or len(extras) + 1 != len(inputs):
        saw = "; ".join(map(str, inputs)) or "none"
        hint = f"export the model with one image input of 3 channels, and at most {_MASK} and {_SIZES} besides"
        raise DetectorError(f"the model has inputs that an image does not feed: {saw}", where=str(path), hint=hint)
    if prod(size or 1 for size in (images[0].batch, images[0].height, images[0].width)) > _MOST_PIXELS:
        message = f"the model takes larger images than objslam, which takes {_MOST_PIXELS} px in a run: {images[0].tensor}"
        raise DetectorError(message, where=str(path))
    return Network(path, session, digest, metadata, images[0], extras, tuple(outputs))


def _digest(path: Path) -> str:
    """Return the SHA-256 of the model and of the files beside it whose names begin with the model's name. Exporters store
    large weights in such files."""
    total = hashlib.sha256()
    beside = sorted(p for p in path.parent.iterdir() if p.name.startswith(path.name) and p != path and p.is_file())
    for part in (path, *beside):
        with part.open("rb") as file:
            total.update(hashlib.file_digest(file, "sha256").digest())
    return total.hexdigest()


def _memory() -> int:
    """Return the limit (bytes) of the main memory that all models of this process take together."""
    try:
        return min(_MOST_MEMORY, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2)
    except (AttributeError, OSError, ValueError):  # Not every system says how much memory it has.
        return _MOST_MEMORY


@cache
def _limit_memory() -> bool:
    """Limit the memory that the onnxruntime sessions of this process share. A session that needs more raises an error.

    Return whether this was possible. Only a private module of onnxruntime has this limit, and the next version may lack the
    module. Without the limit, the limits on images and outputs remain.
    """
    try:
        from onnxruntime.capi import _pybind_state as ort

        # A size of -1 leaves the other choices to onnxruntime.
        pool = ort.OrtArenaCfg(_memory(), -1, -1, -1)
        place = ort.OrtMemoryInfo("Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT)
        ort.create_and_register_allocator(place, pool)
    except (ImportError, AttributeError, TypeError, RuntimeError):
        return False
    return True


def _is_refused_memory(error: Exception) -> bool:
    """Return whether a run failed because the computer, or the memory pool of onnxruntime, has too little memory."""
    return any(text in str(error) for text in ("is smaller than requested bytes", "Failed to allocate memory", "bad_alloc"))


def _providers(onnxruntime: Any, device: config.Device) -> list[str]:
    offered = _CUDA in onnxruntime.get_available_providers()
    if device == "cuda" and not offered:
        raise ConfigError("detector.device is cuda, but this onnxruntime has no CUDA", hint="replace it by onnxruntime-gpu")
    if device == "cpu" or not offered:
        return [_CPU]
    onnxruntime.preload_dlls()  # finds the CUDA libraries that pip installed
    return [_CUDA, _CPU]


def _tensor(node: Any) -> Tensor:
    shape = tuple(n if isinstance(n, int) and n > 0 else None for n in node.shape)
    return Tensor(node.name, shape, str(node.type).removeprefix("tensor(").removesuffix(")"))


def _as_image(tensor: Tensor) -> ImageInput | None:
    shape = tensor.shape
    if tensor.kind not in _PIXELS or len(shape) not in (3, 4) or tensor.name in _FED:
        return None
    batch, (a, b, c) = (shape[0] if len(shape) == 4 else 0), shape[-3:]
    if a == 3 or (a is None and c != 3):
        return ImageInput(tensor, batch, b, c, channels_last=False)
    return ImageInput(tensor, batch, a, b, channels_last=True) if c == 3 else None


def _extra(tensor: Tensor, count: int, height: int, width: int) -> Array:
    """Return the value of an input besides the image, for `count` images. A pixel mask keeps the whole image. The size of
    the original image is set to the size of the network input, so that the model's boxes are in px of the input."""
    kind = _KINDS[tensor.kind]
    if tensor.name == _SIZES:
        return np.tile(np.array([width, height], dtype=kind), (count, 1))
    sides = [side or full for side, full in zip(tensor.shape[-2:], (height, width), strict=True)]
    return np.ones((count, *sides), dtype=kind)
