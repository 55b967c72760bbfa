"""Make the cards of the page. A card has the data of one object."""

import re
from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.types import Up
from objslam.frontend.up import from_above
from objslam.io.rays_parquet import RaysTable
from objslam.output.plot.style import REJECTED_BELOW, captions, label_colours
from objslam.output.report.charts import Histogram, axis_end, histogram
from objslam.output.report.crops import Crop
from objslam.output.report.scene import hexadecimal
from objslam.output.report.sketch import Sketch, sketch
from objslam.output.report.timeline import Timeline, timeline

_BINS = 16  # The number of bars in the histogram of an object. More bars show more detail, and each bar has fewer rays.
_NEIGHBOURS = 2  # The most objects of the same label on a card, the nearest first. Farther objects are rarely duplicates.


@dataclass(frozen=True)
class Neighbour:
    """A resolved object with the same label as the object of a card.

    distance: the distance between the two objects, m. sigmas: their Mahalanobis distance, with the sum of both covariances.
    It is None if a covariance is unknown.
    """

    object: MapObject
    caption: str
    distance: float
    sigmas: float | None


@dataclass(frozen=True)
class Card:
    """The data of one object on the page."""

    object: MapObject
    caption: str
    colour: str
    sigma: list[float] | None  # The standard deviations along x, y and z, m.
    seen: tuple[float, float]  # The times of the first and the last observation, s since the first ray.
    rejected: int  # The number of rejected rays.
    promised_deg: float | None  # The rms residual, deg, expected by the sigmas of the used rays. None without used rays.
    error: float | None  # The distance from the matching true object, m. None without a match.
    matched: str | None  # A text that names the matching true object.
    histogram: Histogram | None
    timeline: Timeline | None
    sketch: Sketch | None
    neighbours: list[Neighbour]
    crops: list[Crop]


def make_cards(
    objects: ObjectMap,
    rays: RaysTable,
    crops: dict[int, list[Crop]],
    errors: dict[int, tuple[float, str]],
    path: Floats,
    up: Up,
) -> list[Card]:
    """Return the cards, sorted by label and id. Times on a card are in s since the first ray of the result.

    rays: all rays of the result. crops: maps each object id to its pictures. errors: maps each matched object id to the
    distance from the true object, m, and a text that names the true object. path: (K, 3) positions of the robot in map, m.
    up: the axis of the map that points up.
    """
    begin, end = (float(rays.stamp.min()), float(rays.stamp.max())) if len(rays) else (0.0, 0.0)
    residual_deg = np.degrees(rays.residual)
    used = rays.weight >= REJECTED_BELOW
    kept = residual_deg[used & np.isfinite(residual_deg)]
    top = axis_end(kept) if len(kept) else None
    colours, names, plane = label_colours(objects), captions(objects), from_above(up)
    cards = []
    for i, o in enumerate(objects):
        mine = np.flatnonzero(rays.object == o.id)
        counted = mine[used[mine]]
        error, matched = errors.get(o.id, (None, None))
        alike = np.array([other.label == o.label and other.id != o.id for other in objects])
        card = Card(
            object=o,
            caption=names[i],
            colour=hexadecimal(colours[o.label]),
            sigma=None if o.covariance is None else np.sqrt(np.diag(o.covariance)).tolist(),
            seen=(o.first_seen - begin, o.last_seen - begin),
            rejected=len(mine) - len(counted),
            promised_deg=float(np.degrees(np.sqrt(2 * np.mean(rays.sigma[counted] ** 2)))) if len(counted) else None,
            error=error,
            matched=matched,
            histogram=histogram(residual_deg[mine], rays.weight[mine], _BINS, top),
            timeline=timeline(rays.stamp[mine], used[mine], begin, end) if len(mine) else None,
            sketch=sketch(
                rays.origin[mine][:, plane],
                rays.direction[mine][:, plane],
                used[mine],
                o.position[plane],
                None if o.covariance is None else o.covariance[np.ix_(plane, plane)],
                path[:, plane],
                objects.positions[alike][:, plane],
            ),
            neighbours=_neighbours(objects, names, i),
            crops=crops.get(o.id, []),
        )
        cards.append(card)
    return sorted(cards, key=lambda card: (natural(card.object.label), card.object.id))


def _neighbours(objects: ObjectMap, names: list[str], i: int) -> list[Neighbour]:
    """Return up to `_NEIGHBOURS` resolved objects with the label of object i, the nearest first.

    The list is empty if object i is unresolved. names: the caption of each object.
    """
    o = objects[i]
    if o.status != "ok":
        return []
    found = []
    for other, name in zip(objects, names, strict=True):
        if other.id == o.id or other.label != o.label or other.status != "ok":
            continue
        apart, sigmas = other.position - o.position, None
        if o.covariance is not None and other.covariance is not None:
            spread = o.covariance + other.covariance
            if np.isfinite(spread).all() and np.linalg.eigvalsh(spread)[0] > 0:
                sigmas = float(np.sqrt(apart @ np.linalg.solve(spread, apart)))
        found.append(Neighbour(other, name, float(np.linalg.norm(apart)), sigmas))
    return sorted(found, key=lambda neighbour: neighbour.distance)[:_NEIGHBOURS]


def natural(text: str) -> tuple[str, int]:
    """Return a sort key that places landmark_9 before landmark_10."""
    head, number = re.fullmatch(r"(.*?)([0-9]{0,18})", text, re.DOTALL).groups()  # type: ignore[union-attr]
    return head, int(number or -1)
