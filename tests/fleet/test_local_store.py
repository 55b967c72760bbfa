"""A store on a disk: what is on the disk at which moment, and what a write costs where many files are."""

import os
from pathlib import Path

import pytest

from objslam.fleet.stores.local_store import LocalStore
from objslam.fleet.stores.store import StoreError


def test_a_result_is_on_the_disk_before_its_record(tmp_path, monkeypatch):
    """Otherwise a power cut may leave the record of a result whose files are empty."""
    synced = []
    real = os.fsync

    def fsync(handle):
        synced.append(os.fstat(handle).st_ino)
        real(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    result = tmp_path / "made"
    result.mkdir()
    for name in ("objects.json", "rays.parquet"):
        (result / name).write_text(name)
    store = LocalStore(tmp_path / "store")
    assert store.upload(result, "results/key") == ["objects.json", "rays.parquet"]
    there = tmp_path / "store" / "results" / "key"
    assert sorted(file.name for file in there.iterdir()) == [file.read_text() for file in sorted(there.iterdir())]
    assert {file.stat().st_ino for file in (*there.iterdir(), there)} <= set(synced)
    assert synced[-1] == there.stat().st_ino  # The names of the files come last.


def test_a_write_does_not_list_a_folder_of_many_files(tmp_path, monkeypatch):
    store = LocalStore(tmp_path)
    store.write("seen/a.done", b"")
    for name in ("iterdir", "glob", "rglob"):
        monkeypatch.setattr(Path, name, lambda *_: pytest.fail("lists a folder"))
    for name in ("scandir", "listdir"):
        monkeypatch.setattr(os, name, lambda *_: pytest.fail("lists a folder"))
    store.write("seen/b.done", b"1")
    monkeypatch.undo()
    assert (store.names("seen"), store.read("seen/b.done")) == (["a.done", "b.done"], b"1")


def test_what_a_killed_process_left_is_no_file_of_the_store(tmp_path):
    store = LocalStore(tmp_path)
    store.write("seen/a.done", b"")
    (tmp_path / "seen" / ".b.done.0-1").touch()
    assert store.names("seen") == ["a.done"]


def test_an_upload_that_the_disk_refuses_says_where(tmp_path, monkeypatch):
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "objects.json").write_text("1")

    def full(*_):
        raise OSError(28, "No space left on device", str(tmp_path / "store" / "results"))

    monkeypatch.setattr("shutil.copyfile", full)
    with pytest.raises(StoreError, match=r"store/results: .*No space left on device"):
        LocalStore(tmp_path / "store").upload(tmp_path / "made", "results/key")
    assert list((tmp_path / "store" / "results" / "key").iterdir()) == []
    (tmp_path / "store" / "records" / "b.json").mkdir(parents=True)
    with pytest.raises(StoreError, match=r"records/b\.json: "):
        LocalStore(tmp_path / "store").write("records/b.json", b"1")
