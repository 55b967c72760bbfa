"""Journals: what goes in comes out, and damage costs no more than what it hit."""

import json
import os
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.spatial.transform import Rotation

from objslam.core.calibration import Calibration
from objslam.core.camera import RangeNoise
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import make_pose
from objslam.core.noise import NoiseFactors
from objslam.core.validity import is_name
from objslam.errors import LogError, OutputError
from objslam.simulation import make_camera
from objslam.sources import read
from objslam.sources.journal.aside import restore_after_kill
from objslam.sources.journal.corrections import AssociationMessage, BodiesMessage, CalibrationMessage, NamesMessage
from objslam.sources.journal.journal import Journal
from objslam.sources.journal.log import read_journal
from objslam.sources.journal.reader import messages
from objslam.sources.journal.record_format import MAGICS
from objslam.sources.journal.records import (
    CameraMessage,
    FrameMessage,
    MountMessage,
    NoteMessage,
    PoseMessage,
    decode,
    encode,
)
from objslam.sources.journal.segments import is_journal

FINITE = st.floats(-1e6, 1e6)
POSES = st.builds(
    lambda v, t: make_pose(Rotation.from_rotvec(v).as_matrix(), np.array(t)),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(FINITE, FINITE, FINITE),
)


NAMES = st.text(max_size=9).filter(is_name)


@st.composite
def frames(draw):
    count = draw(st.integers(0, 4))
    corner = draw(npst.arrays(np.float64, (count, 2), elements=FINITE))
    return FrameMessage(
        draw(FINITE),
        draw(NAMES),
        np.hstack([corner, corner + draw(npst.arrays(np.float64, (count, 2), elements=st.floats(0.01, 1e6)))]),
        tuple(draw(st.lists(NAMES, min_size=count, max_size=count))),
        draw(npst.arrays(np.float64, count, elements=st.floats(0, 1))),
        draw(npst.arrays(np.float64, count, elements=st.one_of(st.just(np.nan), st.floats(0.1, 10)))),
        draw(npst.arrays(np.int64, count, elements=st.integers(-1, 9))),
        draw(st.booleans()),
    )


def calibrations(count):
    values = npst.arrays(np.float64, count, elements=FINITE)
    roots = npst.arrays(np.float64, (count, count), elements=st.floats(-1e3, 1e3))
    return st.builds(Calibration, st.tuples(*[NAMES] * count), values, roots.map(lambda root: root @ root.T), values)


def bodies(count):
    """Of each shape, and of none."""
    sides = npst.arrays(np.float64, (count, 3), elements=st.floats(1e-3, 1e3))
    roots = npst.arrays(np.float64, (count, 4, 4), elements=st.floats(-1e3, 1e3))
    spread = roots.map(lambda root: root @ np.swapaxes(root, 1, 2)).map(lambda one: (one + np.swapaxes(one, 1, 2)) / 2)
    ids = st.just(3 * np.arange(count))
    shapes = npst.arrays(np.int64, count, elements=st.integers(0, 3))
    yaws = npst.arrays(np.float64, count, elements=st.floats(-4, 4))
    return st.builds(BodiesMessage, st.integers(0, 10**9), ids, shapes, sides, yaws, spread)


@st.composite
def associations(draw):
    """Of objects with up to 9 rays each. No ray is of two objects."""
    count = draw(st.integers(0, 4))
    numbers = draw(st.lists(st.integers(0, 10**9), min_size=count + 1, max_size=9 * count + 9, unique=True))
    *rays, free = (np.array(sorted(numbers[i :: count + 1]), dtype=np.int64) for i in range(count + 1))
    keyframes = np.array(sorted(draw(st.sets(st.integers(0, 10**9), max_size=4))), dtype=np.int64)
    poses = np.array([draw(POSES) for _ in keyframes]).reshape(-1, 4, 4)
    places = draw(npst.arrays(np.float64, (count, 3), elements=FINITE))
    return AssociationMessage(draw(st.integers(0, 10**9)), tuple(rays), places, free, keyframes, poses)


def label_kinds(count):
    """Of labels that are of one kind each."""
    labels = st.lists(st.integers(0, 99), min_size=count, max_size=3 * count, unique=True)
    kinds = labels.map(lambda found: [np.array(found[i::3], dtype=np.int64) for i in range(3)])
    return st.builds(lambda number, parts: NamesMessage(number, *parts), st.integers(0, 10**9), kinds)


SIZES, SHARES, SECONDS = st.floats(1.0, 300.0), st.floats(0.0, 1.0), st.floats(0.1, 1e3)
NOISES = st.builds(
    NoiseFactors,
    heading=SIZES,
    heading_share=SHARES,
    heading_seconds=SECONDS,
    place=SIZES,
    place_share=SHARES,
    place_seconds=SECONDS,
)

MESSAGES = st.one_of(
    st.builds(PoseMessage, st.sampled_from(["odometry", "localization"]), FINITE, POSES),
    st.builds(MountMessage, FINITE, NAMES, POSES),
    st.builds(NoteMessage, FINITE, POSES),
    st.builds(CalibrationMessage, st.integers(0, 10**9), st.integers(0, 4).flatmap(calibrations), NOISES),
    st.integers(0, 4).flatmap(bodies),
    associations(),
    st.integers(0, 4).flatmap(label_kinds),
    st.just(CameraMessage(make_camera("links", yaw=0.3))),
    st.just(CameraMessage(replace(make_camera("bearings"), sees_size=False))),
    st.just(CameraMessage(replace(make_camera("depth"), depth_noise=RangeNoise(0.01, 0.005, 0.02)))),
    frames(),
)


def same(one, other):
    assert type(one) is type(other)
    for a, b in zip(vars(one).values(), vars(other).values(), strict=True):
        if hasattr(a, "matrix") or hasattr(a, "covariance"):
            same(a, b)
        elif isinstance(a, np.ndarray):
            np.testing.assert_array_equal(a, b)
        elif isinstance(a, tuple) and a and isinstance(a[0], np.ndarray):
            assert list(map(list, a)) == list(map(list, b))
        else:
            assert a == b


@given(MESSAGES)
def test_a_message_survives_to_the_last_bit(message):
    same(decode(encode(message)), message)


@given(st.binary(max_size=200))
def test_bytes_that_are_no_message(data):
    if data[:1] in b"OLMCFN" and len(data) > 1:
        data = data[:1] + b"\x00" + data[1:]  # no JSON begins so, and no other record is so short
    with pytest.raises(LogError, match="record"):
        decode(data[:90])


def record(kind, *content):
    return kind + json.dumps(content).encode()


FLAT = np.eye(4).ravel().tolist()
TWICE = (2 * np.eye(4)).ravel().tolist()


@pytest.mark.parametrize(
    "data",
    [
        struct.pack("<c13d", b"O", np.inf, *FLAT[:12]),
        struct.pack("<c13d", b"O", 1.0, *FLAT[:3], np.inf, *FLAT[4:12]),
        struct.pack("<c13d", b"L", 1.0, *FLAT[:3], 1e8, *FLAT[4:12]),
        struct.pack("<c13d", b"O", 1.0, *TWICE[:12]),
        struct.pack("<cd12dH", b"M", 1.0, *TWICE[:12], 5) + b"front",
        struct.pack("<cd12dH", b"M", 1.0, *FLAT[:12], 2) + b"\xff\xff",
        record(b"B", 3, [0], [9], [[1, 1, 1]], [0.0], [np.eye(4).tolist()]),
        record(b"B", 3, [0], [2], [[1, 0, 1]], [0.0], [np.eye(4).tolist()]),
        record(b"B", 3, [0], [2], [[1, 1, 1]], [0.0], [(-np.eye(4)).tolist()]),
        record(b"B", 3, [0, 1], [2], [[1, 1, 1]], [0.0], [np.eye(4).tolist()]),
        record(b"N", 0.0, TWICE),
        record(b"N", np.nan, FLAT),
        record(b"N", 10**400, FLAT),
        b"N" + b"[" * 100_000,
        record(b"S", 1, ["clock"], [0.1], [[-1.0]], [1.0]),
        record(b"S", np.inf, ["clock"], [0.1], [[1.0]], [1.0]),
        record(b"C", "front", 640, 480, np.eye(3).ravel().tolist(), "plumb_bob", [0.0] * 5, TWICE, 1000.0),
        record(b"C", "front", 640, 480, np.eye(3).ravel().tolist(), ["plumb_bob"], [0.0] * 5, FLAT, 1000.0),
        record(b"C", "front", np.inf, 480, np.eye(3).ravel().tolist(), "plumb_bob", [0.0] * 5, FLAT, 1000.0),
        record(b"F", 1.0, "front", [[9, 9, 1, 1]], ["cup"], [0.5], [1.0], [-1]),
        record(b"F", 1.0, "front", [[1, 1, 9, 9]], ["cup"], [0.5], [1.0], [2**70]),
        record(b"F", 1.0, "front", [[1, 1, 9, 9]], ["\ud800"], [0.5], [1.0], [-1]),
    ],
)
def test_a_value_that_no_session_accepts_is_refused(data):
    with pytest.raises(LogError, match="record"):
        decode(data)


def write(file, found, resume=False):
    journal = Journal(file, resume)
    for message in found:
        journal.write(message)
    journal.close()


@settings(max_examples=25)
@given(st.lists(MESSAGES, max_size=6), st.data())
def test_a_torn_end_costs_the_last_record_only(tmp_path_factory, found, data):
    file = tmp_path_factory.mktemp("journal") / "journal.objslam"
    write(file, found)
    sizes = np.cumsum([24] + [12 + len(encode(m)) for m in found])
    cut = data.draw(st.integers(24, int(sizes[-1])))
    file.write_bytes(file.read_bytes()[:cut])
    whole = int(np.searchsorted(sizes, cut, side="right")) - 1
    ledger = Ledger()
    back = list(messages(file, ledger))
    for one, other in zip(back, found[:whole], strict=True):
        same(one, other)
    assert bool(ledger.dropped) == (cut != sizes[whole])
    write(file, found[whole:], resume=True)  # goes on where the whole records end
    again = list(messages(file, Ledger()))
    for one, other in zip(again, found, strict=True):
        same(one, other)


def pose(stamp, x):
    return PoseMessage("odometry", stamp, make_pose(np.eye(3), np.array([x, 0.0, 0.0])))


@pytest.mark.parametrize("at", [0, 4, 8, 40])
def test_a_flipped_bit_costs_one_record(tmp_path, at):
    """In the mark, the length, the checksum or the content."""
    file = tmp_path / "journal.objslam"
    write(file, [pose(float(i), i) for i in range(10)])
    data = bytearray(file.read_bytes())
    data[24 + 5 * 117 + at] ^= 1
    file.write_bytes(bytes(data))
    ledger = Ledger()
    assert [m.stamp for m in messages(file, ledger)] == [0, 1, 2, 3, 4, 6, 7, 8, 9]
    assert ledger.dropped == {"damaged record of the journal": 1}


def test_two_sessions_do_not_share_a_journal(tmp_path):
    first = Journal(tmp_path / "j")
    with pytest.raises(OutputError, match="another session"):
        Journal(tmp_path / "j", resume=True)
    first.close()


def test_a_journal_with_messages_is_never_overwritten(tmp_path):
    file = tmp_path / "journal.objslam"
    for i in range(3):
        write(file, [pose(float(i), 1.0)])
        write(tmp_path / "empty", [])
    held = [[m.stamp for m in messages(f, Ledger())] for f in sorted(tmp_path.glob("journal*"))]
    assert held == [[0.0], [1.0], [2.0]]  # journal.1, journal.2, and the newest, journal
    assert [f.name for f in tmp_path.glob("empty*")] == ["empty"]
    used = Journal(tmp_path / "used")
    used.write(pose(0.0, 1.0))
    with pytest.raises(OutputError, match="another session"):
        Journal(tmp_path / "used")
    used.close()
    assert len(list(messages(tmp_path / "used", Ledger()))) == 1


def test_what_is_no_journal(tmp_path):
    (tmp_path / "j").write_bytes(b"something else")
    assert not is_journal(tmp_path / "j")
    with pytest.raises(OutputError, match="not a journal"):
        Journal(tmp_path / "j", resume=True)
    assert (tmp_path / "j").read_bytes() == b"something else"
    with pytest.raises(LogError):
        list(messages(tmp_path / "j", Ledger()))


def test_a_journal_is_a_log(tmp_path):
    file = tmp_path / "drive" / "journal.objslam"
    file.parent.mkdir()
    camera, arm = make_camera("front"), make_pose(np.eye(3), np.array([0.0, 0.0, 1.0]))

    def frame(stamp, *labels):
        count = len(labels)
        box = np.tile([10.0, 10.0, 20.0, 20.0], (count, 1))
        return FrameMessage(stamp, "front", box, labels, np.ones(count), np.full(count, np.nan), np.full(count, -1))

    found = [CameraMessage(camera), *(pose(float(i), i) for i in range(4)), frame(2.0, "cup", "ball"), frame(1.0)]
    write(file, [*found, MountMessage(1.5, "front", arm)])
    log = read(file.parent, Ledger())
    assert log.name == "drive"
    np.testing.assert_array_equal(log.odometry.stamps, [0, 1, 2, 3])
    detections, mount = log.cameras[0].detections, log.cameras[0].mount
    np.testing.assert_array_equal(detections.frame_stamps, [1.0, 2.0])
    assert [detections.label_names[i] for i in detections.label] == ["cup", "ball"]
    np.testing.assert_array_equal(mount.poses, [camera.base_T_camera, arm])
    write(file, found[:3])
    with pytest.raises(LogError, match="no frames"):
        read_journal(file, Ledger())


def test_an_empty_journal_gives_way_to_the_newest_one_kept(tmp_path):
    file = tmp_path / "journal.objslam"
    assert restore_after_kill(file) is None
    older, newer = tmp_path / "journal.2.objslam", tmp_path / "journal.1.objslam"
    for number, kept in enumerate((older, newer)):
        kept.write_bytes(MAGICS[1] + bytes([number]))
        os.utime(kept, (1000 + number, 1000 + number))
    (tmp_path / "journal.mine.objslam").write_bytes(MAGICS[1])
    journal = Journal(file)
    assert restore_after_kill(file) is None  # its session is alive
    journal.close()
    assert restore_after_kill(file) == newer
    assert file.read_bytes() == MAGICS[1] + b"\x01"
    assert restore_after_kill(file) is None  # it has a message
    assert {entry.name for entry in tmp_path.iterdir()} == {file.name, older.name, "journal.mine.objslam"}
    file.write_text("my notes")
    assert restore_after_kill(file) is None
    assert file.read_text() == "my notes"


def test_a_calibration_of_an_older_version_has_the_noise_of_the_settings():
    message = CalibrationMessage(7, Calibration(("front.clock",), np.array([0.1]), np.eye(1) * 1e-4, np.array([0.1])))
    kind, *parts = encode(message)[:1], *json.loads(encode(message)[1:])
    older = kind + json.dumps(parts[:-1]).encode()
    assert decode(older).noise == NoiseFactors()


IMPOSSIBLE = (
    *([0.0, 0, 0, 1, 0, 0], [1e9, 0, 0, 1, 0, 0], [1, 1.5, 1, 1, 0, 0], [1, 0.5, 0, 1, 0, 0]),
    *([1, 0, 0, 1, 0, -1.0], [1, 0, 0, 1], "noise", [[1, 0, 0, 1, 0, 0]] * 2, [1, 0, 0, "a", 0, 0]),
)
"""Too small, too large, a share above 1, a part that lasts for no time, a time below 0, and lists that are none."""


@pytest.mark.parametrize("noise", IMPOSSIBLE)
def test_a_calibration_with_noise_that_cannot_be_is_refused(noise):
    message = CalibrationMessage(7, Calibration((), np.zeros(0), np.zeros((0, 0)), np.zeros(0)))
    parts = json.loads(encode(message)[1:])
    with pytest.raises(LogError, match="cannot be read"):
        decode(encode(message)[:1] + json.dumps([*parts[:-1], noise]).encode())
