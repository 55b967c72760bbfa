"""The settings of the image encoder."""

from typing import Annotated

from pydantic import Field

from objslam.config.detector import Colour
from objslam.config.section import Count, Finite, NotNegative, Positive, Section


class Encoder(Section):
    """Configure the ONNX model that makes an appearance vector of each box (--embed). If a setting is null, its value comes
    from the model's metadata or shapes. Otherwise, its value is that of most encoders, such as the normalisation of
    ImageNet. The model runs on detector.device."""

    output: str | None = None
    """Name of the model output that has one vector per image. It is needed only if several outputs have such a shape."""
    size: tuple[Count, Count] | None = None
    """Width and height of the input in px, for a model that accepts any size. null uses 224 x 224."""
    colour: Colour | None = None
    """Order of the colour channels of the input. null uses rgb."""
    divide_by: Positive | None = None
    """Divisor of the pixel values (0 to 255). The input is (value / divide_by - mean) / std. null uses 255."""
    mean: tuple[Finite, Finite, Finite] | None = None
    """Mean of each channel, in the channel order of the input. null uses the values of ImageNet."""
    std: tuple[Positive, Positive, Positive] | None = None
    """Standard deviation of each channel, in the channel order of the input. null uses the values of ImageNet."""
    margin: NotNegative = 0.0
    """Margin that is added on each side of a box before the crop, as a share of the width and height of the box. A larger
    value shows more of the surroundings. This helps only if objects do not move between different surroundings."""
    batch: Annotated[int, Field(ge=1, le=1024)] = 16
    """Number of crops per batch, for a model that accepts any batch size."""
