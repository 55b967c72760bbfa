"""objslam demo, without and with images. It asks nothing of a network: its models are shipped and its names are local."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from commands import Call
from small_log import small_log

from objslam import simulation
from objslam.cli import demo
from objslam.cli.options import settings_of
from objslam.simulation import render
from objslam.simulation.render import RenderSettings
from objslam.sources.log_folder import write_log_folder

Objslam = Callable[..., Call]
FEW_DEPTHS = "reconstruction.stride=8"


@pytest.fixture
def attempts(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """The attempts to connect to something. Each fails, and counts even if the code survives its failure."""
    found: list[object] = []

    def refuse(name: str) -> object:
        def call(*arguments: object, **more: object) -> None:
            found.append((name, arguments[-1:]))
            raise OSError(101, "Network is unreachable")

        return call

    for name in ("connect", "connect_ex", "sendto"):
        monkeypatch.setattr(socket.socket, name, refuse(name))
    monkeypatch.setattr(socket, "getaddrinfo", refuse("getaddrinfo"))
    with pytest.raises(OSError, match="unreachable"):
        socket.create_connection(("127.0.0.1", 9))
    assert len(found) == 1
    found.clear()
    return found


def test_demo(objslam: Objslam, attempts: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulation, "preset", partial(simulation.preset, frames=130))  # A third of them tells as much here.
    write_log_folder(small_log(), tmp_path / "demo" / "log")
    (tmp_path / "demo" / ".objslam-demo").touch()  # The log of an older demo may be replaced.
    done = objslam("demo", "-o", tmp_path / "demo", "--boxes", "--seed", 1)
    assert done.code == 0, done.err
    assert attempts == []
    assert done.out.count("position RMSE") == 2
    for mode in ("fixed", "joint"):
        out = tmp_path / "demo" / mode
        assert json.loads((out / "summary.json").read_text())["mode"] == mode
        assert (out / "map.png").is_file()
        assert (out / "recording.rrd").is_file()
        found = json.loads((out / "evaluation.json").read_text())
        assert found["recall"] > 0.8
        assert found["position_median"] < 0.1


def test_a_demo_replaces_no_log_of_others(objslam: Objslam, tmp_path: Path) -> None:
    write_log_folder(small_log(), tmp_path / "log")
    before = (tmp_path / "log" / "camera.yaml").read_bytes()
    done = objslam("demo", "-o", tmp_path, "--boxes")
    assert done.code == 1
    done.says("not from a demo", "-o")
    assert (tmp_path / "log" / "camera.yaml").read_bytes() == before


@pytest.mark.long
def test_demo_from_images(objslam: Objslam, attempts: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole way: rendered images, the shipped detector, both modes. The bars are those that the README promises.

    A quarter of the images have to meet them too, because rendering takes most of the time. An object then needs to be in a
    quarter as many, so that the room is that of the whole demo. The objects do not depend on the surface, so it is made of
    fewer depth images.
    """
    monkeypatch.setattr(render, "RenderSettings", partial(RenderSettings, frames=48, min_views=4))
    monkeypatch.setattr(demo, "settings_of", lambda mode, file, told: settings_of(mode, file, [*told, FEW_DEPTHS]))
    done = objslam("demo", "-o", tmp_path / "demo")
    assert done.code == 0, done.err
    assert attempts == []
    for mode, bar in (("fixed", 0.05), ("joint", 0.10)):
        found = json.loads((tmp_path / "demo" / mode / "evaluation.json").read_text())
        assert (found["matched"], found["missed"], found["false"]) == (7, 0, 0)
        assert found["position_rmse"] <= bar
        assert (tmp_path / "demo" / mode / "detections.jsonl").is_file()
        assert (tmp_path / "demo" / mode / "reconstruction.ply").is_file()
