import gzip
import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.io.text import count_drops, in_order, parse_numbers, read_bytes, read_lines, read_table


@pytest.mark.parametrize(
    ("stamps", "kept"),
    [
        ([], []),
        ([5.0], [5.0]),
        ([1, 2, 3, 4], [1, 2, 3, 4]),
        ([1, 2, 2, 3], [1, 2, 3]),
        ([1, 2, 3, 2.5, 4], [1, 2, 3, 4]),  # a late one
        ([1, 2, 3, 4, 1.5, 2.5, 3.5, 4.5], [1, 2, 3, 4, 4.5]),  # the clock jumped back
        ([1, 2, 1e9, 3, 4], [1, 2, 3, 4]),  # one stamp that stands out must not take the rest with it
        ([1e9, 1, 2, 3], [1, 2, 3]),
        ([1, 2, 9, 8], [1, 2, 9]),
    ],
)
def test_stamps_that_go_forward(stamps, kept):
    stamps = np.array(stamps, dtype=float)
    assert stamps[in_order(stamps)].tolist() == kept


def test_stamps_may_repeat_where_asked():
    assert in_order(np.array([1.0, 1.0, 2.0, 1.5, 2.0]), repeats=True).tolist() == [True, True, True, False, True]


@given(st.lists(st.floats(-1e9, 1e9)))
def test_what_is_kept_increases_and_increasing_stamps_are_all_kept(stamps):
    stamps = np.array(stamps, dtype=float)
    assert (np.diff(stamps[in_order(stamps)]) > 0).all()
    assert in_order(np.unique(stamps)).all()


def test_malformed_rows_are_counted_by_line_and_rows_stay_in_step(tmp_path):
    file = tmp_path / "numbers.txt"
    file.write_bytes(
        b"\xef\xbb\xbf# stamp value\r\n1 2\r\n\r\n3\r\n4 x\r\n5 nan\r\n  6\t7  \r\n8 9 10\r\n1_0 2\r\n11 \xff\r\n12 13\r\n"
    )
    ledger = Ledger()
    table = read_table(file, 2, ledger, "number")
    assert table.values.tolist() == [[1, 2], [6, 7], [12, 13]]
    assert table.lines.tolist() == [2, 7, 11]
    assert table.rows.tolist() == [0, 4, 7]
    assert ledger.dropped == {
        "line that is not UTF-8 text": 1,
        "number line that is not 2 numbers": 4,
        "number line with a value that is not finite": 1,
    }
    assert ledger.examples["number line that is not 2 numbers"] == [f"{file}:{n}" for n in (4, 5, 8)]
    assert ledger.examples["number line with a value that is not finite"] == [f"{file}:6"]
    assert ledger.examples["line that is not UTF-8 text"] == [f"{file}:10"]


@pytest.mark.parametrize(
    "content", [b"", b"# only a comment\n\n", b"no numbers\n", b"1 inf\n", b"\x00" * 4096, b"\xff\xfe1\x00 \x002\x00"]
)
def test_a_table_without_a_usable_row_is_an_error_that_names_the_file(tmp_path, content):
    file = tmp_path / "numbers.txt"
    file.write_bytes(content)
    with pytest.raises(LogError, match="a number line is 2 numbers") as caught:
        read_table(file, 2, Ledger(), "number")
    assert caught.value.where == str(file)


@pytest.mark.parametrize("fields", [["1_0"], ["0x10"], ["1,5"], ["٣"], ["one"], [""], ["1", "2\x00"]])
def test_what_is_not_a_number(fields):
    assert parse_numbers(fields) is None


def test_numbers():
    assert parse_numbers(["-1", "2.5e-3", "inf"]) == [-1.0, 0.0025, float("inf")]


def test_packed_files_and_damaged_ones(tmp_path):
    whole = gzip.compress(b"1 2\n" * 1000)
    good, cut, other = tmp_path / "a.txt.gz", tmp_path / "b.txt.gz", tmp_path / "c.txt.gz"
    good.write_bytes(whole)
    cut.write_bytes(whole[:-20])
    other.write_bytes(b"1 2\n")
    assert len(read_lines(good, Ledger())) == 1000
    for file in (cut, other):
        with pytest.raises(LogError, match="gzip") as caught:
            read_bytes(file)
        assert caught.value.where == str(file)


def test_a_packed_file_that_unpacks_without_end(tmp_path, monkeypatch):
    monkeypatch.setattr("objslam.io.text._MAX_UNPACKED", 1 << 20)
    file = tmp_path / "a.txt.gz"
    file.write_bytes(gzip.compress(bytes(1 << 20)))
    assert len(read_bytes(file)) == 1 << 20
    file.write_bytes(gzip.compress(bytes((1 << 20) + 1)))
    with pytest.raises(LogError, match="unpacks to more than 1 MiB") as caught:
        read_bytes(file)
    assert caught.value.where == str(file)


def test_what_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    (tmp_path / "loop").symlink_to("loop")
    for name, message in (
        (".", "folder"),
        ("pipe", "regular"),
        ("link", "regular"),
        ("loop", "cannot be read"),
        ("missing", "No such file"),
        ("x" * 300, "name too long"),
    ):
        with pytest.raises(LogError, match=message) as caught:
            read_bytes(tmp_path / name)
        assert caught.value.where == str(tmp_path / name)


def test_drops_name_the_first_places_only():
    ledger = Ledger()
    count_drops("late", 5, (str(n) for n in range(5)), ledger)
    count_drops("never", 0, iter(()), ledger)
    assert ledger.dropped == {"late": 5}
    assert ledger.examples["late"] == ["0", "1", "2"]


@pytest.mark.parametrize(
    "line",
    [
        "1 2",
        "1 -2.5e-7",
        "1 nan",
        "+inf 2",
        "1. .5",
        "0x10 1",
        "1_0 2",
        "1,2 3",
        "1e400 2",
        "'1' 2",
        "1d2 2",
        "1j 2",
        "1 2 3",
    ],
)
def test_a_table_is_the_same_whether_all_its_lines_are_clean_or_not(line, tmp_path):
    """Numbers of clean files are parsed all at once, those of others line by line. Here a last line makes the difference."""
    clean, dirty = tmp_path / "clean.txt", tmp_path / "dirty.txt"
    clean.write_text(f"0.1 7\n{line}\n")
    dirty.write_text(f"0.1 7\n{line}\nnothing\n")
    found, told = (read_table(path, 2, Ledger(), "test") for path in (clean, dirty))
    assert_array_equal(found.values, told.values)
    assert_array_equal(found.lines, told.lines)
    assert_array_equal(found.rows, told.rows)
