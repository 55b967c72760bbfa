"""Trajectories in TUM format. Each line is "stamp tx ty tz qx qy qz qw" or a comment after '#'.

Files with commas, with a header or with planar poses "stamp x y yaw" can also be read.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from objslam.core.diagnostics import Ledger
from objslam.core.geometry import pose_from_quaternion, quaternion
from objslam.core.trajectory import Trajectory
from objslam.core.validity import lengths, valid_pose_rows, valid_positions, valid_stamps
from objslam.errors import LogError
from objslam.io.text import Table, in_order, parse_numbers, read_lines, require_order, select, to_table

_COLUMNS, _PLANAR = "stamp tx ty tz qx qy qz qw", "stamp x y yaw"
_HEADER = f"# {_COLUMNS}\n"
_WORDS = {
    "timestamp": "stamp",
    "time": "stamp",
    "t": "stamp",
    "x": "tx",
    "y": "ty",
    "z": "tz",
    "theta": "yaw",
    "heading": "yaw",
}
"""Other names that people give to columns, each with its name in `_COLUMNS` or its place in a planar file. With more names,
more files with another order of columns are refused."""


def read_trajectory(path: Path, ledger: Ledger) -> Trajectory:
    """Read a trajectory file, which may be packed (.gz). Timestamps are in s, translations in m, and a yaw in rad.

    Quaternions are x y z w. Commas may separate the numbers, and the first line may name the columns. Malformed lines,
    invalid poses and poses out of time order are dropped and counted. Raises LogError if no pose is left, if most poses are
    out of time order, or if the first line names the columns in another order.
    """
    return to_trajectory(read_pose_table(path, ledger))


def read_pose_table(path: Path, ledger: Ledger) -> Table:
    """Return the table of a trajectory file, with the 8 columns of the TUM format, as `read_trajectory` reads it."""
    table = _read_numbers(path, ledger)
    table = select(table, valid_stamps(table.values[:, 0]), "pose line with a stamp that is too large", path, ledger)
    table = select(
        table, valid_positions(table.values[:, 1:4]), "pose line with a position that is too far away", path, ledger
    )
    turns = valid_pose_rows(table.values[:, 1:])
    table = select(table, turns, "pose line with a quaternion that is zero or too long", path, ledger)
    forward = in_order(table.values[:, 0])
    if len(forward):
        require_order(forward, path)
    table = select(table, forward, "pose line with a stamp that repeats or goes back", path, ledger)
    if not len(table.lines):
        raise LogError("no usable pose: every stamp, position or quaternion is invalid", where=str(path))
    off = np.abs(lengths(table.values[:, 4:]) - 1) > 0.01
    if off.any():
        first = f"{path}:{table.lines[off][0]}"
        ledger.warn(
            f"{first}: the length of this quaternion is not 1 ({int(off.sum())} in all), so it is normalised. Check that "
            f"the columns are {_COLUMNS}"
        )
    return table


def _read_numbers(path: Path, ledger: Ledger) -> Table:
    """Return a table with 8 columns, also for a file with "stamp x y yaw". The first line with 8 or 4 numbers shows which of
    both forms the file has."""
    lines = [(number, text.replace(",", " ")) for number, text in read_lines(path, ledger)]
    names = lines[0][1].split() if lines else []
    if len(names) in (4, 8) and not any(parse_numbers([name]) for name in names):
        if _in_other_order(names):
            form = _COLUMNS if len(names) == 8 else _PLANAR
            raise LogError(f"its columns are {' '.join(names)}; they must be {form}", where=f"{path}:{lines[0][0]}")
        lines = lines[1:]
    counts = (len(text.split()) for _, text in lines if parse_numbers(text.split()) is not None)
    columns = next((count for count in counts if count in (4, 8)), 8)
    table = to_table(lines, path, columns, ledger, "pose", f"{_COLUMNS}, or {_PLANAR} of a planar robot")
    if columns == 8:
        return table
    stamp, x, y, yaw = table.values.T
    zero = np.zeros(len(stamp))
    return replace(table, values=np.column_stack([stamp, x, y, zero, zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)]))


def _in_other_order(names: list[str]) -> bool:
    """Return whether the 4 or 8 names of columns show that the columns are in a wrong order.

    A known name must be in its own place. Other names, such as "east", may be in any place. The last of 8 names must end
    with w.
    """
    order = (_COLUMNS if len(names) == 8 else "stamp tx ty yaw").split()
    known = {*_COLUMNS.split(), *_PLANAR.split(), *_WORDS}
    plain = [name.lower() for name in names]
    moved = any(name in known and _WORDS.get(name, name) != place for name, place in zip(plain, order, strict=True))
    return moved or (len(names) == 8 and not plain[7].endswith("w"))


def to_trajectory(table: Table) -> Trajectory:
    """Return the trajectory of a table from `read_pose_table`."""
    return Trajectory(table.values[:, 0], pose_from_quaternion(table.values[:, 1:4], table.values[:, 4:]))


def write_trajectory(trajectory: Trajectory, path: Path) -> None:
    """Write a trajectory file. Every number is read back as the same float."""
    import pyarrow as pa
    from pyarrow import csv  # pyarrow is five times as fast as one repr for each number.

    poses = trajectory.poses
    values = np.column_stack([trajectory.stamps, poses[:, :3, 3], quaternion(poses)])
    table = pa.table({name: np.ascontiguousarray(column) for name, column in zip("txyzijkw", values.T, strict=True)})
    with path.open("wb") as file:
        file.write(_HEADER.encode())
        csv.write_csv(table, file, csv.WriteOptions(include_header=False, delimiter=" ", quoting_style="none"))
