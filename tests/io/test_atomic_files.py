"""Files that are written whole or not at all: what a kill, a file system without locks and other files leave of that."""

from __future__ import annotations

import itertools
import os
import resource
from collections.abc import Callable
from pathlib import Path

import pytest
from faults import contents, in_child, killed_at

from objslam.errors import OutputError
from objslam.io import atomic_files
from objslam.io.atomic_files import FileSet, encode, has_staging, is_cut_short, replace_files, try_folder, write_file

FILES = FileSet("seal", ("first", "second", "rarely"), "*.part")


def write_set(folder: Path, names: tuple[str, ...], data: bytes) -> tuple[str, ...]:
    def writer(name: str) -> Callable[[Path], object]:
        return lambda file: file.write_bytes(name.encode() + data)

    return replace_files(folder, FILES, {name: writer(name) for name in names})


def test_a_set_is_named_seal_first_with_those_whose_names_are_not_known_beforehand(tmp_path: Path) -> None:
    for name in ("b.part", "a.part", "a.other", "second"):
        (tmp_path / name).write_text("")
    assert FILES.names(tmp_path) == ("seal", "first", "second", "rarely", "a.part", "b.part")


def test_a_set_goes_as_a_whole_and_other_files_stay(tmp_path: Path) -> None:
    try_folder(tmp_path / "deep" / "out", FILES)
    out = tmp_path / "deep" / "out"
    assert list(out.iterdir()) == []
    assert write_set(out, ("first", "rarely", "a.part", "seal"), b" 1") == ()
    (out / "mine").write_bytes(b"mine")
    assert set(write_set(out, ("seal", "first", "second", "b.part"), b" 2")) == {"rarely", "a.part"}
    new = {name: name.encode() + b" 2" for name in ("seal", "first", "second", "b.part")}
    assert contents(out) == new | {"mine": b"mine"}
    assert not has_staging(out)


@pytest.mark.forks
def test_killed_at_any_moment_the_seal_stands_for_the_whole_set(tmp_path: Path) -> None:
    old, new = ("first", "second", "a.part", "seal"), ("seal", "first", "rarely", "b.part", "c.part")
    was, will_be = ({name: name.encode() + data for name in names} for names, data in ((old, b" 1"), (new, b" 2")))
    seen = set()
    for step in itertools.count():
        out = tmp_path / f"out{step}"
        out.mkdir()
        write_set(out, old, b" 1")
        code = in_child(killed_at(step, lambda out=out: write_set(out, new, b" 2")))  # type: ignore[misc]
        found = contents(out)
        assert found.items() <= was.items() or found.items() <= will_be.items(), f"a mix after step {step}: {found}"
        assert "seal" not in found or found in (was, will_be), f"the seal on a part of a set after step {step}: {found}"
        seen.add("old" if found == was else "new" if found == will_be else "part")
        assert ("seal" in found) != is_cut_short(out, FILES)
        try_folder(out, FILES)  # a set that was cut short goes, a whole one stays
        assert contents(out) == (found if "seal" in found else {})
        assert not has_staging(out)
        if code == 0:
            break
        assert code == -9
    assert seen == {"old", "part", "new"}


def test_a_writer_that_fails_leaves_the_old_set(tmp_path: Path) -> None:
    write_set(tmp_path, ("seal", "first"), b" 1")
    before = contents(tmp_path)

    def refuse(file: Path) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match="No space left on device") as caught:
        replace_files(tmp_path, FILES, {"first": lambda file: file.write_bytes(b"new"), "seal": refuse})
    assert caught.value.where == str(tmp_path)
    assert contents(tmp_path) == before
    assert not has_staging(tmp_path)


def test_a_swap_that_the_disk_breaks_off_leaves_a_sign_of_whose_the_rest_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_set(tmp_path, ("seal", "first"), b" 1")

    def refuse(*_: object) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", refuse)
        with pytest.raises(OutputError, match="Input/output error"):
            write_set(tmp_path, ("seal", "first"), b" 2")
    assert is_cut_short(tmp_path, FILES)
    write_set(tmp_path, ("seal",), b" 3")
    assert contents(tmp_path) == {"seal": b"seal 3"}


def test_a_folder_that_cannot_be_locked_or_synced_still_serves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unsupported(*_: object) -> None:
        raise OSError(22, "Invalid argument")

    monkeypatch.setattr(atomic_files.fcntl, "flock", unsupported)
    monkeypatch.setattr(atomic_files, "_write", lambda file, data: file.write_bytes(data))
    monkeypatch.setattr(atomic_files.os, "fsync", unsupported)
    write_set(tmp_path, ("seal", "first"), b" 1")
    assert contents(tmp_path) == {"seal": b"seal 1", "first": b"first 1"}


def test_write_file_replaces_at_once(tmp_path: Path) -> None:
    file = tmp_path / "evaluation.json"
    write_file(file, b"old")
    for step in range(20):
        code = in_child(killed_at(step, lambda: write_file(file, b"new")))
        assert file.read_bytes() in (b"old", b"new")
        if code == 0:
            break
    assert file.read_bytes() == b"new"
    assert contents(tmp_path) == {"evaluation.json": b"new"}  # The files of the killed processes are gone.
    with pytest.raises(OutputError, match="No such file") as caught:
        write_file(tmp_path / "none" / "x.json", b"")
    assert caught.value.where == str(tmp_path / "none" / "x.json")  # not the temporary name


def test_write_file_leaves_the_old_file_on_a_full_disk(tmp_path: Path) -> None:
    file = tmp_path / "evaluation.json"
    write_file(file, b"old")

    def work() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2, 2))
        write_file(file, b"new")

    assert in_child(work) == 3
    assert contents(tmp_path) == {"evaluation.json": b"old"}


def test_text_that_no_file_can_hold_is_named() -> None:
    assert encode("caf\u00e9") == b"caf\xc3\xa9"
    with pytest.raises(OutputError, match=r"surrogate.*near 'so far good\\ud800'"):
        encode("so far good\ud800 and on")
