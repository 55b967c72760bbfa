"""Whatever is pushed, of whatever type: it is taken, or counted with a reason, and never raises."""

from collections import deque
from contextlib import ExitStack
from dataclasses import replace
from decimal import Decimal
from unittest.mock import MagicMock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from waiting import LIMIT

from objslam.config import load_settings
from objslam.core.camera import Camera, RangeNoise
from objslam.core.diagnostics import Ledger
from objslam.live.session.session import Session
from objslam.sources.journal.reader import messages

SETTINGS = load_settings(None, ("mode=joint",))
MATRIX = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
CAMERA = Camera("front", 640, 480, MATRIX)
BOX = [[10.0, 10.0, 90.0, 90.0]]


class Unwilling:
    """What raises whatever it is asked, but for its name, which hypothesis shows."""

    def _raise(self, *args, **kwargs):
        raise RuntimeError("no\nand no again")

    __len__ = __iter__ = __getitem__ = __float__ = __int__ = __index__ = __array__ = _raise
    __str__ = __format__ = __eq__ = __bool__ = __lt__ = __le__ = __gt__ = __ge__ = __abs__ = _raise
    __hash__ = None

    def __repr__(self):
        return "Unwilling()"


class Endless(list):
    """A list that holds itself."""

    def __init__(self):
        self.append(self)


odd = st.sampled_from(
    [None, True, b"front", "front", "", "a\nb", "\ud800", 1j, -(10**30), 2**64 - 1, Decimal("1.5"),
     Unwilling(), Unwilling, object(), Endless(), MagicMock(), MagicMock(spec=Camera), range(5), range(10**6), deque([1.0]),
     {"a": 1}, {1, 2}, np.datetime64("now"), np.array("x"), np.array(["cup"]), np.array([None]), np.eye(4),
     np.ma.masked_all((4, 4)), np.zeros((0, 4)), np.array([2**64 - 1], np.uint64), np.float32(1.5), np.longdouble("1e4000"),
     [["1"] * 4] * 4, [[1, 2], [3]], ["cup"], [b"cup"], [1e308], [[-1e308, 0, 1e308, 1]], iter([1.0])]
)  # fmt: skip
long = st.builds(lambda: "x" * 70_000) | st.builds(lambda: 10**5000)
number = st.one_of(st.floats(), st.integers(), st.floats(0, 1))
arrays = npst.arrays(
    st.sampled_from([np.float64, np.float16, np.int8, np.uint64, np.bool_, np.complex64, "U3", "M8[s]", np.object_]),
    npst.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)
junk = st.recursive(
    st.one_of(odd, long, number, st.text(max_size=4), arrays),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=2), inner, max_size=2),
    max_leaves=6,
)


def or_junk(*good):
    return st.one_of(st.sampled_from(good), junk)


cameras = st.one_of(
    junk,
    st.builds(
        Camera,
        name=or_junk("front", "rear"),
        width=or_junk(640, 640.0),
        height=or_junk(480),
        matrix=or_junk(MATRIX, MATRIX.tolist()),
        distortion_model=or_junk("plumb_bob", "equidistant"),
        distortion=or_junk(np.zeros(5), [0.0] * 4),
        base_T_camera=or_junk(np.eye(4), np.eye(4).tolist()),
        depth_scale=or_junk(1000.0),
        sees_size=or_junk(True),
        depth_noise=or_junk(None, RangeNoise(0.01, 0.005, 0.02), RangeNoise("1", 0.0, -1.0)),
    ),
)
stamps, poses, names = or_junk(1.0, 2.0, 3.0), or_junk(np.eye(4), np.eye(4).tolist()), or_junk("front", "rear")
pushes = st.one_of(
    st.tuples(st.just("push_camera"), cameras),
    st.tuples(st.just("push_odometry"), stamps, poses, junk),
    st.tuples(st.just("push_localization"), stamps, poses, junk),
    st.tuples(st.just("push_mount"), stamps, names, poses),
    st.tuples(
        st.just("push_detections"),
        stamps,
        names,
        or_junk(BOX),
        or_junk(["cup"]),
        or_junk([0.5]),
        or_junk(None, [2.0]),
        or_junk(None, [7]),
        or_junk(True, False),
    ),
)


@settings(max_examples=200)
@given(st.lists(pushes, max_size=6))
def test_nothing_that_is_pushed_raises(tmp_path_factory, found):
    file = tmp_path_factory.mktemp("junk") / "journal.objslam"
    with ExitStack() as stack:  # an example that fails leaves no thread behind either
        session = Session(SETTINGS, file)
        stack.callback(session.abort)
        session.start().push_camera(CAMERA)
        taken = 1
        for name, *what in found:
            before = sum(session.counters.dropped().values())
            said = getattr(session, name)(*what)
            assert type(said) is bool
            assert said or sum(session.counters.dropped().values()) > before
            taken += said
        assert session.wait(LIMIT)
    ledger = Ledger()
    kept = len(list(messages(file, ledger)))
    assert not ledger.dropped
    assert kept <= taken + session.counters.accepted().get("notes", 0)
    for line in session.counters.ledger.lines():
        assert len(line.splitlines()) == 1
        line.encode()


def test_lists_are_as_good_as_arrays():
    session = Session(SETTINGS)
    pose = np.eye(4).tolist()
    listed = Camera("front", 640, 480, MATRIX.tolist(), "plumb_bob", [0.0] * 5, pose)
    assert session.push_camera(listed)
    assert session.push_camera(CAMERA)  # the same again
    assert session.push_odometry(1, pose)
    assert session.push_mount(1, "front", pose)
    assert session.push_detections(1, "front", [], [], [])
    assert session.push_detections(2, "front", BOX, np.array(["cup"]), [1], [None], np.array([3.0]))
    assert not session.counters.dropped()
    (camera, *_, frame), _ = zip(*session._queue, strict=True)
    assert camera.camera.matrix.dtype == np.float64
    assert (frame.labels, frame.track_ids.tolist(), np.isnan(frame.depths).tolist()) == (("cup",), [3], [True])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"name": ["front"]}, "without a name"),
        ({"name": "a\nb"}, "without a name"),
        ({"matrix": "matrix"}, "without a calibration"),
        ({"matrix": np.diag([500.0, 500.0, 0.0])}, "whose matrix is not fx 0 cx, 0 fy cy, 0 0 1"),
        ({"width": None}, "without a size"),
        ({"height": np.nan}, "without a size"),
        ({"height": 480.5}, "without a size"),
        ({"distortion_model": ["plumb_bob"]}, "with an unknown lens model"),
        ({"distortion": 5}, "with an unknown lens model"),
        ({"distortion": [0.1] * 3}, "whose lens model plumb_bob takes 4 or 5 coefficients, got 3"),
        ({"distortion": [0.1] * 1000}, "with an unknown lens model"),
        ({"distortion": [1e300] * 5}, "whose distortion coefficients are not finite or too large"),
        ({"base_T_camera": [1, 2]}, "whose mount is not a rigid pose"),
        ({"depth_scale": "1000"}, "whose depth scale is not above zero"),
        ({"sees_size": 2}, "whose sees_size is neither true nor false"),
        ({"depth_noise": 0.01}, "whose depth_noise is not a RangeNoise"),
        (
            {"depth_noise": RangeNoise(0.0, 0.01, 0.02)},
            "whose depth noise is not a finite sigma above zero, and sigma_per_m and bias of at least zero",
        ),
    ],
)
def test_what_is_wrong_with_a_camera_is_told(change, reason):
    session = Session(SETTINGS)
    assert not session.push_camera(replace(CAMERA, **change))
    assert session.counters.dropped() == {f"camera {reason}": 1}


def test_a_name_that_is_a_list_is_told():
    session = Session(SETTINGS)
    assert session.push_camera(CAMERA)
    assert not session.push_mount(1.0, ["front"], np.eye(4))
    assert not session.push_detections(1.0, ["front"], BOX, ["cup"], [1.0])
    assert not session.push_detections("now", "front", BOX, ["cup"], [1.0])
    assert not session.push_detections(1.0, "front", BOX, "c", [1.0])
    assert not session.push_detections(1.0, "front", BOX, ["cup"], [1.0], whole=np.ones(2))
    assert session.counters.ledger.lines() == [
        "dropped 1: mount of an unknown camera (first: of type list)",
        "dropped 3: frame that is malformed (first: camera of type list, stamp 1.000; camera front, stamp 1.000)",
        "dropped 1: frame without a stamp (first: camera front)",
    ]


@pytest.mark.parametrize(
    ("stamp", "fault"),
    [
        (1.7e12, "in ms instead of s"),
        (1.7e15, "in us instead of s"),
        (1.7e18, "in ns instead of s"),
        (1e40, "in another unit instead of s"),
        (np.inf, "that is no time in s"),
    ],
)
def test_a_stamp_in_another_unit_is_told(stamp, fault):
    session = Session(SETTINGS)
    assert session.push_camera(CAMERA)
    assert not session.push_odometry(stamp, np.eye(4))
    assert not session.push_mount(stamp, "front", np.eye(4))
    assert not session.push_detections(stamp, "front", BOX, ["cup"], [1.0])
    assert list(session.counters.dropped()) == [f"{what} with a stamp {fault}" for what in ("odometry", "mount", "frame")]


def test_boxes_that_are_shares_of_the_image_are_told():
    session = Session(SETTINGS)
    assert session.push_camera(CAMERA)
    session.push_detections(1.0, "front", [[0.1, 0.2, 0.3, 0.4], [10.0, 20.0, 30.0, 40.0]], ["cup", "cup"], [1.0, 1.0])
    assert list(session.counters.dropped()) == ["box between 0 and 1, a share of the image instead of px"]
