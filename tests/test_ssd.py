"""The training of the shipped detector, and the shipped detector itself."""

import json
import sys
from itertools import product
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

PROJECT = Path(__file__).parents[1]
sys.path.insert(0, str(PROJECT / "tools"))

from ssd.boxes import LEVELS, PER_CELL, corners, decode, default_boxes, encode, match, overlap, suppress  # noqa: E402
from ssd.data import Samples, load_samples, render_room, render_samples  # noqa: E402
from ssd.evaluate import average_precision, measure, select, to_input  # noqa: E402
from ssd.export import export, parity, run_onnx  # noqa: E402
from ssd.loss import NEGATIVES_AT_LEAST, hardest, ssd_loss  # noqa: E402
from ssd.model import Ssd  # noqa: E402
from ssd.train import augment, rate_at  # noqa: E402

from objslam import config  # noqa: E402
from objslam.detection.detector import load_detector  # noqa: E402
from objslam.simulation.shapes import LABELS  # noqa: E402

SMALL = (96, 64)
MODEL = PROJECT / "objslam" / "detection" / "models" / "ssd7.onnx"


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def some_boxes(rng, count, size=(320, 240)):
    middle, half = rng.uniform(0, 1, (count, 2)) * size, np.exp(rng.uniform(1.0, 4.0, (count, 2)))
    return torch.from_numpy(np.concatenate([middle - half, middle + half], axis=1)).float()


def plain_overlap(a, b):
    """Intersection over union of two boxes, by the book."""
    width = max(0.0, min(a[2], b[2]) - max(a[0], b[0]))
    height = max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
    union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - width * height
    return width * height / union


def truth(boxes, labels, counts=None):
    boxes = torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4)
    counts = torch.ones(len(boxes), dtype=torch.bool) if counts is None else torch.tensor(counts)
    return boxes, torch.tensor(labels, dtype=torch.int64), counts


def samples_of(images, rows):
    """Samples with rows (image, box, label, counts)."""
    image, boxes, label, counts = zip(*rows, strict=True)
    return Samples(images, np.array(image), np.array(boxes, dtype=np.float32), np.array(label), np.array(counts))


def painted(seed=0):
    """Two images of squares on noise: a red one and a blue one in each."""
    rng = np.random.default_rng(seed)
    images = rng.integers(90, 130, (2, SMALL[1], SMALL[0], 3), dtype=np.uint8)
    rows = []
    for number, label in product(range(2), range(2)):
        x, y = 10 + 45 * label, 8 + 25 * number
        images[number, y : y + 20, x : x + 20] = (220, 20, 20) if label == 0 else (20, 20, 220)
        rows.append((number, (x, y, x + 20, y + 20), label, True))
    return samples_of(images, rows)


def test_default_boxes_cover_the_image_and_come_in_the_order_of_the_network():
    boxes = default_boxes((320, 240))
    cells = [(40, 30), (20, 15), (10, 8)]
    assert len(boxes) == PER_CELL * sum(columns * rows for columns, rows in cells)
    first = boxes[: PER_CELL * 40 * 30].reshape(30, 40, PER_CELL, 4)
    np.testing.assert_allclose(first[7, 11, :, :2], np.tile([11.5 * 8, 7.5 * 8], (PER_CELL, 1)))
    np.testing.assert_allclose(first[0, 0, 0, 2:], [LEVELS[0].small] * 2)
    area = first[0, 0, :, 2:].prod(dim=1)
    np.testing.assert_allclose(area, [LEVELS[0].small ** 2] * 3 + [LEVELS[0].large ** 2] * 3, rtol=1e-5)
    logits, offsets = Ssd(3, (320, 240)).eval()(torch.zeros(1, 3, 240, 320))
    assert logits.shape == (1, len(boxes), 4)
    assert offsets.shape == (1, len(boxes), 4)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_decode_undoes_encode(seed):
    rng = np.random.default_rng(seed)
    defaults = default_boxes(SMALL)[rng.permutation(200)[:50]]
    boxes = some_boxes(rng, len(defaults), SMALL)
    torch.testing.assert_close(decode(encode(boxes, defaults), defaults), boxes, rtol=1e-4, atol=1e-2)


def test_encode_is_the_papers():
    offsets = encode(torch.tensor([[10.0, 20.0, 30.0, 60.0]]), torch.tensor([[18.0, 44.0, 10.0, 20.0]]))
    expected = [(20 - 18) / 10 / 0.1, (40 - 44) / 20 / 0.1, np.log(2) / 0.2, np.log(2) / 0.2]
    np.testing.assert_allclose(offsets[0], expected, rtol=1e-5)


def test_overlap_is_intersection_over_union():
    rng = np.random.default_rng(3)
    a, b = some_boxes(rng, 20), some_boxes(rng, 30)
    expected = [[plain_overlap(p, q) for q in b.tolist()] for p in a.tolist()]
    np.testing.assert_allclose(overlap(a, b), expected, atol=1e-5)


def test_matching_takes_what_overlaps_and_leaves_out_what_is_in_between():
    defaults = default_boxes(SMALL)
    boxes, labels, counts = truth([[40, 20, 60, 38]], [2])
    target, offsets = match(defaults, boxes, labels, counts)
    share = overlap(corners(defaults), boxes)[:, 0]
    assert (target[share >= 0.4] == 3).all()
    assert (target[(share >= 0.3) & (share < 0.4)] == -1).all()
    assert (target[share < 0.3] == 0).all()
    found = target > 0
    assert found.sum() >= 3
    torch.testing.assert_close(decode(offsets, defaults)[found], boxes.expand(int(found.sum()), 4), rtol=1e-4, atol=1e-3)


def test_every_object_has_a_default_box_and_those_that_do_not_count_have_none():
    defaults = default_boxes(SMALL)
    boxes, labels, counts = truth([[1, 1, 4, 5], [30, 10, 50, 30], [60, 30, 90, 50]], [0, 1, 1], [True, True, False])
    target, _ = match(defaults, boxes, labels, counts)
    assert set(target.tolist()) == {-1, 0, 1, 2}
    assert (target == 1).sum() == 1  # far smaller than any default box: the closest takes it
    on_the_last = overlap(corners(defaults), boxes)[:, 2] >= 0.3
    assert (target[on_the_last] == -1).all()
    assert (match(defaults, *truth([], []))[0] == 0).all()


def test_suppression_keeps_the_best_and_what_lies_apart():
    rng = np.random.default_rng(5)
    boxes, scores = some_boxes(rng, 60, (120, 90)), torch.from_numpy(rng.random(60))
    kept = suppress(boxes, scores, 0.3).tolist()
    assert 3 < len(kept) < 55
    assert scores[kept].tolist() == sorted(scores[kept].tolist(), reverse=True)
    assert all(plain_overlap(boxes[i].tolist(), boxes[j].tolist()) <= 0.3 for i in kept for j in kept if i < j)
    for i in set(range(60)) - set(kept):
        better = [j for j in kept if scores[j] >= scores[i]]
        assert any(plain_overlap(boxes[i].tolist(), boxes[j].tolist()) > 0.3 for j in better)


def test_selection_suppresses_within_a_class_only():
    boxes = torch.tensor([[0.0, 0, 10, 10], [0, 0, 10, 11], [40, 40, 50, 50]])
    found, labels, scores = select(boxes, torch.tensor([[0.9, 0.8, 0.01], [0.1, 0.7, 0.6]]))
    assert labels.tolist() == [0, 1, 1]
    np.testing.assert_allclose(scores, [0.9, 0.7, 0.6], rtol=1e-6)
    assert found.tolist() == [boxes[0].tolist(), boxes[1].tolist(), boxes[2].tolist()]


def test_hard_negatives_are_the_worst_of_the_background():
    rng = np.random.default_rng(0)
    losses = torch.from_numpy(rng.random((2, 400)))
    target = torch.zeros(2, 400, dtype=torch.int64)
    target[0, :20], target[:, 20:40] = 1, -1
    chosen = hardest(losses, target)
    assert chosen.sum(dim=1).tolist() == [60, NEGATIVES_AT_LEAST]
    assert (target[chosen] == 0).all()
    for row in range(2):
        rest = (target[row] == 0) & ~chosen[row]
        assert losses[row][chosen[row]].min() >= losses[row][rest].max()


def test_the_loss_is_small_where_the_network_is_right_and_counts_no_ignored_box():
    target = torch.tensor([[1, 0, -1, 2]])
    right = torch.nn.functional.one_hot(target.clamp(min=0), 3) * 20.0
    right[0, 2] = torch.tensor([-20.0, 20.0, 0.0])  # whatever it says there
    offsets = torch.ones(1, 4, 4)
    classes, boxes = ssd_loss(right, offsets, target, offsets)
    assert classes < 1e-6
    assert boxes == 0
    classes, boxes = ssd_loss(-right, offsets + 2.0, target, offsets)
    assert classes > 20
    assert boxes == pytest.approx(4 * (2 - 0.25))  # smooth L1 with beta 0.5, 4 numbers a box


@pytest.fixture(scope="module")
def fitted():
    """A small network after 60 steps on two images, the images, and the losses (classes, boxes) of all steps."""
    torch.manual_seed(0)
    data = painted()
    network = Ssd(2, SMALL, width=16)
    pairs = [match(network.defaults, *(torch.from_numpy(a) for a in data.of(i))) for i in range(2)]
    target, target_offsets = (torch.stack(column) for column in zip(*pairs, strict=True))
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3)
    losses = []
    for _ in range(60):
        logits, offsets = network(to_input(data.images))
        classes, boxes = ssd_loss(logits, offsets, target, target_offsets)
        optimiser.zero_grad()
        (classes + boxes).backward()
        optimiser.step()
        losses.append([classes.item(), boxes.item()])
    return network, data, np.array(losses)


def test_twenty_steps_on_two_images_lower_the_loss(fitted):
    _, _, losses = fitted
    assert (losses[19] < 0.5 * losses[0]).all()


def test_onnxruntime_finds_in_the_exported_model_what_torch_finds(fitted, tmp_path):
    network, data, _ = fitted
    file = tmp_path / "small.onnx"
    export(network, ("red", "blue"), file, {"author": "test"})
    box, score = parity(network, file, data.images)
    assert box < 1e-2
    assert score < 1e-4
    quality = measure(run_onnx(file, data.images), data, 2)
    assert quality.precision.tolist() == [1.0, 1.0]
    assert quality.recall == 1.0
    detector = load_detector(file, config.Detector())
    assert detector.recipe.names == ("red", "blue")
    found = detector.detect([np.ascontiguousarray(image[..., ::-1]) for image in data.images])
    for number, boxes in enumerate(found):
        best = {label: box for box, label in zip(boxes.boxes[::-1], boxes.labels[::-1], strict=True)}
        true, label, _ = data.of(number)
        for box, name in zip(true, label, strict=True):
            np.testing.assert_allclose(best[("red", "blue")[name]], box, atol=3.0)


def test_parity_notices_another_network(fitted, tmp_path):
    network, data, _ = fitted
    export(network, ("red", "blue"), tmp_path / "small.onnx", {})
    torch.manual_seed(5)
    with pytest.raises(AssertionError, match="do not find the same boxes"):
        parity(Ssd(2, SMALL, width=16), tmp_path / "small.onnx", data.images)


@pytest.mark.parametrize("seed", range(6))
def test_augmented_boxes_stay_on_their_squares(seed):
    data = painted()
    image, boxes, label, counts = augment(data.images[0], *data.of(0), np.random.default_rng(seed))
    assert image.shape == data.images[0].shape
    for box, mine, whole in zip(boxes, label, counts, strict=True):
        x1, y1, x2, y2 = np.round(box).astype(int)
        inside = image[y1 + 2 : y2 - 2, x1 + 2 : x2 - 2].astype(int)
        ours, other = (0, 2) if mine == 0 else (2, 0)
        if whole and inside.size:
            assert (inside[..., ours] > inside[..., other] + 50).mean() > 0.95
            grown = image[max(y1 - 3, 0) : y2 + 3, max(x1 - 3, 0) : x2 + 3].astype(int)
            red = grown[..., ours] > grown[..., other] + 50
            assert red.mean() < 0.98  # the box ends where the square does


def test_average_precision_by_hand():
    score, right = np.array([0.9, 0.8, 0.7, 0.6]), np.array([True, False, True, True])
    # recall 1/4 at precision 1, then 2/4 and 3/4 under the envelope of 3/4; the fourth object is never found
    assert average_precision(score, right, 4) == pytest.approx(0.25 * (1 + 0.75 + 0.75))
    assert average_precision(np.zeros(0), np.zeros(0, bool), 3) == 0.0


def test_quality_counts_doubles_as_false_and_leaves_out_what_does_not_count():
    images = np.zeros((1, 100, 100, 3), dtype=np.uint8)
    data = samples_of(
        images, [(0, (10, 10, 30, 30), 0, True), (0, (60, 60, 80, 80), 0, False), (0, (10, 60, 30, 80), 1, True)]
    )
    boxes = torch.tensor([[11.0, 10, 31, 30], [10, 12, 30, 32], [60, 60, 80, 80], [10, 60, 30, 80]])
    found = [(boxes, torch.tensor([0, 0, 0, 0]), torch.tensor([0.9, 0.8, 0.95, 0.7]))]
    quality = measure(found, data, 2, scale=2.0)
    assert quality.precision.tolist() == [1.0, 0.0]
    np.testing.assert_allclose(quality.errors, [2.0])
    assert quality.recall == 0.5
    assert quality.false == pytest.approx(2 / 3)


def test_the_learning_rate_rises_and_falls():
    rates = np.array([rate_at(step, 2000) for step in range(2000)])
    assert rates.argmax() in (149, 150)
    assert (np.diff(rates[:149]) > 0).all()
    assert (np.diff(rates[151:]) < 0).all()
    assert rates[-1] < 0.02 * rates.max()


def test_rendered_samples_are_the_same_again_and_others_are_held_out(tmp_path):
    once, again = (render_room(seed, views=1) for seed in (np.random.SeedSequence([1, 2]) for _ in range(2)))
    assert (once.images == again.images).all()
    assert (once.boxes == again.boxes).all()
    for kind in ("train", "held_out"):
        render_samples(tmp_path, kind, 4, seed=3, shard=2, views=2)
    assert len(list(tmp_path.iterdir())) == 4
    train, held_out = load_samples(tmp_path, "train"), load_samples(tmp_path, "held_out")
    assert train.images.shape == (4, 240, 320, 3)
    assert train.counts.sum() > 1
    assert (train.images != held_out.images).any(axis=(1, 2, 3)).all()


@pytest.fixture(scope="module")
def shipped():
    return onnxruntime.InferenceSession(str(MODEL), providers=["CPUExecutionProvider"])


def test_the_shipped_model_describes_itself(shipped):
    metadata = shipped.get_modelmeta().custom_metadata_map
    assert tuple(json.loads(metadata["names"])) == LABELS
    assert json.loads(metadata["objslam.detector"])["layout"] == "ssd"
    assert [node.name for node in shipped.get_outputs()] == ["boxes", "labels", "scores"]
    assert [(node.name, node.shape) for node in shipped.get_inputs()] == [("images", [1, 3, 240, 320])]
    assert MODEL.stat().st_size <= 8_000_000


def test_the_shipped_model_finds_the_objects_of_a_room_it_never_saw(shipped):
    data = render_room(np.random.SeedSequence([2**31, 99]), views=6)
    found = []
    for image in data.images:
        boxes, labels, scores = shipped.run(None, {"images": to_input(image[None]).numpy()})
        assert (np.diff(scores) <= 0).all()
        found.append(tuple(torch.from_numpy(a) for a in (boxes, labels, scores)))
    quality = measure(found, data, len(LABELS), scale=2.0)
    assert data.counts.sum() >= 10
    assert quality.recall >= 0.8
    assert quality.false <= 0.2
    assert np.median(quality.errors) <= 2.0


def test_an_empty_image_gives_empty_outputs(shipped):
    boxes, labels, scores = shipped.run(None, {"images": np.full((1, 3, 240, 320), 0.5, dtype=np.float32)})
    assert boxes.shape == (0, 4)
    assert labels.shape == scores.shape == (0,)
