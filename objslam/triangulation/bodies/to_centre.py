"""Directions to the centres of bodies, from the boxes that show them."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Floats
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.residuals import Residuals, whole_axes


def shifts_of(edges: BoxEdges, found: Residuals) -> Floats:
    """Return by how much predicted boxes lie to the right of the measured ones and below them (B, 2), px.

    If one edge of an axis is a bound, the other edge gives the shift. Two bounds give no shift, so it is 0.
    """
    low, high, both = edges.bound[:, :2], edges.bound[:, 2:], found.value[:, :4]
    by_one_edge = np.where(high, np.where(low, 0.0, -both[:, :2]), both[:, 2:])
    return np.where(whole_axes(edges)[:, :2], both[:, :2], by_one_edge)


def directions_to_centres(edges: BoxEdges, centre: Floats, shift: Floats) -> Floats:
    """Return unit directions (B, 3) to the centres (N, 3), m, of bodies, minus the unit directions to the centres of
    predicted boxes.

    shift: (B, 2) px, by how much the predicted box lies to the right of the detected one, and below it.
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
