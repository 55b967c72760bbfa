"""A run asks nothing of a network: its models are shipped and its names are local."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest

from objslam.cli import main
from objslam.results.read import load_summary


def test_the_demo_connects_to_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fixed and joint, with recording and picture. An attempt counts even if the code survives its failure."""
    attempts: list[object] = []

    def refuse(name: str) -> object:
        def call(*arguments: object, **more: object) -> None:
            attempts.append((name, arguments[-1:]))
            raise OSError(101, "Network is unreachable")

        return call

    for name in ("connect", "connect_ex", "sendto"):
        monkeypatch.setattr(socket.socket, name, refuse(name))
    monkeypatch.setattr(socket, "getaddrinfo", refuse("getaddrinfo"))
    with pytest.raises(OSError, match="unreachable"):
        socket.create_connection(("127.0.0.1", 9))
    assert len(attempts) == 1
    monkeypatch.setattr(sys, "argv", ["objslam", "demo", "--boxes", "-o", str(tmp_path / "demo")])
    with pytest.raises(SystemExit) as exit_:
        main()
    assert exit_.value.code == 0
    assert {load_summary(tmp_path / "demo" / mode)["mode"] for mode in ("fixed", "joint")} == {"fixed", "joint"}
    assert (tmp_path / "demo" / "joint" / "recording.rrd").is_file()
    assert len(attempts) == 1
