"""Make priors of bodies from the apparent size of each object, from other objects of its label, and from known sizes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.bodies.body import UNKNOWN_YAW
from objslam.triangulation.bodies.fit import Prior
from objslam.triangulation.bodies.shapes import PARAMETERS

_POSITION = 20.0
"""The standard deviation (m) of a centre around the triangulated point. With a larger value, boxes decide more about the
centre."""
_SIZE = 0.7
"""The standard deviation of the logarithm of a half axis around the logarithm of its apparent value. 0.7 is a factor of 2.
With a larger value, an object that is seen from one side may become very deep or flat."""
_ASPECT = 0.35
"""The standard deviation of the two aspect parameters q and s of ellipsoids. With 0.35, the median ratio of the horizontal
half axes is 2.3. A larger value allows longer objects."""
_DOT = 1e-4
"""The half axes (m) of an ellipsoid that represents a point, far below the size of any object."""
_LIKE = 2.0
"""The number of bodies of a label from which the spread of their sizes weighs as much as `_SIZE` and `_ASPECT`. A larger
number trusts the label less."""
_LEAST = 0.1
"""The least standard deviation of the logarithm of a half axis in the prior of a label. A known size has the same one. A
larger value trusts the label less."""
_UNTOLD = 1e-3
"""The least reliability of a size, as a share. It prevents a division by zero for sizes that boxes do not show. Such sizes
have next to no weight. A larger share gives them more weight."""
_TIE = 1e-3
"""The standard deviation of the differences between the logarithms of a sphere's half axes. It is practically 0, because the
half axes of a sphere are equal. A larger value allows flatter spheres."""


def weak_prior(points: Floats, half: Floats) -> Prior:
    """Return the prior of ellipsoids at points (N, 3), m, with the apparent half axes (N, 2), m, across and upwards."""
    count, log = len(points), np.log(half)
    mean = np.column_stack([points, log[:, 0], np.zeros((count, 2)), log[:, 1]])
    sigma = np.array([*[_POSITION] * 3, _SIZE, _ASPECT, _ASPECT, _SIZE])
    return Prior(mean, np.tile(np.diag(sigma**-2), (count, 1, 1)))


def label_prior(weak: Prior, fitted: Prior, values: Floats, covariance: Floats, label: Ints, cuboid: Bools) -> Prior:
    """Return the prior that the bodies of each label have in common (empirical Bayes; Efron and Morris 1973).

    Boxes from one side leave a half axis open. This half axis gets the value that the prior of its fit says, and such a
    value is no measurement. So each value counts with its reliability: the share of its information that comes from boxes.
    An example is a label of flat things, such as doors, that were all seen at an angle. Their boxes do not show that they
    are flat. Without the reliability, all would count as round.

    The result is for ellipsoids. A label with one body, and the label -1, keep the prior `weak`. fitted: the prior of the
    fit, for ellipsoids. values, covariance: (N, 7) and (N, 7, 7), the fitted bodies. label: (N,). cuboid: (N,) a mask of the
    bodies that are cuboids.
    """
    mean, variance = weak.mean.copy(), 1 / np.einsum("nii->ni", weak.information).copy()
    spread = np.einsum("nii->ni", covariance)
    reliable = np.clip(1 - np.einsum("nii->ni", fitted.information) * spread, 0.0, 1.0)
    for one in np.unique(label):
        mine = np.flatnonzero(label == one)
        if one < 0 or len(mine) < 2:
            continue
        for at in (3, 6):
            share, before = np.maximum(reliable[mine, at], _UNTOLD), fitted.mean[mine, at]
            # The value and its noise by the boxes alone, without the prior of the fit.
            own, noise = before + (values[mine, at] - before) / share, spread[mine, at] / share
            number = share.sum()
            common = (share * own).sum() / number
            between = max(float((share * ((own - common) ** 2 - noise)).sum() / number), 0.0)
            between = max((number * between + _LIKE * _SIZE**2) / (number + _LIKE), _LEAST**2)
            weight = 1 / (noise + between)
            common = (weight * own).sum() / weight.sum()
            told = number / (number + _LIKE)
            mean[mine, at] = told * common + (1 - told) * weak.mean[mine, at]
            variance[mine, at] = between + told * min(1 / weight.sum(), _SIZE**2)
        aspect, share = values[mine, 4:6] ** 2, reliable[mine, 4:6]
        squares, number = aspect - share * spread[mine, 4:6], share**2
        # A cuboid has one aspect parameter, q, and a yaw.
        squares = np.where(cuboid[mine], squares[:, 0] / 2, squares.mean(axis=1))
        number = np.where(cuboid[mine], number[:, 0], number.mean(axis=1)).sum()
        own = max(float(squares.sum()), 0.0)
        variance[mine, 4:6] = max((own + _LIKE * _ASPECT**2) / (number + _LIKE), _LEAST**2)
    information = np.zeros_like(weak.information)
    information[:, range(PARAMETERS), range(PARAMETERS)] = 1 / variance
    return Prior(mean, information)


def known_sizes(
    prior: Prior, values: Floats, names: tuple[str, ...], sizes: Mapping[str, tuple[float, float, float]]
) -> Prior:
    """Return the prior of ellipsoids with known sizes of labels.

    The yaw of a body stays free. Only its aspect is drawn towards the known aspect, at the yaw that the fit has found.
    values: (N, 7) the fitted ellipsoids. names: the label of each body. sizes: length, width and height, m, by label.
    """
    mean, information = prior.mean.copy(), prior.information.copy()
    for body, name in enumerate(names):
        if name not in sizes:
            continue
        length, width, height = *sorted(sizes[name][:2], reverse=True), sizes[name][2]
        aspect = 0.5 * np.log(length / width)
        towards = values[body, 4:6] if np.linalg.norm(values[body, 4:6]) > _TIE else np.array([1.0, 0.0])
        towards = towards / np.linalg.norm(towards)
        mean[body, 3:] = 0.5 * np.log(length * width / 4), *(aspect * towards), np.log(height / 2)
        information[body, [3, 6], [3, 6]] = _LEAST**-2
        information[body, 4:6, 4:6] = np.outer(towards, towards) / _LEAST**2 + np.eye(2) / _ASPECT**2
    return Prior(mean, information)


def sphere_prior(prior: Prior) -> Prior:
    """Return the prior of spheres. It keeps the three half axes of a body equal."""
    information = prior.information.copy()
    information[:, [4, 5], [4, 5]] += _TIE**-2
    tie = np.zeros(PARAMETERS)
    tie[[3, 6]] = 1.0, -1.0
    mean = prior.mean.copy()
    mean[:, 4:6] = 0.0
    # The tie makes the horizontal and the upward half axis equal. The mean of both follows from their two priors.
    precision = information[:, [3, 6], [3, 6]]
    common = (precision * mean[:, [3, 6]]).sum(axis=1) / precision.sum(axis=1)
    mean[:, 3] = mean[:, 6] = common
    return Prior(mean, information + np.outer(tie, tie) / _TIE**2)


def cuboid_prior(prior: Prior, start: Floats) -> Prior:
    """Return the prior of cuboids with the sizes and aspects of a prior of ellipsoids.

    start: (N, 7) cuboids whose yaws are the means of the prior.
    """
    mean, information = prior.mean.copy(), prior.information.copy()
    towards = np.stack([np.cos(2 * start[:, 5]), np.sin(2 * start[:, 5])], axis=1)
    mean[:, 4], mean[:, 5] = (prior.mean[:, 4:6] * towards).sum(axis=1), start[:, 5]
    aspect = np.einsum("ni,nij,nj->n", towards, prior.information[:, 4:6, 4:6], towards)
    information[:, 4:6, 4:6] = aspect[:, None, None] * np.diag([1.0, 0.0]) + np.diag([0.0, UNKNOWN_YAW**-2])
    return Prior(mean, information)


def dot_prior(prior: Prior) -> Prior:
    """Return the prior of points. They are ellipsoids with half axes of `_DOT` m."""
    mean, information = prior.mean.copy(), prior.information.copy()
    mean[:, 3:] = np.log(_DOT), 0.0, 0.0, np.log(_DOT)
    information[:, 3:, 3:] = _TIE**-4 * np.eye(4)
    return Prior(mean, information)


def apparent_half_axes(width: Floats, height: Floats) -> Floats:
    """Return the apparent half axes (N, 2), m, across and upwards, from apparent widths (N,) and heights (N,), m."""
    return np.maximum(np.column_stack([width, height]) / 2, 1e-3)
