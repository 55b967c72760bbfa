"""The viewer as a program: pictures, and what is said where it cannot run."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic_result import clusters, synthetic_result
from typer.testing import CliRunner
from waiting import LIMIT, wait_for

from objslam.cli.commands import build_app
from objslam.errors import OutputError
from objslam.io.results.read import load_map
from objslam.output.viewer import application
from objslam.output.viewer.recording import write_recording


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("out")
    result, truth = synthetic_result(*clusters(), keyframes=30)
    write_recording(result, folder / "recording.rrd", truth)
    return folder


def test_a_picture_without_a_screen(out: Path, tmp_path: Path) -> None:
    try:
        application.screenshot([out / "recording.rrd"], tmp_path / "a.png", (800, 500))
    except OutputError as error:
        if "Vulkan" in str(error):
            pytest.skip(str(error))
        raise
    pixels = cv2.imread(str(tmp_path / "a.png"))
    assert pixels.shape[:2] == (500, 800)
    # the map's light page on the left, with things drawn on it
    page = (pixels[60:320, 20:400] > 245).all(axis=2)
    assert 0.4 < page.mean() < 0.99
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


def test_a_viewer_that_hangs_up_says_so(out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error after the recording is loaded is reported with its own text."""

    def hang_up(*_: object) -> None:
        raise RuntimeError("the connection was lost\nand more")

    monkeypatch.setattr(application, "_set_time", hang_up)
    with pytest.raises(OutputError) as caught:
        application.screenshot([out / "recording.rrd"], tmp_path / "a.png", (400, 300))
    if "Vulkan" in str(caught.value):
        pytest.skip(str(caught.value))
    assert str(caught.value) == f"{tmp_path / 'a.png'}: the viewer took no picture: the connection was lost"


def test_a_run_that_found_nothing_can_be_seen(tmp_path: Path) -> None:
    result, _ = synthetic_result(np.zeros((0, 3)), [], keyframes=2)
    write_recording(result, tmp_path / "a.rrd")
    try:
        application.screenshot([tmp_path / "a.rrd"], tmp_path / "a.png", (800, 500))
    except OutputError as error:
        if "Vulkan" in str(error):
            pytest.skip(str(error))
        raise
    assert cv2.imread(str(tmp_path / "a.png")).shape[:2] == (500, 800)


def test_a_panic_is_said_before_what_is_harmless() -> None:
    said = (
        b"error: XDG_RUNTIME_DIR is invalid or not set\n\nthread 'main' panicked at src/a.rs:81:\nno range\nstack backtrace:"
    )
    text = str(application._failure(102, said, None))
    assert "panicked at src/a.rs:81: no range" in text
    assert "XDG" not in text


@pytest.mark.parametrize("damage", ["cut off", "overwritten", "header", "empty", "other"])
def test_a_damaged_recording_is_said_with_its_path(out: Path, tmp_path: Path, damage: str) -> None:
    whole = (out / "recording.rrd").read_bytes()
    half = len(whole) // 2
    data = {
        "cut off": whole[:half],
        "overwritten": whole[:half] + bytes(200) + whole[half + 200 :],
        "header": whole[:12],
        "empty": b"",
        "other": b"not a recording at all" * 100,
    }[damage]
    file = tmp_path / "recording.rrd"
    file.write_bytes(data)
    with pytest.raises(OutputError) as caught:
        application.find_rrd(tmp_path)
    assert str(file) in str(caught.value)
    assert "damaged or cut off" in str(caught.value)
    assert "run again" in str(caught.value)
    file.write_bytes(whole)
    assert application.find_rrd(tmp_path) == file


def test_a_folder_without_a_result_is_told_from_a_result_without_a_recording(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"no result here: objects\.json is missing"):
        application.find_rrd(tmp_path)
    (tmp_path / "objects.json").write_text("{}", encoding="utf-8")
    with pytest.raises(OutputError, match=r"no recording here .*output\.recording=true"):
        application.find_rrd(tmp_path)


def test_results_in_folders_below_are_named(out: Path, tmp_path: Path) -> None:
    for name in ("fixed", "joint"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "summary.json").write_text("{}", encoding="utf-8")
    with pytest.raises(OutputError) as caught:
        application.find_rrd(tmp_path)
    with pytest.raises(OutputError) as loading:
        load_map(tmp_path)
    for error in (caught, loading):
        assert str(tmp_path / "fixed") in str(error.value)
        assert str(tmp_path / "joint") in str(error.value)


def test_no_driver_is_one_line(out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES", "VK_ADD_DRIVER_FILES"):
        monkeypatch.setenv(name, str(tmp_path / "none.json"))
    monkeypatch.setenv("LIBGL_DRIVERS_PATH", str(tmp_path))
    with pytest.raises(OutputError) as caught:
        application.screenshot([out / "recording.rrd"], tmp_path / "a.png", (400, 300))
    assert "Vulkan driver" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_no_screen_is_one_line(out: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")}
    done = subprocess.run(
        [sys.executable, "-m", "objslam", "view", str(out)], env=environment, capture_output=True, text=True, timeout=LIMIT
    )
    assert done.returncode == 1
    assert done.stderr.startswith("objslam: the viewer finds no screen")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["nowhere"], 1, "there is no such result folder"),
        (["{out}", "--screenshot", "a.bmp"], 2, "a picture is a PNG"),
        (["{out}", "--object", "3"], 1, "no result here"),
        (["{out}", "--web", "--screenshot", "a.png"], 2, "--web and --screenshot"),
        (["{out}", "--screenshot", "no/such/a.png"], 1, "no such folder"),
    ],
)
def test_wrong_use_is_said(out: Path, arguments: list[str], code: int, said: str) -> None:
    result = CliRunner().invoke(build_app(), ["view", *(a.format(out=out) for a in arguments)])
    assert said in str(result.exception)
    assert getattr(result.exception, "exit_code", None) == code


def test_the_web_viewer_listens_on_loopback_alone(out: Path) -> None:
    server = subprocess.Popen(
        [sys.executable, "-m", "objslam", "view", str(out), "--web"], stdout=subprocess.PIPE, text=True
    )
    try:
        assert server.stdout is not None
        address = server.stdout.readline().split()[0]
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(address.partition("?")[0], timeout=LIMIT) as page:
            assert page.status == 200
        ports = [int(address.partition("?")[0].rpartition(":")[2]), int(address.rpartition(":")[2].partition("/")[0])]
        for port in ports:
            assert listening(port) == {"127.0.0.1"}
    finally:
        server.send_signal(signal.SIGTERM)
        server.wait(LIMIT)
    for port in ports:  # and it is gone with its parent
        wait_for(lambda port=port: not listening(port))


def listening(port: int) -> set[str]:
    """The addresses that somebody listens on at a port, from the kernel's table."""
    found = set()
    for name in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{name}").read_text(encoding="ascii").splitlines()[1:]:
            local, _, state = line.split()[1:4]
            address, _, number = local.partition(":")
            if state == "0A" and int(number, 16) == port:
                raw = bytes.fromhex(address)
                found.add(socket.inet_ntoa(np.frombuffer(raw, ">u4").astype("<u4").tobytes()) if name == "tcp" else "v6")
    return found
