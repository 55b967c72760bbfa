"""Maps of one place in two frames, and of different places, to be registered."""

import numpy as np

from objslam.association.place_recognition import Constellation
from objslam.core.geometry import lift_se2
from objslam.core.maps.shared_covariance import NUMBERS, jacobian

SIGMA = 0.05  # m
DENSITY = 0.25  # objects per m^2


def of(points, labels):
    return Constellation(points, np.tile(SIGMA**2 * np.eye(3), (len(points), 1, 1)), labels)


def bent(rng, one, shared):
    """A map with an error that all its objects share, drawn from its covariance (7, 7). The covariances contain it."""
    lever = jacobian(one.position)
    error = np.linalg.cholesky(shared + 1e-18 * np.eye(NUMBERS)) @ rng.normal(size=NUMBERS)
    spread = one.covariance + lever @ shared @ np.swapaxes(lever, 1, 2)
    return Constellation(one.position + lever @ error, spread, one.label)


def place(rng, count, labels, density=DENSITY):
    """Objects scattered in a square, up to 2 m high."""
    side = np.sqrt(count / density)
    return np.column_stack([rng.uniform(0, side, (count, 2)), rng.uniform(0, 2, count)]), rng.integers(0, labels, count)


def twins(rng, count, labels, overlap, changed=0.2):
    """Two maps of `count` objects whose areas overlap by a share, a fifth of the objects changed, 5 cm of noise in each.

    Returns the maps a and b, b_T_a, and the pairs (P, 2) of objects that both have.
    """
    side = np.sqrt(count / DENSITY)
    whole = round(count * (2 - overlap))
    points = np.column_stack(
        [rng.uniform(0, side * (2 - overlap), whole), rng.uniform(0, side, whole), rng.uniform(0, 2, whole)]
    )
    kind = rng.integers(0, labels, whole)
    new, new_kind = points.copy(), kind.copy()
    moved = rng.random(whole) < changed
    new[moved] = np.column_stack(
        [
            rng.uniform(0, side * (2 - overlap), moved.sum()),
            rng.uniform(0, side, moved.sum()),
            rng.uniform(0, 2, moved.sum()),
        ]
    )
    new_kind[moved] = rng.integers(0, labels, moved.sum())
    in_a, in_b = points[:, 0] <= side, new[:, 0] >= side * (1 - overlap)
    b_T_a = lift_se2(np.array([*rng.uniform(-50, 50, 2), rng.uniform(-np.pi, np.pi)]))
    b_T_a[2, 3] = rng.uniform(-1, 1)
    seen = points[in_a] + rng.normal(0, SIGMA, (in_a.sum(), 3))
    back = np.linalg.inv(b_T_a)
    a = of(seen @ back[:3, :3].T + back[:3, 3], kind[in_a])
    b = of(new[in_b] + rng.normal(0, SIGMA, (in_b.sum(), 3)), new_kind[in_b])
    both = in_a & in_b & ~moved
    return a, b, b_T_a, np.column_stack([np.cumsum(in_a)[both] - 1, np.cumsum(in_b)[both] - 1])


def groups(rng, count, each, labels, spacing=0.18, sigma=0.04):
    """Rows of equal objects, such as chairs at tables, scattered in a plane: a chance match of one brings others along."""
    side, points = np.sqrt(count / 0.2), []
    for centre in rng.uniform(0, side, (count, 2)):
        step, turn = spacing * (np.arange(each) - (each - 1) / 2), rng.uniform(0, np.pi)
        row = centre + step[:, None] * [np.cos(turn), np.sin(turn)]
        points.append(np.column_stack([row, np.zeros(each)]))
    spread = np.array([sigma, sigma, 0.3 * sigma])
    at = np.concatenate(points) + spread * rng.normal(size=(count * each, 3))
    label = np.repeat(rng.integers(0, labels, count), each)
    return Constellation(at, np.tile(np.diag(spread**2), (len(at), 1, 1)), label)


def rooms(rng):
    """One room of twelve objects, and three rooms just like it in a row."""
    points, labels = place(rng, 12, 4, density=0.6)
    three = np.concatenate([points + np.array([8.0 * k, 0, 0]) for k in range(3)])
    return points, labels, three + rng.normal(0, SIGMA, three.shape), np.tile(labels, 3)


def errors(found, truth, points):
    """How far b_T_a is off at the middle of points (N, 3), m, and in yaw, rad."""
    middle = points.mean(axis=0)
    shift = np.linalg.norm(found[:3, :3] @ middle + found[:3, 3] - truth[:3, :3] @ middle - truth[:3, 3])
    off = np.linalg.inv(truth) @ found
    return float(shift), float(abs(np.arctan2(off[1, 0], off[0, 0])))
