"""Draw a figure as an image: the map's area with its grid, the title above, and the legend below."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Floats
from objslam.output.plot.canvas import (
    Image,
    blank,
    draw_area,
    draw_dot,
    draw_line,
    draw_segments,
    draw_text,
    encode_png,
    text_width,
)
from objslam.output.plot.figure import Area, Figure, Line, Marks, Segments, Shape

FONT = 17.0  # The font size of labels and of the legend, px.
LINE = 1.25  # The height of a line of text, as a multiple of its font size. A larger number gives more room between lines.
_TITLE = 21.0  # The font size of the title, px.
_NOTE = 15.0  # The font size of the remark, px.
_MARGIN = 16  # The width of the white margin around the picture and between its parts, px.
_MOST_TICKS = 8  # The largest number of grid steps along the longer side of the map.
_WARNING_LINES = 3  # The largest number of lines of the warning. An ellipsis replaces the rest, which the terminal shows.
_COLUMNS = 4  # The largest number of columns of the legend.
_HANDLE = 34  # The width of the sample of an entry in the legend, px.
_DASH, _GAP = 8.0, 4.0  # The lengths of a dash and of the gap after a dash, px.
_TICK = 6  # The length of a tick, px.
_BLACK, _GREY, _RED = (0.0, 0.0, 0.0), (0.47, 0.47, 0.47), (0.65, 0.1, 0.07)
_GRID, _FRAME = (0.925, 0.925, 0.925), (0.77, 0.77, 0.77)


def render(figure: Figure) -> bytes:
    """Return a figure as the content of a PNG file."""
    area = _area(figure)
    lines = figure.title.split("\n")
    height, width = area.shape[:2]
    titled = _MARGIN + round(len(lines) * LINE * _TITLE)
    warnings = wrapped(figure.warning, width, FONT, _WARNING_LINES)
    top = titled + round(len(warnings) * LINE * FONT) + _MARGIN // 2
    ticks = _ticks(figure)
    left = 2 * _MARGIN + round(LINE * _TITLE) + max((text_width(text, FONT) for _, text in ticks[1]), default=0) + _TICK
    legend = _legend(figure)
    below = _TICK + round(2 * LINE * FONT) + 2 * _MARGIN
    wide = max(left + width + _MARGIN, *(left + text_width(line, _TITLE) + _MARGIN for line in lines), legend.shape[1])
    page = blank(wide, top + height + below + legend.shape[0])
    page[top : top + height, left : left + width] = area
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    frame = corners * np.array([width, height]) + np.array([left - 0.5, top - 0.5])
    draw_line(page, frame, _FRAME, 1)
    for i, line in enumerate(lines):
        draw_text(page, line, (left, _MARGIN + i * LINE * _TITLE), _TITLE, _BLACK)
    for i, line in enumerate(warnings):
        draw_text(page, line, (left, titled + i * LINE * FONT), FONT, _RED)
    if figure.note:
        draw_text(
            page, figure.note, (left + width - text_width(figure.note, _NOTE), titled - LINE * _NOTE + 5), _NOTE, _GREY
        )
    _draw_ticks(page, ticks, left, top, top + height)
    right, up = (f"{name} (m)" for name in figure.axes)
    across = left + (width - text_width(right, FONT)) / 2
    draw_text(page, right, (across, top + height + _TICK + LINE * FONT + 4), FONT, _BLACK)
    upright = blank(text_width(up, FONT) + 4, round(LINE * FONT) + 4)
    draw_text(upright, up, (2, 2), FONT, _BLACK)
    turned = np.rot90(upright)
    from_top = top + max((height - turned.shape[0]) // 2, 0)
    shown = turned[: page.shape[0] - from_top]
    page[from_top : from_top + len(shown), _MARGIN : _MARGIN + turned.shape[1]] = shown
    page[page.shape[0] - legend.shape[0] :, : legend.shape[1]] = legend
    return encode_png(page)


def wrapped(text: str, width: float, font: float, most: int) -> list[str]:
    """Return a text as at most `most` lines. Only a line of a single long word is wider than `width` px. An ellipsis
    replaces the words without room. font: the font size, px."""
    lines: list[str] = []
    for word in text.split():
        if lines and text_width(f"{lines[-1]} {word}", font) <= width:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    if len(lines) <= most:
        return lines
    words = lines[most - 1].split()
    while len(words) > 1 and text_width(" ".join(words) + " …", font) > width:
        words.pop()
    return [*lines[: most - 1], " ".join(words) + " …"]


def _area(figure: Figure) -> Image:
    """Return the picture of the shown area of the map. The edges of the picture cut off all that is outside."""
    width, height = figure.size
    area = blank(width, height)
    ticks = _ticks(figure)
    for x, _ in ticks[0]:
        draw_line(area, np.array([[x, 0.0], [x, height]]), _GRID, 1)
    for y, _ in ticks[1]:
        draw_line(area, np.array([[0.0, y], [width, y]]), _GRID, 1)
    for shape in figure.shapes:
        _draw_shape(area, figure, shape)
    for label in figure.labels:
        if label.leader is not None:
            draw_line(area, label.leader, label.colour, 1)
    for label in figure.labels:
        draw_text(area, label.text, (float(label.box[0]), float(label.box[1])), FONT, label.colour, halo=True)
    return area


def _draw_shape(area: Image, figure: Figure, shape: Shape) -> None:
    if isinstance(shape, Segments):
        draw_segments(area, figure.pixels(shape.ends), shape.colour, shape.opacity)
    elif isinstance(shape, Area):
        draw_area(area, figure.pixels(shape.rim), shape.colour, shape.opacity)
    elif isinstance(shape, Line):
        draw_line(area, figure.pixels(shape.points), shape.colour, shape.width, (_DASH, _GAP) if shape.dashed else None)
    else:
        _draw_marks(area, figure.pixels(shape.points), shape)


def _turned(angle: float) -> Floats:
    """Return the matrix (2, 2) that turns points counterclockwise by an angle, rad. The points are rows: points @ matrix."""
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


_ARM = 0.3  # Half the width of an arm of a plus, as a share of half its size.
_PLUS = np.array([(1, _ARM), (_ARM, _ARM), (_ARM, 1), (-_ARM, 1), (-_ARM, _ARM), (-1, _ARM)])
_RIMS = {
    "plus": np.concatenate([_PLUS, -_PLUS]),
    "x": np.concatenate([_PLUS, -_PLUS]) @ _turned(np.pi / 4),
    "diamond": np.array([(1, 0), (0, 1), (-1, 0), (0, -1)]),
    "triangle": np.column_stack([np.cos(np.radians([0, 130, 230])), np.sin(np.radians([0, 130, 230]))]),
}
"""The corners of each filled mark, as multiples of half the size of the mark. x is to the right, and y is up."""


def _draw_marks(image: Image, points: Floats, marks: Marks) -> None:
    """Draw marks at points (n, 2), px."""
    for point in points:
        if marks.kind == "cross":
            for arm in np.eye(2) * marks.size / 2:
                draw_line(image, np.stack([point - arm, point + arm]), marks.colour, 1)
        elif marks.kind in _RIMS:
            rim = marks.size / 2 * _RIMS[marks.kind] @ _turned(marks.turn)
            draw_area(image, point + rim * [1, -1], marks.colour, 1.0)
        else:
            draw_dot(image, point, marks.size, marks.colour, marks.rim, 1.0 if marks.rim == (1.0, 1.0, 1.0) else 2.0)


Ticks = tuple[list[tuple[float, str]], list[tuple[float, str]]]
"""The position, px of the shown area, and the text of each tick, first along x, then along y."""


def _ticks(figure: Figure) -> Ticks:
    """Return the ticks of a figure. Their step is 1, 2 or 5 times a power of ten, m, the same along both axes."""
    least = float((figure.high - figure.low).max()) / _MOST_TICKS
    power = 10.0 ** np.floor(np.log10(least))
    step = power * next(factor for factor in (1, 2, 5, 10) if factor * power >= least)
    digits = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    found = []
    for axis in (0, 1):
        values = step * np.arange(np.ceil(figure.low[axis] / step), np.floor(figure.high[axis] / step) + 1)
        points = np.zeros((len(values), 2))
        points[:, axis] = values
        texts = [f"{value + 0.0:.{digits}f}".replace("-", "\u2212") for value in values.tolist()]
        found.append(list(zip(figure.pixels(points)[:, axis].tolist(), texts, strict=True)))
    return found[0], found[1]


def _draw_ticks(page: Image, ticks: Ticks, left: int, top: int, bottom: int) -> None:
    """Draw the ticks of an area. left, top, bottom: the edges of the area, px of the page."""
    for x, text in ticks[0]:
        draw_line(page, np.array([[left + x, bottom], [left + x, bottom + _TICK]]), _BLACK, 1)
        draw_text(page, text, (left + x - text_width(text, FONT) / 2, bottom + _TICK + 3), FONT, _BLACK)
    for y, text in ticks[1]:
        draw_line(page, np.array([[left - _TICK, top + y], [left - 1, top + y]]), _BLACK, 1)
        draw_text(page, text, (left - _TICK - 4 - text_width(text, FONT), top + y - 0.62 * FONT), FONT, _BLACK)


def _legend(figure: Figure) -> Image:
    """Return the picture of the legend: a sample and the name of each shape that has a name."""
    entries = [*(one for one in figure.shapes if not isinstance(one, Area) and one.name), *figure.legend]
    rows = -(-len(entries) // _COLUMNS)
    columns = [entries[i : i + rows] for i in range(0, len(entries), rows)] if rows else []
    widths = [_HANDLE + 3 * _MARGIN + max(text_width(one.name, FONT) for one in column) for column in columns]
    high = round(1.1 * LINE * FONT)
    image = blank(sum(widths) + _MARGIN, rows * high + _MARGIN)
    for k, column in enumerate(columns):
        x = _MARGIN + sum(widths[:k])
        for row, entry in enumerate(column):
            middle = row * high + high / 2
            _draw_sample(image, entry, np.array([[x, middle], [x + _HANDLE, middle]]))
            draw_text(image, entry.name, (x + _HANDLE + _MARGIN, middle - 0.62 * FONT), FONT, _BLACK)
    return image


def _draw_sample(image: Image, entry: Segments | Line | Marks, ends: Floats) -> None:
    """Draw the sample of an entry of the legend. ends: (2, 2) the left and the right end of its place, px."""
    if isinstance(entry, Marks):
        _draw_marks(image, ends.mean(axis=0, keepdims=True), entry)
    else:
        dash = (_DASH, _GAP) if isinstance(entry, Line) and entry.dashed else None
        draw_line(image, ends, entry.colour, 2, dash)
