"""The detector, which finds boxes with labels and scores in images."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from objslam import config
from objslam.config.detector import Role
from objslam.core.arrays import Array, Floats
from objslam.detection.infer_recipe import DESCRIPTION, USER_ONLY, input_size, settle
from objslam.detection.model_description import with_description
from objslam.detection.onnx_model import Network, open_network
from objslam.detection.output_layouts import Output
from objslam.detection.postprocess import decode
from objslam.detection.preprocess import Fit, fill, fit
from objslam.detection.recipe import Recipe
from objslam.errors import DetectorError

_DECODING = 1  # The version of the decoding. Increase it with each change of the decoding, so that old caches are not used.


class Boxes(NamedTuple):
    """The N boxes of one image, the best score first. boxes: (N, 4) x1, y1, x2, y2 in px of the raw image. scores: (N,)."""

    boxes: Floats
    labels: tuple[str, ...]
    scores: Floats


@dataclass(frozen=True)
class Detector:
    """A network with its recipe. batch: the largest number of images in one run. warnings: the warnings about the model."""

    network: Network
    recipe: Recipe
    batch: int
    warnings: tuple[str, ...]

    @property
    def key(self) -> str:
        """The SHA-256 of the model and its recipe. Two detectors with the same key find the same boxes in an image."""
        text = f"{_DECODING}\n{self.network.digest}\n{self.recipe.as_text()}"
        return hashlib.sha256(text.encode()).hexdigest()

    def detect(self, images: Sequence[Array]) -> list[Boxes]:
        """Return the boxes of each image (H, W, 3), uint8, BGR. Raises ValueError if an image has another shape or type, and
        DetectorError if the network fails, or if its outputs cannot be decoded to boxes."""
        for image in images:
            if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
                raise ValueError(f"an image must be (H, W, 3) uint8, got {image.shape} {image.dtype}")
        results: list[Boxes] = []
        for _, same_size in groupby(images, key=lambda image: image.shape):
            alike = list(same_size)
            for start in range(0, len(alike), self.batch):
                group = alike[start : start + self.batch]
                blob, where = self.prepare(group)
                results += self.read(self.network.run(blob), where, len(group))
        return results

    def prepare(self, images: Sequence[Array]) -> tuple[Array, Fit]:
        """Return the network input for at most `batch` images of one size, and their `Fit`. The `Fit` is the place of a
        resized image in the input."""
        height, width = images[0].shape[:2]
        where = fit(self.recipe, width, height)
        return fill(self.recipe, images, where, self.network.image.batch or len(images)), where

    def read(self, outputs: Sequence[Array], where: Fit, count: int) -> list[Boxes]:
        """Return the boxes of the first `count` images of a batch from the network's outputs. where: the `Fit` that
        `prepare` returned."""
        named = _by_role(self.network, self.recipe, outputs)
        if not _has_batch(named):
            return [self._boxes(named, where)]
        if any(len(values) < count for values in named.values()):
            saw = ", ".join(f"{role} {list(values.shape)}" for role, values in named.items())
            message = f"the outputs have fewer results than the {count} images of the batch: {saw}"
            raise DetectorError(message, where=str(self.network.path), hint="detector.batch=1")
        return [self._boxes({role: values[i] for role, values in named.items()}, where) for i in range(count)]

    def _boxes(self, outputs: dict[Role, Array], where: Fit) -> Boxes:
        try:
            found = decode(self.recipe, outputs, where.input_width, where.input_height)
        except DetectorError as error:
            raise DetectorError(error.message, where=str(self.network.path), hint=error.hint) from error
        boxes = where.to_raw(found.boxes)
        inside = np.flatnonzero((boxes[:, 2:] > boxes[:, :2]).all(axis=1))  # drops a box that lies in the padding
        names, label = self.recipe.names, found.label[inside].tolist()
        return Boxes(boxes[inside], tuple(names[i] if names else f"class_{i}" for i in label), found.scores[inside])


def load_detector(model: Path, settings: config.Detector) -> Detector:
    """Load an ONNX detector, run it once, and determine its recipe. Raises ConfigError if the settings do not fit the model.

    Raises DetectorError if the file is no ONNX model, needs other inputs than an image, cannot run, or has outputs of an
    unknown layout. In this last case, the message lists the outputs and says how to describe them.
    """
    network = open_network(model, settings)
    settings = with_description(network, settings, DESCRIPTION, USER_ONLY)
    size = input_size(network, settings)
    image = np.zeros((network.image.batch or 1, 3, size.height, size.width), dtype=np.float32)
    values = network.run(image)
    outputs = [Output(tensor.name, array) for tensor, array in zip(network.outputs, values, strict=True)]
    recipe, warning = settle(network, settings, size, outputs)
    several = _has_batch(_by_role(network, recipe, values))
    fixed = network.image.batch
    if fixed is not None and fixed > 1 and not several:
        message = f"the model takes {fixed} images per run, but its outputs do not assign boxes to images"
        raise DetectorError(message, where=str(model), hint="export it for one image")
    batch = (settings.batch if fixed is None else max(fixed, 1)) if several else 1
    return Detector(network, recipe, batch, (f"{model}: {warning}",) if warning else ())


def _by_role(network: Network, recipe: Recipe, outputs: Sequence[Array]) -> dict[Role, Array]:
    values = {tensor.name: array for tensor, array in zip(network.outputs, outputs, strict=True)}
    return {role: values[name] for role, name in recipe.outputs.items()}


def _has_batch(named: dict[Role, Array]) -> bool:
    """Return whether the outputs have a batch axis, so that boxes are (B, N, 4) and not (N, 4)."""
    return named["boxes" if "boxes" in named else "predictions"].ndim == 3
