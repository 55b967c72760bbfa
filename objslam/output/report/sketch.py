"""Sketches: the rays of one object from above, as paths of an SVG drawing."""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.output.plot.style import evenly

WIDTH, HEIGHT = 160.0, 100.0  # The area of a sketch, in units of the drawing.
_MARGIN = 8.0  # The width of the margin around what is drawn, in units of the drawing.
_MOST = 40  # The largest number of used rays, and of rejected rays, in a sketch. More rays would merge into one area.
_BAR = 0.3  # The largest length of the scale bar, as a share of the width.
_ELLIPSE = np.stack([np.cos(t := np.linspace(0, 2 * np.pi, 40, endpoint=False)), np.sin(t)])  # A unit circle.
_STEPS = (5.0, 2.0, 1.0)  # A scale bar is one of these numbers times a power of ten, m.


@dataclass(frozen=True)
class Sketch:
    """The rays of an object from above, in units of the drawing.

    used, rejected, path: SVG path data of the used rays, the rejected rays and the robot's path. ellipse: SVG path data of
    the 2-sigma ellipse, empty without a covariance. dot: the position of the object. others: the positions of the other
    objects of its label. bar: the length of the scale bar. metres: the length of the scale bar in the map, as text.
    """

    used: str
    rejected: str
    path: str
    ellipse: str
    dot: tuple[float, float]
    others: tuple[tuple[float, float], ...]
    bar: float
    metres: str


def sketch(
    origins: Floats,
    directions: Floats,
    used: Bools,
    position: Floats,
    covariance: Floats | None,
    path: Floats,
    others: Floats,
) -> Sketch | None:
    """Return the sketch of an object, or None without a finite position or without rays.

    Args:
        origins, directions: (M, 2) origins of the rays, m, and the components of their unit vectors in the plane.
        used: (M,) whether a ray is used. Other rays are rejected.
        position: (2,) position of the object in the plane seen from above, m. covariance: (2, 2), m^2.
        path: (K, 2) positions of the robot, m.
        others: (N, 2) positions of the other objects of the label, m.
    """
    if not np.isfinite(position).all() or not len(origins):
        return None
    flat = np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    reach = np.linalg.norm(position - origins, axis=1, keepdims=True)
    ends = origins + reach * directions / flat
    rim = np.zeros((0, 2))
    if covariance is not None and np.isfinite(covariance).all():
        values, vectors = np.linalg.eigh(covariance)
        rim = position + 2 * ((vectors * np.sqrt(np.maximum(values, 0.0))) @ _ELLIPSE).T
    seen = np.concatenate([origins, position[None]])
    low, high = seen.min(axis=0), seen.max(axis=0)
    centre, side = (low + high) / 2, np.maximum(high - low, 1e-6)
    scale = float(min((WIDTH - 2 * _MARGIN) / side[0], (HEIGHT - 2 * _MARGIN) / side[1], 400.0))

    def draw(points: Floats) -> Floats:
        return (points - centre) * [scale, -scale] + [WIDTH / 2, HEIGHT / 2]

    kinds = []
    for mask in (used, ~used):
        rows = np.flatnonzero(mask)
        rows = rows[evenly(len(rows), _MOST)]
        lines = np.hstack([draw(origins[rows]), draw(ends[rows])])
        kinds.append("".join(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for a, b, c, d in lines.tolist()))
    longest = _BAR * WIDTH / scale
    power = 10.0 ** np.floor(np.log10(longest))
    length = float(next((s * power for s in _STEPS if s * power <= longest), power))
    near = [tuple(p) for p in draw(others).tolist() if 0 <= p[0] <= WIDTH and 0 <= p[1] <= HEIGHT]
    x, y = draw(position[None])[0].tolist()
    way = draw(path)
    way = way[evenly(len(way), 300)]
    return Sketch(
        used=kinds[0],
        rejected=kinds[1],
        path=_polyline(way),
        ellipse=_polyline(draw(rim)) + "z" if len(rim) else "",
        dot=(x, y),
        others=tuple((float(a), float(b)) for a, b in near),
        bar=length * scale,
        metres=f"{length:g} m",
    )


def _polyline(points: Floats) -> str:
    """Return SVG path data of a line through points (N, 2). Points far outside are moved nearer, but stay outside."""
    near = np.clip(points, -WIDTH, 2 * WIDTH)
    return "".join(f"{'L' if i else 'M'}{x:.1f} {y:.1f}" for i, (x, y) in enumerate(near.tolist()))
