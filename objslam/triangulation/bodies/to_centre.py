"""Compute the directions from the cameras to the centres of bodies, relative to the centres of their predicted boxes."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Floats
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.residuals import Residuals, whole_axes


def shifts_of(edges: BoxEdges, found: Residuals) -> Floats:
    """Return by how much each predicted box lies to the right of the measured box and below it (B, 2), px.

    If one edge of an axis is a bound, the other edge gives the shift. If both edges are bounds, the shift is 0.
    """
    low, high, both = edges.bound[:, :2], edges.bound[:, 2:], found.value[:, :4]
    by_one_edge = np.where(high, np.where(low, 0.0, -both[:, :2]), both[:, 2:])
    return np.where(whole_axes(edges)[:, :2], both[:, :2], by_one_edge)


def directions_to_centres(edges: BoxEdges, centre: Floats, shift: Floats) -> Floats:
    """Return the unit directions (B, 3) in map to the centres (N, 3), m, of bodies, minus the unit directions to the centres
    of predicted boxes.

    shift: (B, 2) px, as `shifts_of` returns it.
    """
    ray = edges.direction
    predicted = ray.copy()
    for axis in range(2):
        across = edges.normal[:, axis + 2] - edges.normal[:, axis]
        across = across - (across * ray).sum(axis=1, keepdims=True) * ray
        across = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        turn = edges.turn[:, [axis, axis + 2]].mean(axis=1)
        predicted += (shift[:, axis] * turn)[:, None] * across
    predicted /= np.linalg.norm(predicted, axis=1, keepdims=True)
    towards = centre[edges.body] - edges.origin
    away = np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    return np.asarray(towards / away - predicted)
