import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from objslam.core.diagnostics import Ledger
from objslam.core.geometry import make_pose
from objslam.errors import LogError
from objslam.ros.tf.tree import TfRows, TfTree


def _pose(seed):
    rng = np.random.default_rng(seed)
    return make_pose(Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3))


def _tree(maker, *messages, ledger=None):
    """messages: (static, stamp ns, transforms (parent, child, pose))."""
    rows = TfRows()
    for static, stamp, *transforms in messages:
        for transform in maker.tf(stamp, *transforms).transforms:
            rows.add(transform, stamp, static)
    return TfTree(rows, ledger or Ledger())


@settings(max_examples=20)
@given(st.integers(0, 10**6))
def test_a_still_chain_is_the_product_of_its_links(makers, seed):
    a, b, c, d = (_pose(seed + i) for i in range(4))
    links = ("base", "arm", a), ("arm", "hand", b), ("hand", "eye", c), ("base", "laser", d)
    tree = _tree(makers["4"], (True, 0, *links))
    np.testing.assert_allclose(tree.still("base", "eye"), a @ b @ c, atol=1e-12)
    np.testing.assert_allclose(tree.still("eye", "base"), np.linalg.inv(a @ b @ c), atol=1e-12)
    np.testing.assert_allclose(tree.still("laser", "eye"), np.linalg.inv(d) @ a @ b @ c, atol=1e-12)
    np.testing.assert_allclose(tree.still("arm", "arm"), np.eye(4), atol=1e-12)
    assert tree.chain("laser", "eye") == ("laser", "base", "arm", "hand", "eye")
    assert tree.chain("base", "eye") == ("base", "arm", "hand", "eye")


def test_a_leading_slash_is_the_same_frame(makers):
    tree = _tree(makers["1"], (True, 0, ("/base", "/eye", _pose(1))))
    np.testing.assert_allclose(tree.still("base", "eye"), _pose(1), atol=1e-12)


def test_a_moving_link_is_interpolated(makers):
    start, end = _pose(1), _pose(2)
    moving = [(False, 10**9, ("base", "arm", start)), (False, 2 * 10**9, ("base", "arm", end))]
    tree = _tree(makers["4"], *moving, (True, 0, ("arm", "eye", _pose(3))))
    assert tree.still("base", "eye") is None
    assert tree.stamps("base", "eye").tolist() == [1.0, 2.0]
    poses, known = tree.at("base", "eye", np.array([0.5, 1.0, 1.25, 2.0, 2.5]))
    assert known.tolist() == [False, True, True, True, False]
    np.testing.assert_allclose(poses[1], start @ _pose(3), atol=1e-12)
    np.testing.assert_allclose(poses[3], end @ _pose(3), atol=1e-12)
    between = poses[2] @ np.linalg.inv(_pose(3))
    turns = Rotation.from_matrix([start[:3, :3], end[:3, :3]])
    np.testing.assert_allclose(between[:3, :3], Slerp([0, 1], turns)(0.25).as_matrix(), atol=1e-12)


def test_the_latest_of_several_static_transforms_holds_and_order_does_not_matter_for_moving_ones(makers):
    tree = _tree(makers["4"], (True, 5, ("base", "eye", _pose(1))), (True, 9, ("base", "eye", _pose(2))))
    np.testing.assert_allclose(tree.still("base", "eye"), _pose(2), atol=1e-12)
    late_first = [(False, s * 10**9, ("base", "arm", _pose(s))) for s in (3, 1, 2, 2)]
    tree = _tree(makers["4"], *late_first)
    assert tree.stamps("base", "arm").tolist() == [1.0, 2.0, 3.0]


def test_a_transform_that_is_sent_again_and_again_is_still(makers):
    tree = _tree(makers["4"], *((False, s * 10**9, ("base", "eye", _pose(1))) for s in range(1, 9)))
    np.testing.assert_allclose(tree.still("base", "eye"), _pose(1), atol=1e-12)


def test_a_missing_link_names_both_parts(makers):
    links = [("odom", "base_link", _pose(1)), ("base_link", "laser", _pose(2)), ("camera_link", "camera_optical", _pose(3))]
    tree = _tree(makers["4"], (True, 0, *links))
    with pytest.raises(LogError) as caught:
        tree.still("base_link", "camera_optical")
    assert "'base_link' is connected only to laser, odom" in str(caught.value)
    assert "'camera_optical' is connected only to camera_link" in str(caught.value)
    with pytest.raises(LogError, match="'eye' is in no transform"):
        tree.still("base_link", "eye")
    many = _tree(makers["4"], (True, 0, *(("base", f"part_{i}", np.eye(4)) for i in range(100))))
    with pytest.raises(LogError, match="and 94 more"):
        many.still("base", "eye")


def test_a_tree_that_runs_in_a_circle(makers):
    tree = _tree(makers["4"], (True, 0, ("a", "b", np.eye(4)), ("b", "c", np.eye(4)), ("c", "a", np.eye(4))))
    with pytest.raises(LogError, match="runs in a circle: "):
        tree.still("a", "c")
    long = [(f"f{i}", f"f{i + 1}", np.eye(4)) for i in range(5000)] + [("f5000", "f0", np.eye(4))]
    tree = _tree(makers["4"], (True, 0, *long))
    with pytest.raises(LogError, match="circle") as caught:
        tree.still("f0", "f1")
    assert len(str(caught.value)) < 300


def test_a_frame_of_itself_and_frames_without_a_name_are_refused(makers):
    ledger = Ledger()
    links = ("a", "a", np.eye(4)), ("", "b", np.eye(4)), ("a", "", np.eye(4)), ("a", "b", _pose(1))
    tree = _tree(makers["4"], (True, 0, *links), ledger=ledger)
    np.testing.assert_allclose(tree.still("a", "b"), _pose(1), atol=1e-12)
    assert ledger.dropped == {"transform without a frame, or of a frame to itself": 3}


def test_no_more_pairs_of_frames_than_any_robot_has(makers):
    ledger = Ledger()
    links = (("a", f"b{i}", np.eye(4)) for i in range(10_005))
    _tree(makers["4"], (True, 0, *links), ledger=ledger)
    assert ledger.dropped == {"transform beyond the first 10000 pairs of frames": 5}


def test_of_two_parents_the_one_that_most_transforms_name(makers):
    ledger = Ledger()
    messages = [(False, s * 10**9, ("odom", "base", _pose(s))) for s in range(1, 5)]
    tree = _tree(makers["4"], *messages, (False, 10**9, ("map", "base", _pose(9))), ledger=ledger)
    assert tree.above("base") == ("base", "odom")
    tree.at("odom", "base", np.ones(1))
    assert "several parents" in ledger.warnings[0]


def test_what_is_no_pose_is_dropped(makers):
    ledger = Ledger()
    bad = np.eye(4)
    bad[0, 3] = np.nan
    messages = [
        (False, 10**9, ("a", "b", _pose(1))),
        (False, 2 * 10**9, ("a", "b", bad)),
        (False, 3 * 10**9, ("a", "b", _pose(2))),
    ]
    tree = _tree(makers["4"], *messages, ledger=ledger)
    assert tree.stamps("a", "b").tolist() == [1.0, 3.0]
    assert list(ledger.dropped.values()) == [1]
    with pytest.raises(LogError, match="no usable transform a -> b"):
        _tree(makers["4"], (True, 0, ("a", "b", bad))).still("a", "b")


def test_a_long_silence_is_not_bridged(makers):
    messages = [(False, s * 10**9, ("a", "b", _pose(s))) for s in (1, 2, 20, 21)]
    _, known = _tree(makers["4"], *messages).at("a", "b", np.array([1.5, 10.0, 20.5]))
    assert known.tolist() == [True, False, True]
