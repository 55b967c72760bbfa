"""Draw on an image with smooth edges: shapes, texts, and thin lines that are darker where they overlap."""

from __future__ import annotations

import io
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats
from objslam.output.plot.figure import Colour

_SHIFT = 4  # The fractional bits of OpenCV's integer coordinates: 1 / 2^4 px. With more, smaller coordinates overflow.
_FAR = 1e6
"""The largest coordinate of a drawn point, px. Larger coordinates are set to this value. OpenCV's overflow at 1e8 px."""
_NEAR = 3.0  # The least distance between two drawn points of a line, px. A larger distance cuts the corners of curves.
_BATCH = 4_000_000  # The approximate number of pixels of segments that are drawn at once. A larger number takes more memory.
_HALO = 0.85  # The opacity of the white around a text, in [0, 1].
_HALO_WIDTH = 5  # The width, px, of the brush that widens a text to its halo.
_ROOM = 8  # The room, px, around a text for its halo and for letters that reach out of its box.
_WHITE: Colour = (1.0, 1.0, 1.0)

Image = NDArray[np.uint8]
"""An image (H, W, 3), BGR."""


def blank(width: int, height: int) -> Image:
    """Return a white image."""
    return np.full((height, width, 3), 255, dtype=np.uint8)


def draw_segments(image: Image, ends: Floats, colour: Colour, opacity: float) -> None:
    """Draw segments (n, 2, 2), px, with a width of 1 px (Wu 1991). Under k segments, the image keeps the share
    (1 - opacity)^k."""
    height, width = image.shape[:2]
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    # The canvas has a rim for pixels outside the image: one pixel at the left and top, two at the right and bottom.
    cover = np.zeros((height + 3) * (width + 3))
    for pixel, weight in _pixels_of(ends, width, height):
        cover += np.bincount(pixel, weight, minlength=len(cover))
    inside = cover.reshape(height + 3, width + 3)[1 : height + 1, 1 : width + 1].ravel()
    touched = np.flatnonzero(inside)
    left = (1 - opacity) ** inside[touched, None]
    flat = image.reshape(-1, 3)
    flat[touched] = np.round(flat[touched] * left + _bgr(colour) * (1 - left)).astype(np.uint8)


def _pixels_of(ends: Floats, width: int, height: int) -> Iterator[tuple[NDArray[np.int64], Floats]]:
    """Yield the pixels that segments (n, 2, 2), px, touch, and the covered share of each pixel, in batches.

    A segment touches two neighbouring pixels for each px of its length. A pixel is given by its index in the flat canvas of
    `draw_segments`.
    """
    along = ends[:, 1] - ends[:, 0]
    steep = np.abs(along[:, 1]) > np.abs(along[:, 0])
    ends = np.where(steep[:, None, None], ends[..., ::-1], ends)  # The longer coordinate comes first.
    ends = np.where((ends[:, 0, 0] > ends[:, 1, 0])[:, None, None], ends[:, ::-1], ends)
    longer, other = np.where(steep, [[height], [width]], [[width], [height]])
    first = np.clip(np.ceil(ends[:, 0, 0]), 0, longer).astype(np.int64)
    last = np.clip(np.floor(ends[:, 1, 0]), -1, longer - 1).astype(np.int64)
    count = np.maximum(last - first + 1, 0)
    slope = (ends[:, 1, 1] - ends[:, 0, 1]) / np.maximum(ends[:, 1, 0] - ends[:, 0, 0], 1e-9)
    to_next, to_side = np.where(steep, [[width + 3], [1]], [[1], [width + 3]])
    for part in np.array_split(np.arange(len(ends)), int(count.sum()) // _BATCH + 1):
        number = count[part]
        which = np.repeat(part, number)
        fast = np.arange(len(which)) + np.repeat(first[part] - np.cumsum(number) + number, number)
        slow = (ends[:, 0, 1] - slope * ends[:, 0, 0])[which] + slope[which] * fast
        slow = np.clip(slow, -1.0, other[which])
        below = np.floor(slow).astype(np.int64)
        share, side = slow - below, to_side[which]
        pixel = (fast + 1) * to_next[which] + (below + 1) * side
        yield pixel, 1 - share
        yield pixel + side, share


def draw_line(image: Image, points: Floats, colour: Colour, width: float, dash: tuple[float, float] | None = None) -> None:
    """Draw a line through points (n, 2), px. dash: the lengths of a dash and of the gap after it, px, None for no dashes."""
    points = _apart(np.clip(points[np.isfinite(points).all(axis=1)], -_FAR, _FAR))
    if len(points) < 2:
        return
    parts = [points] if dash is None else _dashes(points, *dash, (image.shape[1], image.shape[0]))
    lines = [_fixed(part) for part in parts]
    cv2.polylines(image, lines, False, _bgr(colour).tolist(), max(1, round(width)), cv2.LINE_AA, _SHIFT)


def _apart(points: Floats) -> Floats:
    """Return the points (n, 2), px, of a line without those nearer than `_NEAR` to the previous point, as short pieces look
    thick."""
    if len(points) < 3:
        return points
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    kept = np.diff(np.floor(way / _NEAR), prepend=-1.0) > 0
    kept[-1] = True
    return points[kept]


def _dashes(points: Floats, dash: float, gap: float, size: tuple[int, int]) -> list[Floats]:
    """Return the dashes (k, 2) of a line through points (n, 2), px, that are inside an image. size: (width, height), px."""
    begin, way = points[:-1], np.diff(points, axis=0)
    piece = np.linalg.norm(way, axis=1)
    length = np.append(0.0, np.cumsum(piece))
    with np.errstate(divide="ignore", invalid="ignore"):  # Pieces parallel to an edge divide by 0.
        meets = np.sort(
            np.nan_to_num([-begin / way, (np.array(size) - begin) / way], nan=0.0, posinf=2.0, neginf=-2.0), axis=0
        )
    enters, leaves = meets[0].max(axis=1).clip(0, 1), meets[1].min(axis=1).clip(0, 1)
    seen = np.flatnonzero(enters < leaves)
    first, last = ((length[seen] + piece[seen] * at[seen]) // (dash + gap) for at in (enters, leaves))
    count = (last - first).astype(np.int64) + 1
    number = np.repeat(first, count) + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    begins = np.unique(number) * (dash + gap)
    ends = np.minimum(begins + dash, length[-1])
    at = [np.column_stack([np.interp(s, length, points[:, axis]) for axis in (0, 1)]) for s in (begins, ends)]
    inner = np.searchsorted(length, begins, side="right"), np.searchsorted(length, ends)
    return [
        np.concatenate([a[None], points[i:j], b[None]])
        for a, b, i, j in zip(*at, inner[0].tolist(), inner[1].tolist(), strict=True)
    ]


def draw_dot(image: Image, centre: Floats, size: float, colour: Colour, rim: Colour, rim_width: float) -> None:
    """Draw a filled circle with a rim around the centre (2,), px. size: the diameter, px. rim_width: px."""
    if np.isfinite(centre).all():
        at, one = _fixed(centre[None])[0, 0].tolist(), 1 << _SHIFT
        cv2.circle(image, at, round(one * (size + rim_width) / 2), _bgr(rim).tolist(), -1, cv2.LINE_AA, _SHIFT)
        cv2.circle(image, at, round(one * (size - rim_width) / 2), _bgr(colour).tolist(), -1, cv2.LINE_AA, _SHIFT)


def draw_area(image: Image, rim: Floats, colour: Colour, opacity: float) -> None:
    """Draw a filled polygon (n, 2), px, with a rim of 1 px. opacity: the opacity of the filling, in [0, 1]."""
    if not np.isfinite(rim).all():
        return
    size = np.array(image.shape[1::-1])
    x1, y1 = np.clip(np.floor(rim.min(axis=0)), 0, size).astype(int).tolist()
    x2, y2 = np.clip(np.ceil(rim.max(axis=0)) + 1, 0, size).astype(int).tolist()
    if x1 < x2 and y1 < y2:
        mask = np.zeros((y2 - y1, x2 - x1), dtype=np.uint8)
        cv2.fillPoly(mask, [_fixed(rim - [x1, y1])], 255, cv2.LINE_AA, _SHIFT)
        _blend(image[y1:y2, x1:x2], mask, colour, opacity)
    cv2.polylines(image, [_fixed(rim)], True, _bgr(colour).tolist(), 1, cv2.LINE_AA, _SHIFT)


def text_width(text: str, size: float) -> int:
    """Return the width, px, of a text in a font of this size, px."""
    return int(cv2.getTextSize((0, 0), text, (0, 0), _font(), round(size), 400)[2])


def draw_text(
    image: Image, text: str, corner: tuple[float, float], size: float, colour: Colour, *, halo: bool = False
) -> None:
    """Draw a text. corner: the upper left corner x, y of its box, px. size: the font size, px. halo: whether the text has a
    white halo."""
    x, y = round(corner[0]), round(corner[1])
    wide, high = text_width(text, size), round(1.25 * size)
    mask = np.zeros((high + 2 * _ROOM, wide + 2 * _ROOM, 3), dtype=np.uint8)
    cv2.putText(mask, text, (_ROOM, _ROOM + round(0.95 * size)), (255, 255, 255), _font(), round(size), 400)
    left, top = x - _ROOM, y - _ROOM
    x1, y1, x2, y2 = (
        max(left, 0),
        max(top, 0),
        min(left + mask.shape[1], image.shape[1]),
        min(top + mask.shape[0], image.shape[0]),
    )
    if x1 >= x2 or y1 >= y2:
        return
    cover = np.ascontiguousarray(mask[y1 - top : y2 - top, x1 - left : x2 - left, 0])
    if halo:
        brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_HALO_WIDTH, _HALO_WIDTH))
        _blend(image[y1:y2, x1:x2], np.asarray(cv2.dilate(cover, brush), dtype=np.uint8), _WHITE, _HALO)
    _blend(image[y1:y2, x1:x2], cover, colour, 1.0)


def encode_png(image: Image) -> bytes:
    """Return an image as the content of a PNG file with 256 colours. The file looks the same with a fifth of the bytes."""
    from PIL import Image as Picture

    few = Picture.fromarray(np.ascontiguousarray(image[..., ::-1])).quantize(
        256, method=Picture.Quantize.FASTOCTREE, dither=Picture.Dither.NONE
    )
    # `quantize` makes white a shade darker. The first pixel is background, so its palette entry is set back to white.
    palette, paper = few.getpalette() or [], int(np.asarray(few)[0, 0])
    palette[3 * paper : 3 * paper + 3] = [255, 255, 255]
    few.putpalette(palette)
    content = io.BytesIO()
    few.save(content, format="png")
    return content.getvalue()


def _blend(part: Image, cover: NDArray[np.uint8], colour: Colour, opacity: float) -> None:
    """Blend a colour into a part (h, w, 3) of an image, where the cover (h, w) is above 0."""
    share = opacity / 255 * cover[..., None]
    part[:] = np.round(part * (1 - share) + _bgr(colour) * share).astype(np.uint8)


def _fixed(points: Floats) -> NDArray[np.int32]:
    """Return points (n, 2), px, as OpenCV takes them: (n, 1, 2), in 1 / 2^_SHIFT px."""
    return np.round(np.clip(points, -_FAR, _FAR) * (1 << _SHIFT)).astype(np.int32)[:, None]


def _bgr(colour: Colour) -> Floats:
    return 255 * np.array(colour[::-1])


def _font() -> cv2.FontFace:
    return cv2.FontFace("sans")
