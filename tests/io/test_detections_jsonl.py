import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from objslam.core.diagnostics import Ledger
from objslam.core.types import Detections, label_table
from objslam.errors import LogError
from objslam.io.detections_jsonl import read_detections, write_detections

_GOOD = {"stamp": 1.0, "boxes": [[1, 2, 3, 4]], "labels": ["cup"], "scores": [0.5]}
_LABELS = st.text(st.characters(codec="utf-8"), min_size=1, max_size=8).filter(lambda t: t.isprintable() and t.strip())
_BOX = st.tuples(
    st.floats(-1e4, 1e4),
    st.floats(-1e4, 1e4),
    st.floats(1e-3, 1e4),
    st.floats(1e-3, 1e4),
    _LABELS,
    st.floats(0, 1),
    st.one_of(st.just(np.nan), st.floats(1e-3, 1e3)),
    st.integers(-1, 2**62),
)


def _detections(frames):
    stamps = [stamp for stamp, _ in frames]
    rows = [(index, *box) for index, (_, boxes) in enumerate(frames) for box in boxes]
    names, label = label_table([row[5] for row in rows])
    corners = np.array([row[1:5] for row in rows], dtype=float).reshape(-1, 4)
    corners[:, 2:] += corners[:, :2]
    return Detections(
        frame_stamps=np.array(stamps, dtype=float),
        frame=np.array([row[0] for row in rows], dtype=np.int64),
        boxes=corners,
        label=label,
        scores=np.array([row[6] for row in rows], dtype=float),
        depths=np.array([row[7] for row in rows], dtype=float),
        track_ids=np.array([row[8] for row in rows], dtype=np.int64),
        label_names=names,
    )


def _read(tmp_path, *frames):
    file = tmp_path / "detections.jsonl"
    file.write_text("\n".join(f if isinstance(f, str) else json.dumps(f) for f in frames), encoding="utf-8")
    ledger = Ledger()
    return read_detections(file, ledger), ledger, file


@given(
    st.lists(
        st.tuples(st.floats(0, 2e9), st.lists(_BOX, max_size=4)), min_size=1, max_size=8, unique_by=lambda frame: frame[0]
    ).map(sorted)
)
def test_written_detections_read_back_to_the_last_bit(frames):
    detections = _detections(frames)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "detections.jsonl")
        write_detections(detections, file)
        ledger = Ledger()
        read = read_detections(file, ledger)
    assert not ledger.lines()
    assert read.label_names == detections.label_names
    for name in ("frame_stamps", "frame", "boxes", "label", "scores", "depths", "track_ids"):
        np.testing.assert_array_equal(getattr(read, name), getattr(detections, name), strict=True)


def test_optional_lists_are_left_out_where_nothing_is_known(tmp_path):
    file = tmp_path / "detections.jsonl"
    write_detections(_detections([(1.0, [(0, 0, 9, 9, "cup", 0.5, np.nan, -1)]), (2.0, [])]), file)
    assert [json.loads(line) for line in file.read_text().splitlines()] == [
        {"stamp": 1.0, "boxes": [[0.0, 0.0, 9.0, 9.0]], "labels": ["cup"], "scores": [0.5]},
        {"stamp": 2.0, "boxes": [], "labels": [], "scores": []},
    ]


def test_whole_is_kept_and_holds_where_every_frame_says_so(tmp_path):
    file = tmp_path / "detections.jsonl"
    write_detections(replace(_detections([(1.0, [(0, 0, 9, 9, "tag_1", 1.0, np.nan, -1)]), (2.0, [])]), whole=True), file)
    assert read_detections(file, Ledger()).whole
    with file.open("a") as lines:
        lines.write(json.dumps(_GOOD | {"stamp": 3.0}))
    assert not read_detections(file, Ledger()).whole


def test_corners_are_read_back_and_those_of_no_square_are_unknown(tmp_path):
    square, bow_tie = [[1, 1], [9, 2], [8.5, 9], [1, 8]], [[1, 1], [9, 9], [9, 1], [1, 9]]
    frame = {"stamp": 1.0, "boxes": [[0, 0, 9, 9]] * 4, "labels": ["tag_1"] * 4, "scores": [1, 1, 1, 1]}
    corners = [square, None, bow_tie, square[::-1]]
    detections, ledger, _ = _read(tmp_path, frame | {"corners": corners})
    assert ledger.dropped == {"corners that do not form a square (taken as unknown)": 1}
    assert np.isnan(detections.corners[1:3]).all()
    assert detections.corners[0].tolist() == square
    assert detections.corners[3].tolist() == square[::-1]
    file = tmp_path / "again.jsonl"
    write_detections(detections, file)
    np.testing.assert_array_equal(read_detections(file, Ledger()).corners, detections.corners, strict=True)
    assert detections.take(np.array([0, 3])).corners.shape == (2, 4, 2)
    write_detections(detections.take(np.array([1])), file)
    assert "corners" not in file.read_text()


def test_a_frame_as_the_format_describes_it(tmp_path):
    frame = {"stamp": 12.5, "boxes": [[1, 2, 30, 40], [5, 6, 7, 8.5]], "labels": ["cup", "Tür"], "scores": [0.9, 1]}
    detections, ledger, _ = _read(tmp_path, "# comment", frame | {"depths": [1.2, None], "track_ids": [None, 3], "more": 1})
    assert detections.label_names == ("Tür", "cup")
    assert detections.label.tolist() == [1, 0]
    assert detections.boxes.tolist() == [[1, 2, 30, 40], [5, 6, 7, 8.5]]
    assert detections.depths[0] == 1.2
    assert np.isnan(detections.depths[1])
    assert detections.track_ids.tolist() == [-1, 3]
    assert not ledger.lines()


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        ('{"stamp": 2.0, "boxes": [[1, 2, 3', "not JSON"),
        ("[" * 100_000, "not JSON"),
        ('{"stamp": ' + "9" * 5000 + "}", "not JSON"),
        ("\x00" * 50, "not JSON"),
        ("[1, 2]", "not a JSON object"),
        ("3", "not a JSON object"),
        ({k: v for k, v in _GOOD.items() if k != "stamp"}, "stamp is missing"),
        (_GOOD | {"stamp": "2"}, "stamp must hold numbers only"),
        (_GOOD | {"stamp": True}, "stamp must hold numbers only"),
        (_GOOD | {"stamp": None}, "stamp must hold numbers only"),
        (_GOOD | {"stamp": 10**400}, "stamp holds an integer beyond the range of floats"),
        (_GOOD | {"stamp": float("nan")}, "stamp is not a finite number"),
        (_GOOD | {"stamp": float("inf")}, "stamp is not a finite number"),
        ({k: v for k, v in _GOOD.items() if k != "boxes"}, "boxes is missing or not a list"),
        ({k: v for k, v in _GOOD.items() if k != "labels"}, "labels is missing or not a list"),
        ({k: v for k, v in _GOOD.items() if k != "scores"}, "scores is missing or not a list"),
        (_GOOD | {"boxes": {"0": [1, 2, 3, 4]}}, "boxes is missing or not a list"),
        (_GOOD | {"boxes": [1, 2, 3, 4]}, "boxes must hold lists x1, y1, x2, y2"),
        (_GOOD | {"boxes": [[1, 2, 3, "4"]]}, "a box must hold numbers only"),
        (_GOOD | {"boxes": [[1, 2, 3, True]]}, "a box must hold numbers only"),
        (_GOOD | {"boxes": [[1, 2, 3, 10**400]]}, "a box holds an integer beyond the range of floats"),
        (_GOOD | {"boxes": [[1, 2, 3]]}, "a box is not 4 numbers"),
        (_GOOD | {"labels": "c"}, "labels is missing or not a list"),
        (_GOOD | {"labels": ["a", "b"]}, "boxes, labels, scores, depths and track_ids differ in length"),
        (_GOOD | {"scores": []}, "boxes, labels, scores, depths and track_ids differ in length"),
        (_GOOD | {"scores": ["high"]}, "scores must hold numbers only"),
        (_GOOD | {"depths": []}, "boxes, labels, scores, depths and track_ids differ in length"),
        (_GOOD | {"depths": None}, "depths is missing or not a list"),
        (_GOOD | {"depths": ["1.2"]}, "depths must hold numbers only"),
        (_GOOD | {"track_ids": [1, 2]}, "boxes, labels, scores, depths and track_ids differ in length"),
        (_GOOD | {"corners": []}, "boxes and corners differ in length"),
        (_GOOD | {"corners": [[[1, 2], [3, 4], [5, 6]]]}, "corners must hold four points x, y each, and null only"),
        (_GOOD | {"corners": [[1, 2, 3, 4]]}, "a corner must hold numbers only"),
        (_GOOD | {"corners": [[[1], [2], [3], [4]]]}, "a corner is not 2 numbers"),
        (_GOOD | {"track_ids": [1.5]}, "track_ids must hold integers and null only"),
        (_GOOD | {"track_ids": [2**63]}, "track_ids must hold integers and null only"),
        (
            {"stamp": 2, "boxes": [[1, 2, 3, 4]] * 10_001, "labels": ["c"] * 10_001, "scores": [1] * 10_001},
            "more than 10000 boxes",
        ),
        (_GOOD | {"whole": 1}, "whole is neither true nor false"),
    ],
)
def test_a_malformed_frame_is_dropped_and_named(tmp_path, frame, reason):
    detections, ledger, file = _read(tmp_path, _GOOD, "", frame, _GOOD | {"stamp": 3.0})
    assert detections.frame_stamps.tolist() == [1.0, 3.0]
    assert len(detections) == 2
    assert ledger.dropped == {f"detection frame malformed: {reason}": 1}
    assert ledger.examples[f"detection frame malformed: {reason}"] == [f"{file}:3"]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"boxes": [[1, 2, float("nan"), 4]]}, "box with a corner that is not finite or too large"),
        ({"boxes": [[1, 2, float("inf"), 4]]}, "box with a corner that is not finite or too large"),
        ({"boxes": [[3, 2, 3, 4]]}, "box without area (x2 <= x1 or y2 <= y1)"),
        ({"boxes": [[1, 4, 3, 2]]}, "box without area (x2 <= x1 or y2 <= y1)"),
        ({"scores": [1.5]}, "box with a score outside 0 to 1"),
        ({"scores": [-0.1]}, "box with a score outside 0 to 1"),
        ({"scores": [float("nan")]}, "box with a score outside 0 to 1"),
        ({"labels": [" "]}, "box with a label that is no printable text"),
        ({"labels": ["a\nb"]}, "box with a label that is no printable text"),
        ({"labels": ["\ud800"]}, "box with a label that is no printable text"),
        ({"labels": [None]}, "box with a label that is no printable text"),
        ({"labels": [["cup"]]}, "box with a label that is no printable text"),
        ({"labels": [1.5]}, "box with a label that is no printable text"),
    ],
)
def test_a_bad_box_is_dropped_and_its_frame_stays(tmp_path, change, reason):
    both = {name: [*_GOOD[name], *change.get(name, _GOOD[name])] for name in ("boxes", "labels", "scores")}
    detections, ledger, file = _read(tmp_path, _GOOD, {"stamp": 2.0} | both, _GOOD | change | {"stamp": 3.0})
    assert detections.frame_stamps.tolist() == [1.0, 2.0, 3.0]
    assert detections.frame.tolist() == [0, 1]
    assert detections.boxes.tolist() == [[1, 2, 3, 4]] * 2
    assert detections.label_names == ("cup",)
    assert ledger.dropped == {reason: 2}
    assert ledger.examples[reason] == [f"{file}:2", f"{file}:3"]


@pytest.mark.parametrize("depth", [0, -1.5, float("nan"), float("inf")])
def test_a_depth_that_cannot_be_is_unknown_and_counted(tmp_path, depth):
    detections, ledger, file = _read(tmp_path, _GOOD | {"depths": [depth]}, _GOOD | {"stamp": 2.0, "depths": [None]})
    assert np.isnan(detections.depths).all()
    assert len(detections) == 2
    assert ledger.dropped == {"depth of a box that is not above zero or too large (taken as unknown)": 1}
    assert next(iter(ledger.examples.values())) == [f"{file}:1"]


def test_stamps_that_repeat_or_go_back_drop_the_frame_with_its_boxes_uncounted(tmp_path):
    bad_box = {"boxes": [[3, 2, 1, 4]]}
    frames = [_GOOD | {"stamp": s, "scores": [s / 10]} for s in (1, 2, 3)]
    detections, ledger, file = _read(
        tmp_path, *frames, _GOOD | {"stamp": 3}, _GOOD | {"stamp": 2.5} | bad_box, _GOOD | {"stamp": 4, "scores": [0.4]}
    )
    assert detections.frame_stamps.tolist() == [1, 2, 3, 4]
    assert detections.scores.tolist() == [0.1, 0.2, 0.3, 0.4]
    assert detections.frame.tolist() == [0, 1, 2, 3]
    assert ledger.dropped == {"detection frame with a stamp that repeats or goes back": 2}
    assert next(iter(ledger.examples.values())) == [f"{file}:4", f"{file}:5"]


def test_frames_from_the_last_to_the_first_are_refused(tmp_path):
    with pytest.raises(LogError, match="3 of its 4 stamps repeat or go back"):
        _read(tmp_path, *(_GOOD | {"stamp": stamp} for stamp in (4, 3, 2, 1)))


@pytest.mark.parametrize("content", [b"", b"\n\n", b"{}\n[]\n", b"\xff\xfe{\x00", b"\x00" * 1000])
def test_no_usable_frame_is_an_error_that_names_the_file(tmp_path, content):
    file = tmp_path / "detections.jsonl"
    file.write_bytes(content)
    with pytest.raises(LogError, match="detection frame") as caught:
        read_detections(file, Ledger())
    assert caught.value.where == str(file)


@pytest.mark.parametrize(
    ("text", "why", "hint"),
    [
        (
            3 * '\n{"stamp": 1, "boxes": [[1, 2, 3, 4]], "scores": [1]}',
            "labels is missing or not a list",
            '"labels": ["cup"]',
        ),
        (
            '{"stamp": 1, "boxes": [1, 2, 3, 4], "labels": ["a"], "scores": [1]}',
            "boxes must hold lists",
            "[[x1, y1, x2, y2]]",
        ),
        ('[\n {"stamp": 1},\n {"stamp": 2}\n]', "one JSON list", "one frame a line"),
        ('[\n{"stamp": 1},\n{"stamp": 2, "boxes": [], "labels": [], "scores": []}\n]', "one JSON list", "one frame a line"),
        ('[{"stamp": 1}]', "not a JSON object", "one frame a line"),
    ],
)
def test_a_file_without_a_good_line_says_why(tmp_path, text, why, hint):
    file = tmp_path / "detections.jsonl"
    file.write_text(text)
    with pytest.raises(LogError) as caught:
        read_detections(file, Ledger())
    assert caught.value.where == str(file)
    assert why in caught.value.message
    assert hint in caught.value.hint


def test_a_detector_that_numbers_its_classes_has_labels(tmp_path):
    detections, ledger, _ = _read(tmp_path, _GOOD | {"labels": [7]}, _GOOD | {"stamp": 2.0, "labels": [56]})
    assert detections.label_names == ("56", "7")
    assert ledger.lines() == []


def test_a_key_that_is_probably_misspelt_is_named_once(tmp_path):
    """A key that resembles none may be of another program."""
    odd = {"depth": [1.5], "trackids": [3], "image": "a.png"}
    _, ledger, file = _read(tmp_path, _GOOD | odd, _GOOD | odd | {"stamp": 2.0})
    assert ledger.lines() == [
        f"{file}: the key 'depth' is not known, and is not read (did you mean 'depths'?)",
        f"{file}: the key 'trackids' is not known, and is not read (did you mean 'track_ids'?)",
    ]


def test_the_share_of_malformed_frames_is_told(tmp_path):
    _, ledger, file = _read(tmp_path, _GOOD, _GOOD | {"scores": []}, "", _GOOD | {"stamp": 3.0})
    reason = "detection frame malformed: boxes, labels, scores, depths and track_ids differ in length"
    assert ledger.lines() == [f"dropped 1 of 3 (33 %): {reason} (first: {file}:2)"]
