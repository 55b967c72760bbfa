"""Short names of the array types."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Array = NDArray[Any]


def need(condition: Any, message: str) -> None:
    """Raise a ValueError with the message unless the condition is true."""
    if not condition:
        raise ValueError(message)
