import os

import numpy as np
import pytest

from objslam.core.diagnostics import Ledger
from objslam.core.types import Images
from objslam.errors import LogError
from objslam.io.image_list import read_images, write_images


@pytest.fixture
def folder(tmp_path):
    log = tmp_path / "log"
    (log / "rgb").mkdir(parents=True)
    for name in ("a.png", "b.png", "with space.png", "#c.png"):
        (log / "rgb" / name).touch()
    (tmp_path / "secret.png").touch()
    return log


def _read(folder, text):
    (folder / "rgb.txt").write_text(text)
    ledger = Ledger()
    return read_images(folder / "rgb.txt", ledger), ledger


def test_a_list_is_read(folder):
    images, ledger = _read(folder, "# comment\n1.5 rgb/a.png\n2.5\trgb/with space.png\r\n3 ./rgb/#c.png \n")
    assert images.stamps.tolist() == [1.5, 2.5, 3.0]
    assert [path.relative_to(folder).as_posix() for path in images.paths] == [
        "rgb/a.png",
        "rgb/with space.png",
        "rgb/#c.png",
    ]
    assert not ledger.lines()


def test_written_lists_read_back(folder):
    paths = tuple(folder / "rgb" / name for name in ("a.png", "with space.png", "#c.png"))
    images = Images(np.array([0.1, 1 / 3, 1341847980.722988]), paths)
    write_images(images, folder / "rgb.txt")
    read = read_images(folder / "rgb.txt", Ledger())
    assert read.paths == images.paths
    assert np.array_equal(read.stamps, images.stamps)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("2.0", 'rgb.txt line that is not "stamp path"'),
        ("two rgb/b.png", 'rgb.txt line that is not "stamp path"'),
        ("nan rgb/b.png", 'rgb.txt line that is not "stamp path"'),
        ("2 /etc/passwd", "rgb.txt line whose file leaves the folder"),
        ("2 ../secret.png", "rgb.txt line whose file leaves the folder"),
        ("2 rgb/../../secret.png", "rgb.txt line whose file leaves the folder"),
        ("2 link.png", "rgb.txt line whose file leaves the folder"),
        ("2 outside/secret.png", "rgb.txt line whose file leaves the folder"),
        ("2 .", "rgb.txt line whose file leaves the folder"),
        ("2 rgb/missing.png", "rgb.txt line whose file is missing"),
        ("2 missing/b.png", "rgb.txt line whose file is missing"),
        ("2 rgb/b.png/c.png", "rgb.txt line whose file is missing"),
        ("2 dangling.png", "rgb.txt line whose file is missing"),
        ("2 loop.png", "rgb.txt line whose file is missing"),
        ("2 rgb/b.png\0", "rgb.txt line whose file is missing"),
        ("2 " + "x" * 5000, "rgb.txt line whose file is missing"),
        ("2 rgb", "rgb.txt line whose file is not a regular file"),
        ("2 pipe", "rgb.txt line whose file is not a regular file"),
        ("1 rgb/b.png", "rgb.txt line with a stamp that repeats or goes back"),
        ("0.5 rgb/b.png", "rgb.txt line with a stamp that repeats or goes back"),
    ],
)
def test_bad_lines_are_dropped_and_named(folder, line, reason):
    (folder / "link.png").symlink_to(folder.parent / "secret.png")
    (folder / "outside").symlink_to(folder.parent)
    (folder / "dangling.png").symlink_to(folder / "nothing.png")
    (folder / "loop.png").symlink_to("loop.png")
    os.mkfifo(folder / "pipe")
    images, ledger = _read(folder, f"1 rgb/a.png\n{line}\n3 rgb/b.png\n")
    assert images.stamps.tolist() == [1.0, 3.0]
    assert ledger.dropped == {reason: 1}
    assert ledger.examples[reason] == [f"{folder / 'rgb.txt'}:2"]


def test_links_that_stay_inside_are_followed(folder):
    (folder / "link.png").symlink_to("rgb/a.png")
    (folder / "more").symlink_to("rgb")
    images, ledger = _read(folder, "1 link.png\n2 more/b.png\n")
    assert len(images.paths) == 2
    assert not ledger.lines()


def test_a_folder_reached_through_a_link_is_itself_fine(folder, tmp_path):
    (tmp_path / "alias").symlink_to(folder)
    images, ledger = _read(tmp_path / "alias", "1 rgb/a.png\n")
    assert images.paths == (tmp_path / "alias" / "rgb" / "a.png",)
    assert not ledger.lines()


def test_images_behind_a_link_are_refused_with_the_remedy(folder, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "a.png").write_bytes(b"")
    (folder / "linked").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(LogError, match="leads to an image") as caught:
        _read(folder, "1 linked/a.png\n")
    assert "cp -rl" in caught.value.hint


@pytest.mark.parametrize("text", ["", "# nothing\n", "1 missing.png\n"])
def test_no_image_left(folder, text):
    with pytest.raises(LogError, match=r"nothing in it|leads to an image") as caught:
        _read(folder, text)
    assert caught.value.where == str(folder / "rgb.txt")
