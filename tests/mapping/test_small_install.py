"""What works where torch and Open3D are not installed: everything but CUDA, rendering and reconstruction."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest

from objslam.core.array_module import array_backend
from objslam.errors import ConfigError, ObjslamError
from objslam.triangulation.triangulate import solve_eq1


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A Python without torch and Open3D."""
    find = importlib.util.find_spec
    for name in ("torch", "open3d"):
        monkeypatch.setitem(sys.modules, name, None)  # an import of it fails
    missing = {"torch", "open3d"}
    for module in (importlib.util, sys.modules["objslam.core.array_module"]):
        monkeypatch.setattr(module, "find_spec", lambda name, *rest: None if name in missing else find(name, *rest))


def backend(device: str, *, large: bool) -> str:
    with array_backend(device, large) as chosen:
        return chosen


@pytest.mark.usefixtures("small")
def test_a_large_batch_runs_in_numpy() -> None:
    assert [backend(device, large=large) for device in ("auto", "cpu") for large in (False, True)] == ["numpy"] * 4
    with pytest.raises(ConfigError, match="needs torch"):
        backend("cuda", large=True)


def test_numpy_places_objects_as_torch_does(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    rng = np.random.default_rng(0)
    objects = np.repeat(np.arange(40), 30)
    points = rng.uniform(-3, 3, (40, 3))
    origins = rng.uniform(-5, 5, (len(objects), 3))
    directions = points[objects] - origins + 0.01 * rng.normal(size=origins.shape)
    monkeypatch.setattr("objslam.triangulation.triangulate._LARGE", 1)
    by_torch = solve_eq1(origins, directions, objects, 40)[0]
    request.getfixturevalue("small")
    by_numpy = solve_eq1(origins, directions, objects, 40)[0]
    np.testing.assert_allclose(by_numpy, by_torch, atol=1e-6)
    np.testing.assert_allclose(by_numpy, points, atol=0.05)


@pytest.mark.usefixtures("small")
def test_a_drive_cannot_be_rendered_and_the_error_says_what_to_install() -> None:
    from objslam.simulation.raycast import _open3d

    with pytest.raises(ObjslamError, match=r'Open3D.*pip install "objslam\[open3d\]".*demo --boxes'):
        _open3d()
