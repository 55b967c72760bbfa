import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.errors import LogError
from objslam.io.tum_trajectory import read_trajectory, write_trajectory

_STAMPS = st.lists(st.floats(0, 2e9), min_size=1, max_size=20, unique=True).map(sorted)


@given(_STAMPS, st.data())
def test_written_trajectories_read_back(stamps, data):
    count = len(stamps)
    translation = data.draw(arrays(float, (count, 3), elements=st.floats(-1e6, 1e6)))
    turns = data.draw(arrays(float, (count, 3), elements=st.floats(-3, 3)))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = Rotation.from_rotvec(turns).as_matrix(), translation
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "path.txt")
        write_trajectory(Trajectory(np.array(stamps), poses), file)
        ledger = Ledger()
        read = read_trajectory(file, ledger)
    assert not ledger.lines()
    assert read.stamps.tolist() == stamps
    assert np.array_equal(read.poses[:, :3, 3], translation)
    np.testing.assert_allclose(read.poses, poses, atol=1e-14, rtol=1e-15)


def test_a_pose_is_read_as_tum_writes_it(tmp_path):
    file = tmp_path / "path.txt"
    file.write_text("# comment\n1341847980.7900 1 2 3 0 0 2 2\n")  # a quarter turn about z, of any length
    ledger = Ledger()
    path = read_trajectory(file, ledger)
    assert path.stamps.tolist() == [1341847980.79]
    np.testing.assert_allclose(path.poses[0], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-15)
    assert f"{file}:2: the length of this quaternion is not 1 (1 in all)" in ledger.warnings[0]


TURNED = [[0.0, -1, 0, 3], [1, 0, 0, 4], [0, 0, 1, 0], [0, 0, 0, 1]]  # a quarter turn to the left at (3, 4)


@pytest.mark.parametrize(
    "text",
    [
        "1 0 0 0\n2 3 4 1.5707963267948966\n",
        "stamp x y yaw\n1 0 0 0\n2 3 4 1.5707963267948966\n",
        "t,x,y,theta\n1,0,0,0\n2, 3, 4, 1.5707963267948966\n",
        "timestamp,tx,ty,tz,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n2,3,4,0,0,0,0.7071067811865476,0.7071067811865476\n",
        "1,0,0,0,0,0,0,1\r\n2,3,4,0,0,0,0.7071067811865476,0.7071067811865476\r\n",
    ],
)
def test_commas_a_header_and_planar_poses_are_read(tmp_path, text):
    file, ledger = tmp_path / "odometry.csv", Ledger()
    file.write_text(text)
    path = read_trajectory(file, ledger)
    assert path.stamps.tolist() == [1, 2]
    np.testing.assert_allclose(path.poses, [np.eye(4), TURNED], atol=1e-12)
    assert not ledger.lines()


def test_columns_that_their_header_names_otherwise_are_refused(tmp_path):
    file = tmp_path / "odometry.txt"
    file.write_text("stamp tx ty tz qw qx qy qz\n1 0 0 0 1 0 0 0\n")
    with pytest.raises(LogError, match=r"they must be stamp tx ty tz qx qy qz qw") as caught:
        read_trajectory(file, Ledger())
    assert caught.value.where == f"{file}:1"


@pytest.mark.parametrize("names", ["x,y,yaw,stamp", "stamp,yaw,x,y", "Time,Y,X,Theta", "stamp x y z"])
def test_planar_columns_whose_names_are_in_another_order_are_refused(tmp_path, names):
    file = tmp_path / "localization.txt"
    file.write_text(f"{names}\n1,0,0,0\n2,3,4,0.5\n")
    with pytest.raises(LogError, match="they must be stamp x y yaw"):
        read_trajectory(file, Ledger())


def test_columns_with_names_of_their_own_are_read_in_the_usual_order(tmp_path):
    file = tmp_path / "localization.txt"
    file.write_text("time,east,north,heading\n1,0,0,0\n2,3,4,1.5707963267948966\n")
    np.testing.assert_allclose(read_trajectory(file, Ledger()).poses, [np.eye(4), TURNED], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "shown"),
    [("1 2 3 4 5\n2 2 3 4 5\n", "the first is '1 2 3 4 5'"), ("1;0;0;0\n2;0;0;0\n", "the first is '1;0;0;0'")],
)
def test_a_file_without_a_pose_shows_its_first_line(tmp_path, text, shown):
    file = tmp_path / "odometry.txt"
    file.write_text(text)
    with pytest.raises(LogError, match=shown):
        read_trajectory(file, Ledger())


def test_a_planar_file_drops_what_is_not_planar(tmp_path):
    file, ledger = tmp_path / "odometry.txt", Ledger()
    file.write_text("1 0 0 0\n2 1 0\n3 2 0 0 0 0 0 1\n4 3 0 0.5\n")
    assert read_trajectory(file, ledger).stamps.tolist() == [1, 4]
    assert ledger.dropped == {"pose line that is not 4 numbers": 2}


def test_a_file_without_a_pose_says_what_a_pose_is(tmp_path):
    file = tmp_path / "odometry.txt"
    file.write_text("a b c\n1 2\n")
    with pytest.raises(LogError, match="a pose line is stamp tx ty tz qx qy qz qw, or stamp x y yaw of a planar robot"):
        read_trajectory(file, Ledger())


def test_every_bad_line_is_dropped_and_named(tmp_path):
    file = tmp_path / "odometry.txt"
    lines = [
        "1 0 0 0 0 0 0 1",
        "2 0 0 0 0 0 0",  # too few
        "3 0 0 0 0 0 0 1 0",  # too many
        "4 0 0 zero 0 0 0 1",
        "5 nan 0 0 0 0 0 1",
        "inf 0 0 0 0 0 0 1",
        "7 0 0 0 0 0 0 0",  # no rotation
        "7 0 0 0 0 0 0 1e-9",
        "7 0 0 0 1e300 1e300 0 1",  # its length is not finite
        "8 5 0 0 0 0 0 1",
        "8 6 0 0 0 0 0 1",  # again
        "3 7 0 0 0 0 0 1",  # back
        "9 8 0 0 0 0 0 1",
        "10 8 0",  # cut off
    ]
    file.write_text("\n".join(lines))
    ledger = Ledger()
    path = read_trajectory(file, ledger)
    assert path.stamps.tolist() == [1, 8, 9]
    assert path.poses[:, 0, 3].tolist() == [0, 5, 8]
    places = {reason: [int(place.rpartition(":")[2]) for place in places] for reason, places in ledger.examples.items()}
    assert places == {
        "pose line that is not 8 numbers": [2, 3, 4],
        "pose line with a value that is not finite": [5, 6],
        "pose line with a quaternion that is zero or too long": [7, 8, 9],
        "pose line with a stamp that repeats or goes back": [11, 12],
    }
    assert ledger.dropped["pose line that is not 8 numbers"] == 4
    assert all(place.startswith(f"{file}:") for found in ledger.examples.values() for place in found)


def test_a_file_from_the_last_pose_to_the_first_is_refused(tmp_path):
    file = tmp_path / "odometry.txt"
    file.write_text("".join(f"{stamp} 0 0 0\n" for stamp in range(9, 0, -1)))
    with pytest.raises(LogError, match="8 of its 9 stamps repeat or go back") as caught:
        read_trajectory(file, Ledger())
    assert caught.value.where == str(file)
    assert caught.value.hint == "sort the lines by their stamps"


@pytest.mark.parametrize("line", ["1e21 0 0 0 0 0 0 1", "1 0 1e7 0 0 0 0 1", "1 0 0 0 0 0 0 1e4"])
def test_a_number_that_is_too_large_is_dropped(tmp_path, line):
    file = tmp_path / "odometry.txt"
    file.write_text(f"{line}\n2 9.9e6 0 0 0 0 0 1\n")
    ledger = Ledger()
    assert read_trajectory(file, ledger).stamps.tolist() == [2]
    assert list(ledger.dropped.values()) == [1]


def test_no_pose_left(tmp_path):
    file = tmp_path / "odometry.txt"
    file.write_text("1 0 0 0 0 0 0 0\n2 0 0 0 0 0 0 0\n")
    with pytest.raises(LogError, match="quaternion") as caught:
        read_trajectory(file, Ledger())
    assert caught.value.where == str(file)
