"""What works where torch and Open3D are not installed: everything but CUDA, rendering and reconstruction."""

from __future__ import annotations

import importlib.util
import sys

import pytest

from objslam.core.array_module import array_backend
from objslam.errors import ConfigError, ObjslamError


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


@pytest.mark.usefixtures("small")
def test_a_drive_cannot_be_rendered_and_the_error_says_what_to_install() -> None:
    from objslam.simulation.raycast import _open3d

    with pytest.raises(ObjslamError, match=r'Open3D.*pip install "objslam\[open3d\]".*demo --boxes'):
        _open3d()
