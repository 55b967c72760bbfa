"""Objects and maps in one linear system, against the dense matrix: few maps, and more maps than objects."""

import numpy as np
import pytest

from objslam.association.registration.arrow_system import ArrowSystem


def dense(system):
    """The whole matrix, objects first."""
    (maps, width), count = system.maps.shape[:2], len(system.objects)
    whole = np.zeros((3 * count + maps * width,) * 2)
    for k, block in enumerate(system.objects):
        whole[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = block
    for s, block in enumerate(system.maps):
        at = 3 * count + s * width
        whole[at : at + width, at : at + width] = block
    for pull, k, s in zip(system.pull, system.object, system.map, strict=True):
        at = 3 * count + s * width
        whole[3 * k : 3 * k + 3, at : at + width] = -pull
        whole[at : at + width, 3 * k : 3 * k + 3] = -pull.T
    return whole


def drawn(rng, count, maps, width):
    """Normal equations of random measurements with residuals of object - lever @ map."""
    pairs = [(s, k) for s in range(maps) for k in np.sort(rng.choice(count, min(count, 6), replace=False)).tolist()]
    map_, object_ = np.array(pairs).T
    lever = rng.normal(size=(len(pairs), 3, width))
    root = rng.normal(size=(len(pairs), 3, 3)) + 2 * np.eye(3)
    information = root @ np.swapaxes(root, 1, 2)
    objects, own = np.zeros((count, 3, 3)), np.tile(np.eye(width), (maps, 1, 1))
    np.add.at(objects, object_, information)
    np.add.at(own, map_, np.swapaxes(lever, 1, 2) @ information @ lever)
    objects += np.eye(3)
    return ArrowSystem(objects, own, information @ lever, object_, map_)


@pytest.mark.parametrize(("count", "maps", "width"), [(30, 2, 11), (8, 9, 4), (5, 12, 11), (12, 3, 12)])
def test_step_and_covariances_are_those_of_the_dense_matrix(count, maps, width):
    rng = np.random.default_rng(count)
    system = drawn(rng, count, maps, width)
    whole, gradient = dense(system), rng.normal(size=(maps, width))
    right = np.concatenate([np.zeros(3 * count), gradient.ravel()])
    np.testing.assert_allclose(
        system.step(gradient).ravel(), np.linalg.solve(whole, right)[3 * count :], rtol=1e-6, atol=1e-9
    )
    inverse = np.linalg.inv(whole)
    own, factor, blocks = system.covariances()
    joint = np.einsum("iam,jbm->iajb", factor, factor)
    joint[np.arange(count), :, np.arange(count), :] += own
    np.testing.assert_allclose(joint.reshape(3 * count, -1), inverse[: 3 * count, : 3 * count], atol=1e-8)
    np.testing.assert_allclose(own, np.linalg.inv(system.objects), atol=1e-9)
    for s in range(maps):
        at = slice(3 * count + s * width, 3 * count + (s + 1) * width)
        np.testing.assert_allclose(blocks[s], inverse[at, at], atol=1e-8)


def test_a_map_that_no_object_ties_stays_where_it_is():
    rng = np.random.default_rng(0)
    for maps in (3, 12):
        system = drawn(rng, 8, maps, 4)
        loose = ArrowSystem(
            system.objects,
            np.where(np.arange(maps)[:, None, None] == 1, 0.0, system.maps),
            np.where((system.map == 1)[:, None, None], 0.0, system.pull),
            system.object,
            system.map,
        )
        gradient = rng.normal(size=(maps, 4))
        gradient[1] = 0.0
        step = loose.step(gradient)
        assert np.isfinite(step).all()
        assert np.abs(step[1]).max() < 1e-9
