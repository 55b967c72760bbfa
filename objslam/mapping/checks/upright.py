"""A check of the map's frame: whether its z axis points up."""

from objslam.core.types import Keyframes
from objslam.frontend.up import up_axis


def lies_on_its_side(keyframes: Keyframes) -> str | None:
    """Return a warning if the cameras' mean up vector is far from the map's z axis, as after visual SLAM, else None."""
    up = up_axis(keyframes)
    if up == "z":
        return None
    return (
        f"the map lies on its side: the cameras' up is {up}, not z. The pictures are drawn from above all the same, but the "
        "heights of the objects are not their z (turn the poses so that z points up)"
    )
