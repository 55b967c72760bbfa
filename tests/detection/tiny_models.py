"""Tiny ONNX detectors of every layout that really look: each finds a red, a green and a blue rectangle.

Class 0 is red, 1 green, 2 blue: channels in the wrong order show as wrong classes. The score is 0.9 where values come in as
they should: a wrong scale or normalisation shows as a wrong score. A rectangle is measured to a fraction of a pixel by the
profiles of its colour along both axes: their sums are its width and height, their centres of mass its centre.
"""

import json
from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper

COLOURS = ("red", "green", "blue")
SCORE = 0.9
IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))


class Graph:
    """ONNX nodes, one call each."""

    def __init__(self):
        self.nodes, self.constants = [], []

    def constant(self, value, kind=np.float32):
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(value, dtype=kind), name))
        return name

    def ints(self, *values):
        return self.constant(values, np.int64)

    def __call__(self, kind, *inputs, **attributes):
        name = f"n{len(self.nodes)}"
        inputs = [i if isinstance(i, str) else self.constant(i) for i in inputs]
        self.nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def rename(self, name, wanted):
        self.nodes.append(helper.make_node("Identity", [name], [wanted]))
        return wanted

    def save(self, path, inputs, outputs, metadata):
        graph = helper.make_graph(self.nodes, "tiny", inputs, outputs, self.constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
        helper.set_model_props(model, {k: v if isinstance(v, str) else json.dumps(v) for k, v in metadata.items()})
        Path(path).write_bytes(model.SerializeToString())
        return path


def see(graph, rgb):
    """Centre-and-size boxes (B, 3, 4) px and scores (B, 3) in images `rgb` (B, 3, H, W), values 0 to 1."""
    weights = 1.5 * np.eye(3) - 0.5
    colour = graph("Relu", graph("Conv", rgb, weights.reshape(3, 3, 1, 1)))
    parts = []
    for axis, other in ((3, 2), (2, 3)):
        profile = graph("ReduceMax", colour, axes=[other], keepdims=0)
        length = graph("Gather", graph("Shape", rgb), graph.constant(axis, np.int64))
        steps = graph("Range", 0.5, graph("Add", graph("Cast", length, to=TensorProto.FLOAT), 0.25), 1.0)
        size = graph("ReduceSum", profile, graph.ints(-1), keepdims=1)
        moment = graph("ReduceSum", graph("Mul", profile, steps), graph.ints(-1), keepdims=1)
        parts.append((graph("Div", moment, graph("Max", size, 1e-6)), size))
    boxes = graph("Concat", parts[0][0], parts[1][0], parts[0][1], parts[1][1], axis=2)
    return boxes, graph("Mul", graph("ReduceMax", colour, axes=[2, 3], keepdims=0), SCORE)


def corners(graph, boxes):
    return graph("MatMul", boxes, [[1, 0, 1, 0], [0, 1, 0, 1], [-0.5, 0, 0.5, 0], [0, -0.5, 0, 0.5]])


def column(graph, values):
    return graph("Unsqueeze", values, graph.ints(2))


def class_scores(graph, scores):
    return graph("Mul", column(graph, scores), np.eye(3))


def labels(graph, scores, first=0, kind=TensorProto.INT64):
    return graph("Cast", graph("Add", graph("Mul", scores, 0.0), [first + 0.0, first + 1.0, first + 2.0]), to=kind)


def padded(graph, rows, count, value=0.0):
    """Rows (B, N, K) with more of them, up to count."""
    return graph("Pad", rows, graph.ints(0, 0, 0, 0, count, 0), value)


def cells(width, height):
    return [(stride, x, y) for stride in (8, 16, 32) for y in range(height // stride) for x in range(width // stride)]


def tiny_model(
    path,
    layout,
    *,
    size=(640, 640),
    batch=1,
    colour="rgb",
    divide_by=255.0,
    normalise=((0.0,) * 3, (1.0,) * 3),
    metadata=(),
    kind=TensorProto.FLOAT,
    channels_last=False,
    rank=4,
    names=None,
    extra=(),
):
    """Write a model of the layout; size (w, h) and batch are None where dynamic. Colour values are undone inside."""
    graph = Graph()
    width, height = size
    shape = [batch or "batch", height or "height", width or "width"]
    shape = [*shape, 3] if channels_last else [shape[0], 3, *shape[1:]]
    inputs = [helper.make_tensor_value_info("images", kind, shape[4 - rank :])]
    inputs += [helper.make_tensor_value_info(name, of, dims) for name, of, dims in extra]
    values = graph("Cast", "images", to=TensorProto.FLOAT)
    if rank == 3:
        values = graph("Unsqueeze", values, graph.ints(0))
    if channels_last:
        values = graph("Transpose", values, perm=[0, 3, 1, 2])
    mean, std = (np.reshape(v, (3, 1, 1)) for v in normalise)
    values = graph("Div", graph("Mul", graph("Add", graph("Mul", values, std), mean), divide_by), 255.0)
    if colour == "bgr":
        values = graph("Gather", values, graph.ints(2, 1, 0), axis=1)
    boxes, scores = see(graph, values)
    outputs = TAILS[layout](graph, boxes, scores, width or 640, height or 640)
    if kind == TensorProto.FLOAT16:
        outputs = {name: graph("Cast", value, to=kind) for name, value in outputs.items()}
    names = names or {}
    info = []
    for name, value in outputs.items():
        of = TensorProto.INT64 if name == "labels" else kind if kind == TensorProto.FLOAT16 else TensorProto.FLOAT
        of = TensorProto.INT64 if name == "classes64" else of
        value = graph("Squeeze", value, graph.ints(0)) if rank == 3 else value
        info.append(helper.make_tensor_value_info(graph.rename(value, names.get(name, name)), of, None))
    return graph.save(path, inputs, info, dict(metadata))


def _ssd(graph, boxes, scores, width, height):
    return {"boxes": corners(graph, boxes), "labels": labels(graph, scores), "scores": scores}


def _ssd_fractions(graph, boxes, scores, width, height):
    """As in the ONNX model zoo and TensorFlow: fractions of the image, classes from 1, floats."""
    fractions = graph("Div", corners(graph, boxes), [width, height, width, height])
    return {"boxes": fractions, "classes": labels(graph, scores, 1, TensorProto.FLOAT), "scores": scores}


def _tensorflow(graph, boxes, scores, width, height):
    columns = graph("Gather", graph("Div", corners(graph, boxes), [640, 480, 640, 480]), graph.ints(1, 0, 3, 2), axis=2)
    return {
        "detection_anchor_indices:0": labels(graph, scores, 5, TensorProto.FLOAT),
        "detection_multiclass_scores:0": class_scores(graph, scores),
        "raw_detection_boxes:0": padded(graph, columns, 9),
        "detection_boxes:0": columns,
        "detection_classes:0": labels(graph, scores, 1, TensorProto.FLOAT),
        "detection_scores:0": scores,
        "num_detections:0": graph("ReduceSum", scores, graph.ints(1), keepdims=0),
    }


def _dets(graph, boxes, scores, width, height):
    """As mmdeploy writes it: scores in the boxes' fifth column."""
    return {"dets": graph("Concat", corners(graph, boxes), column(graph, scores), axis=2), "labels": labels(graph, scores)}


def _twice(graph, rows, factor):
    """The rows again, 2 px aside and with lower scores, from column 4 on: what non-maximum suppression is for."""
    width = 4 + factor
    aside = graph("Add", graph("Mul", rows, [1.0] * 4 + [0.8] * factor), [2.0, 2.0] + [0.0] * (width - 2))
    return graph("Concat", rows, aside, axis=1)


def _yolov8(graph, boxes, scores, width, height):
    rows = graph("Concat", boxes, class_scores(graph, scores), axis=2)
    rows = padded(graph, _twice(graph, rows, 3), len(cells(width, height)) - 6)
    return {"output0": graph("Transpose", rows, perm=[0, 2, 1])}


def _yolov8_segment(graph, boxes, scores, width, height):
    rows = graph("Concat", boxes, class_scores(graph, scores), axis=2)
    rows = graph("Pad", rows, graph.ints(0, 0, 0, 0, 0, 32), 5.0)
    rows = padded(graph, rows, len(cells(width, height)) - 3)
    return {"output0": graph("Transpose", rows, perm=[0, 2, 1]), "output1": graph.constant(np.zeros((1, 32, 160, 160)))}


def _yolov5(graph, boxes, scores, width, height):
    certain = graph("Add", graph("Mul", class_scores(graph, scores), 0.0), np.eye(3))
    rows = graph("Concat", boxes, column(graph, scores), certain, axis=2)
    rows = padded(graph, _twice(graph, rows, 4), 3 * len(cells(width, height)) - 6)
    return {"output0": rows}


def _end_to_end(graph, boxes, scores, width, height):
    number = labels(graph, scores, kind=TensorProto.FLOAT)
    rows = graph("Concat", corners(graph, boxes), column(graph, scores), column(graph, number), axis=2)
    return {"output0": padded(graph, rows, 297)}


def _yolov7(graph, boxes, scores, width, height):
    """(N, 7): the image's number, box, class, score."""
    number = column(graph, labels(graph, scores, kind=TensorProto.FLOAT))
    image = graph("Mul", number, 0.0)
    rows = graph("Concat", image, corners(graph, boxes), number, column(graph, scores), axis=2)
    return {"output": graph("Squeeze", rows, graph.ints(0))}


def _in_cells(graph, rows, width, height):
    """The three rows put into one cell of each grid: (B, cells, K)."""
    grid = cells(width, height)
    places = [next(i for i, cell in enumerate(grid) if cell == wanted) for wanted in ((8, 5, 3), (16, 2, 7), (32, 4, 1))]
    scatter = np.zeros((len(grid), 3))
    scatter[places, range(3)] = 1
    return graph("MatMul", scatter, rows), grid, places


def _yolox(graph, boxes, scores, width, height):
    strides, corner = np.array([[8.0], [16], [32]]), np.array([[5.0, 3], [2, 7], [4, 1]])
    centre = graph("Sub", graph("Div", graph("Slice", boxes, graph.ints(0), graph.ints(2), graph.ints(2)), strides), corner)
    size = graph("Log", graph("Div", graph("Slice", boxes, graph.ints(2), graph.ints(4), graph.ints(2)), strides))
    certain = graph("Add", graph("Mul", class_scores(graph, scores), 0.0), np.eye(3))
    rows, _, _ = _in_cells(graph, graph("Concat", centre, size, column(graph, scores), certain, axis=2), width, height)
    return {"output": rows}


def _yolox_decoded(graph, boxes, scores, width, height):
    certain = graph("Add", graph("Mul", class_scores(graph, scores), 0.0), np.eye(3))
    rows, grid, places = _in_cells(graph, graph("Concat", boxes, column(graph, scores), certain, axis=2), width, height)
    rest = np.array([[(x + 0.5) * s, (y + 0.5) * s, s, s, 1e-4, 0, 0, 0] for s, x, y in grid])
    rest[places] = 0
    return {"output": graph("Add", rows, rest)}


def _fractions(graph, boxes, width, height):
    return graph("Div", boxes, [width, height, width, height])


def _detr(graph, boxes, scores, width, height):
    """Sigmoid, 300 queries, as RT-DETR."""
    odds = graph("Log", graph("Div", scores, graph("Sub", 1.0, scores)))
    logits = graph("Add", graph("Mul", column(graph, odds), np.eye(3)), -20.0 * (1 - np.eye(3)))
    return {
        "logits": padded(graph, logits, 297, -20.0),
        "pred_boxes": padded(graph, _fractions(graph, boxes, width, height), 297),
    }


def _detr_softmax(graph, boxes, scores, width, height):
    """Softmax with a last class for nothing, 100 queries, as DETR: the class 3, the others 0, nothing log(e^3 / 9 - 1)."""
    peak = graph("Mul", column(graph, scores), 3 / SCORE * np.eye(3))
    nothing = np.full((1, 3, 1), np.log(np.exp(3) * (1 / SCORE - 1) - 2))
    logits = graph("Concat", peak, graph("Add", graph("Mul", column(graph, scores), 0.0), nothing), axis=2)
    empty = graph(
        "Add",
        padded(graph, graph("Mul", logits, 0.0), 97),
        np.append(np.zeros((3, 4)), np.tile([[0, 0, 0, 20.0]], (97, 1)), 0),
    )
    return {
        "logits": graph("Add", empty, padded(graph, logits, 97)),
        "pred_boxes": padded(graph, _fractions(graph, boxes, width, height), 97),
    }


def _rtdetr_ultralytics(graph, boxes, scores, width, height):
    rows = graph("Concat", _fractions(graph, boxes, width, height), class_scores(graph, scores), axis=2)
    return {"output0": padded(graph, rows, 297)}


def _rtdetr_best(graph, boxes, scores, width, height):
    """As Ultralytics exports RT-DETR since 8.4."""
    number = column(graph, labels(graph, scores, kind=TensorProto.FLOAT))
    rows = graph("Concat", _fractions(graph, boxes, width, height), column(graph, scores), number, axis=2)
    return {"output0": padded(graph, rows, 297)}


def _unknown(graph, boxes, scores, width, height):
    return {"heat": graph("Reshape", boxes, graph.ints(0, 3, 2, 2)), "offset": scores}


TAILS = {
    "ssd": _ssd,
    "ssd_fractions": _ssd_fractions,
    "tensorflow": _tensorflow,
    "dets": _dets,
    "yolov8": _yolov8,
    "yolov8_segment": _yolov8_segment,
    "yolov5": _yolov5,
    "end_to_end": _end_to_end,
    "yolov7": _yolov7,
    "yolox": _yolox,
    "yolox_decoded": _yolox_decoded,
    "detr": _detr,
    "detr_softmax": _detr_softmax,
    "rtdetr_ultralytics": _rtdetr_ultralytics,
    "rtdetr_best": _rtdetr_best,
    "unknown": _unknown,
}


def scene(boxes, width=640, height=480, grey=114):
    """A BGR image with a red, a green and a blue rectangle x1, y1, x2, y2 (x2 and y2 are the first pixels after it)."""
    image = np.full((height, width, 3), grey, dtype=np.uint8)
    for (x1, y1, x2, y2), bgr in zip(boxes, ((0, 0, 255), (0, 255, 0), (255, 0, 0)), strict=False):
        image[y1:y2, x1:x2] = bgr
    return image
