"""The image encoder, which makes an appearance vector of the crop of each box."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from objslam import config
from objslam.core.appearance.features import MAX_FEATURES
from objslam.core.arrays import Array, Floats
from objslam.detection.model_description import with_description
from objslam.detection.onnx_model import Network, open_network
from objslam.detection.preprocess import Fit, fill
from objslam.detection.recipe import IMAGENET, EncoderRecipe
from objslam.errors import ConfigError, DetectorError

DESCRIPTION = "objslam.encoder"
"""The metadata key of a model's own description, which is JSON with keys of the `encoder` settings."""
_USER_ONLY = frozenset({"margin", "batch", "size"})
_SIZE = 224
"""The width and height of the input, px, if neither the model nor the settings have a size. Most encoders are trained with
this size."""
_VECTOR_OUTPUTS = ("image_embeds", "image_features", "pooler_output", "embeddings", "embedding", "features")
"""The names that exporters give to the output with the vectors. The most reliable name is first."""


@dataclass(frozen=True)
class Encoder:
    """A network with its recipe. output: the index of the output with the vectors. batch: the most crops that one run
    takes."""

    network: Network
    recipe: EncoderRecipe
    output: int
    batch: int

    def encode(self, image: Array, boxes: Floats) -> Array:
        """Return the vectors (N, D) of boxes (N, 4) in an image (H, W, 3), uint8, BGR. boxes: x1, y1, x2, y2, px. Raises
        DetectorError if the network fails."""
        crops = [_crop(image, box, self.recipe.margin) for box in boxes]
        found = [self._run(crops[at : at + self.batch]) for at in range(0, len(crops), self.batch)]
        return np.concatenate(found)

    def _run(self, crops: Sequence[Array]) -> Array:
        width, height, fixed = self.recipe.width, self.recipe.height, self.network.image.batch
        blob = np.zeros((fixed or len(crops), 3, height, width), dtype=np.float32)
        for plane, crop in zip(blob, crops, strict=False):
            whole = Fit(crop.shape[1], crop.shape[0], width, height, 0, 0, width, height)
            plane[:] = fill(self.recipe, [crop], whole, 1)[0]
        values = self.network.run(blob)[self.output]
        return values.reshape(len(values), -1)[: len(crops)] if values.ndim > 1 else values[None]


def load_encoder(model: Path, settings: config.Settings) -> Encoder:
    """Load an ONNX image encoder, and run it once to find the output with one vector per image.

    Raises DetectorError if the file is no ONNX model, needs other inputs than an image, cannot run, or has no such output.
    Raises ConfigError if the settings do not fit the model.
    """
    network = open_network(model, settings.detector)
    chosen = with_description(network, settings.encoder, DESCRIPTION, _USER_ONLY)
    image = network.image
    width, height = chosen.size or (image.width or _SIZE, image.height or _SIZE)
    if (width, height) != (image.width or width, image.height or height):
        takes = f"{image.width or 'any'}x{image.height or 'any'}"
        raise ConfigError(f"encoder.size is {width}x{height}, the model takes {takes}", where=str(model))
    recipe = EncoderRecipe(
        colour=chosen.colour or "rgb",
        divide_by=chosen.divide_by or 255.0,
        mean=chosen.mean or IMAGENET[0],
        std=chosen.std or IMAGENET[1],
        width=width,
        height=height,
        margin=chosen.margin,
    )
    batch = chosen.batch if image.batch is None else max(image.batch, 1)
    trial = np.zeros((image.batch or (1 if image.batch == 0 else 2), 3, height, width), dtype=np.float32)
    return Encoder(network, recipe, _vector_output(network, chosen.output, network.run(trial), len(trial)), batch)


def _vector_output(network: Network, name: str | None, values: Sequence[Array], count: int) -> int:
    """Return the index of the output that holds one vector for each of the `count` images.

    name: the setting encoder.output, or None. values: the outputs of one run. Raises ConfigError if the model has no output
    of this name, and DetectorError if no output or several outputs fit.
    """
    names = [tensor.name for tensor in network.outputs]
    if name is not None and name not in names:
        raise ConfigError(
            f"encoder.output: the model has no output {name!r}, but {', '.join(names)}", where=str(network.path)
        )
    shapes = [value.shape if network.image.batch != 0 or value.ndim > 1 else (1, *value.shape) for value in values]
    fits = [
        np.issubdtype(value.dtype, np.floating)
        and len(shape) > 1
        and shape[0] == count
        and max(shape[1:]) == np.prod(shape[1:])  # (B, D), or (B, D, 1, 1) of a pooling
        and 1 < np.prod(shape[1:]) <= MAX_FEATURES
        for value, shape in zip(values, shapes, strict=True)
    ]
    found = [i for i, fit in enumerate(fits) if fit and name in (None, names[i])]
    usual = [names.index(one) for one in _VECTOR_OUTPUTS if one in names and names.index(one) in found]
    if len(found) == 1 or usual:
        return usual[0] if usual else found[0]
    saw = ", ".join(f"{one} {list(shape)}" for one, shape in zip(names, shapes, strict=True))
    message = f"{'several outputs hold' if found else 'no output holds'} one vector per image: {saw}"
    raise DetectorError(message, where=str(network.path), hint="set encoder.output, or export a model with such an output")


def _crop(image: Array, box: Floats, margin: float) -> Array:
    """Return the part of an image inside a box with a margin. The part has at least one pixel.

    box: x1, y1, x2, y2, px. margin: the margin on each side, as a share of the box's width or height.
    """
    size = np.array([image.shape[1], image.shape[0]])
    more = margin * (box[2:] - box[:2])
    low = np.clip(np.floor(box[:2] - more), 0, size - 1).astype(int)
    high = np.clip(np.ceil(box[2:] + more), low + 1, size).astype(int)
    return image[low[1] : high[1], low[0] : high[0]]
