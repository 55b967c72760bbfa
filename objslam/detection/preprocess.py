"""Convert images to the size, colours and value range of the network input, and convert boxes back to the raw image."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Array, Floats
from objslam.detection.recipe import EncoderRecipe, Recipe
from objslam.errors import ConfigError


@dataclass(frozen=True)
class Fit:
    """The place of the resized image in the network input, px. width, height: the size of the raw image. left, top: the
    corner of the resized image in the input. content_width, content_height: the size of the resized image."""

    width: int
    height: int
    input_width: int
    input_height: int
    left: int
    top: int
    content_width: int
    content_height: int

    def to_raw(self, boxes: Floats) -> Floats:
        """Convert boxes (N, 4) x1, y1, x2, y2 from px of the input to px of the raw image, clipped at its edges."""
        scale = np.array([self.width / self.content_width, self.height / self.content_height] * 2)
        raw = (boxes - np.array([self.left, self.top] * 2)) * scale
        return np.clip(raw, 0.0, np.array([self.width, self.height] * 2, dtype=np.float64))


def fit(recipe: Recipe, width: int, height: int) -> Fit:
    """Return the place of the resized image in the network input. width, height: the size of the raw image, px. Raises
    ConfigError if the recipe does not resize and the model takes another size."""
    size = recipe.size
    if recipe.resize == "none":
        if (width if size.free_width else size.width, height if size.free_height else size.height) != (width, height):
            message = f"detector.resize is none, but the model takes {size.width}x{size.height}, not {width}x{height}"
            raise ConfigError(message, hint="set letterbox, corner or stretch")
        return Fit(width, height, width, height, 0, 0, width, height)
    if recipe.resize == "stretch":
        return Fit(width, height, size.width, size.height, 0, 0, size.width, size.height)
    scale = min(size.width / width, size.height / height)
    content_width, content_height = max(round(width * scale), 1), max(round(height * scale), 1)
    # A free axis shrinks to the content, in whole strides.
    input_width = -(-content_width // size.stride) * size.stride if size.free_width else size.width
    input_height = -(-content_height // size.stride) * size.stride if size.free_height else size.height
    centred = recipe.resize == "letterbox"
    left, top = ((input_width - content_width) // 2, (input_height - content_height) // 2) if centred else (0, 0)
    return Fit(width, height, input_width, input_height, left, top, content_width, content_height)


def fill(recipe: Recipe | EncoderRecipe, images: Sequence[Array], where: Fit, count: int) -> Array:
    """Convert images (H, W, 3), uint8, BGR, of one size to the network input (count, 3, input height, input width). If there
    are fewer images than `count`, the rest of the input is grey."""
    import cv2

    gain = 1.0 / (recipe.divide_by * np.array(recipe.std))
    offset = -np.array(recipe.mean) / np.array(recipe.std)
    blob = np.empty((count, 3, where.input_height, where.input_width), dtype=np.float32)
    if len(images) < count or (where.content_width, where.content_height) != (where.input_width, where.input_height):
        blob[:] = (recipe.pad * gain + offset).astype(np.float32)[:, None, None]
    rows = slice(where.top, where.top + where.content_height)
    columns = slice(where.left, where.left + where.content_width)
    for image, planes in zip(images, blob, strict=False):
        content = image
        if (where.content_width, where.content_height) != (where.width, where.height):
            content = cv2.resize(image, (where.content_width, where.content_height), interpolation=cv2.INTER_LINEAR)
        channels = cv2.split(content)
        ordered = reversed(channels) if recipe.colour == "rgb" else channels
        for plane, channel, factor, shift in zip(planes, ordered, gain, offset, strict=True):
            target = plane[rows, columns]
            np.multiply(channel, np.float32(factor), out=target)
            if shift:
                target += np.float32(shift)
    return blob
