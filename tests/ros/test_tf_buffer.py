"""The live tf buffer against the one for logs, which sees everything at once, and against closed forms."""

from types import SimpleNamespace as Message

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from objslam.core.diagnostics import Ledger
from objslam.ros.tf.buffer import TfBuffer, UnknownTransform
from objslam.ros.tf.frames import find_base
from objslam.ros.tf.tree import TfRows, TfTree


def transform(stamp, parent, child, pose):
    ns = round(stamp * 1e9)
    header = Message(stamp=Message(sec=ns // 10**9, nanosec=ns % 10**9), frame_id=parent)
    x, y, z = pose[:3, 3]
    turn = dict(zip("xyzw", Rotation.from_matrix(pose[:3, :3]).as_quat(), strict=True))
    body = Message(translation=Message(x=x, y=y, z=z), rotation=Message(**turn))
    return Message(header=header, child_frame_id=child, transform=body)


def planar(x, y, yaw):
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:2, 3] = x, y
    return pose


def test_agrees_with_the_tree_of_a_whole_log():
    rng = np.random.default_rng(0)
    rows, buffer = TfRows(), TfBuffer()
    lens = np.eye(4)
    lens[:3, :3], lens[:3, 3] = Rotation.random(rng=rng).as_matrix(), [0.1, 0.2, 0.3]
    feed = [(transform(5.0, "head", "lens", lens), True), (transform(5.0, "/base", "column", planar(0, 0, 0.3)), True)]
    for k in range(80):
        feed.append((transform(10 + 0.05 * k, "column", "head", planar(0.01 * k, 0, 0.02 * k)), False))
        feed.append((transform(10.01 + 0.05 * k, "odom", "base", planar(0.1 * k, 0.01 * k, 0.03 * k)), False))
    for message, static in feed:
        rows.add(message, 0, static)
        buffer.add(message, 0.0, static)
    tree = TfTree(rows, Ledger())
    stamps = np.sort(rng.uniform(10.02, 13.9, 40))
    for a, b in (("base", "lens"), ("odom", "lens"), ("lens", "odom"), ("head", "base")):
        expected, known = tree.at(a, b, stamps)
        assert known.all()
        np.testing.assert_allclose([buffer.at(a, b, stamp) for stamp in stamps], expected, atol=1e-9)
    assert buffer.newest("odom", "lens") == pytest.approx(13.95)
    assert buffer.newest("head", "lens") is None


def test_what_may_still_come_is_told_from_what_never_will():
    buffer = TfBuffer()
    for k in range(30):
        buffer.add(transform(100.0 + k, "odom", "base", planar(k, 0, 0)), 0.0, False)
    for a, b, stamp, later in (
        ("odom", "base", 129.5, True),
        ("odom", "base", 90.0, False),
        ("odom", "camera", 110.0, True),
        ("map", "base", 110.0, True),
    ):
        with pytest.raises(UnknownTransform) as unknown:
            buffer.at(a, b, stamp)
        assert unknown.value.later is later


def test_a_gap_is_not_bridged():
    buffer = TfBuffer()
    for stamp in (1.0, 12.0):
        buffer.add(transform(stamp, "odom", "base", planar(stamp, 0, 0)), 0.0, False)
    with pytest.raises(UnknownTransform):
        buffer.at("odom", "base", 6.0)
    np.testing.assert_allclose(buffer.at("odom", "base", 12.0), planar(12, 0, 0))


def test_a_transform_that_never_changes_holds_at_any_time():
    buffer = TfBuffer()
    for k in range(3):
        buffer.add(transform(1.0 + k, "base", "camera", planar(1, 2, 0.5)), 0.0, False)
    np.testing.assert_allclose(buffer.at("base", "camera", 99.0), planar(1, 2, 0.5))
    buffer.add(transform(5.0, "base", "camera", planar(1, 2, 0.6)), 0.0, False)
    with pytest.raises(UnknownTransform):
        buffer.at("base", "camera", 99.0)


def test_a_clock_set_back_begins_anew():
    buffer = TfBuffer()
    for stamp, x in ((100.0, 1), (101.0, 2), (20.0, 3), (21.0, 4)):
        buffer.add(transform(stamp, "odom", "base", planar(x, 0, 0)), 0.0, False)
    np.testing.assert_allclose(buffer.at("odom", "base", 20.5), planar(3.5, 0, 0))


@pytest.mark.parametrize(
    ("parent", "child", "pose", "static", "reason"),
    [
        ("", "base", planar(0, 0, 0), False, "without a frame"),
        ("base", "base", planar(0, 0, 0), False, "to itself"),
        ("odom", "base", planar(np.nan, 0, 0), False, "pose is invalid"),
        ("odom", "base", planar(9, 0, 0), False, "older"),
        ("world", "base", planar(9, 0, 0), False, "another parent"),
        ("odom", "base", planar(9, 0, 0), True, "also has a moving one"),
    ],
)
def test_what_cannot_be_used_is_refused_and_changes_nothing(parent, child, pose, static, reason):
    buffer = TfBuffer()
    for stamp in (10.0, 11.0):
        buffer.add(transform(stamp, "odom", "base", planar(stamp, 0, 0)), 0.0, False)
    with pytest.raises(ValueError, match=reason):
        buffer.add(transform(10.5, parent, child, pose), 0.0, static)
    np.testing.assert_allclose(buffer.at("odom", "base", 10.5), planar(10.5, 0, 0), atol=1e-12)


def test_memory_is_bounded():
    buffer, message = TfBuffer(), transform(0.0, "odom", "base", planar(0, 0, 0))
    for k in range(13_000):
        message.header.stamp.sec, message.header.stamp.nanosec = k // 2000, k % 2000 * 500_000
        message.transform.translation.x = float(k)
        buffer.add(message, 0.0, False)
    assert len(buffer._edges["base"].stamps) < 10_500
    np.testing.assert_allclose(buffer.at("odom", "base", 12_998 / 2000), planar(12_998, 0, 0))


@settings(max_examples=150)
@given(
    st.lists(
        st.tuples(
            st.sampled_from("abcd"), st.sampled_from("abcd"), st.floats(0, 50), st.floats(allow_nan=True), st.booleans()
        ),
        max_size=40,
    )
)
def test_no_sequence_of_transforms_breaks_it(feed):
    buffer = TfBuffer()
    for parent, child, stamp, x, static in feed:
        try:
            buffer.add(transform(stamp, parent, child, planar(x, 0, 0)), 1.0, static)
        except ValueError:
            continue
    for a in "abcd":
        for b in "abcd":
            try:
                pose = buffer.at(a, b, 25.0)
            except UnknownTransform:
                continue
            assert np.isfinite(pose).all()


def test_the_base_is_found_as_among_all_frames():
    """Frames get other parents, so some frames vanish again."""
    rng = np.random.default_rng(0)
    names = ["odom", "base_link", "base_footprint", "a/base_link", "b/base_footprint", "camera", "arm", "c"]
    for _ in range(30):
        buffer, parents = TfBuffer(), {}
        for step in range(40):
            parent, child = rng.choice(names, 2, replace=False).tolist()
            buffer.add(transform(100.0 * step + 1, parent, child, np.eye(4)), 0.0, True)
            parents[child] = parent
            frames = set(parents) | set(parents.values())
            assert buffer.frames == frames
            for moved in ("", "arm", "base_link", "unknown"):
                assert find_base(buffer.likely_bases(moved), None, moved) == find_base(frames, None, moved)
