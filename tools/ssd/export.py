"""The trained network as one ONNX file that decodes and suppresses inside, and the proof that it does what torch does."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

from ssd.boxes import overlap
from ssd.evaluate import OVERLAP, PER_CLASS, SCORE, Boxes, detect, to_input
from ssd.model import Decoded, Ssd

OPSET = 17


def export(network: Ssd, names: tuple[str, ...], file: Path, about: dict[str, str]) -> None:
    """Write the model: `images` (1, 3, H, W) RGB in [0, 1] to boxes (N, 4) px of the input, labels (N,), scores (N,).

    The best come first. Labels count from 0; the metadata name the classes and say how images go in. about: more metadata.
    """
    network.eval()
    stream = io.BytesIO()
    torch.onnx.export(
        Decoded(network.to(memory_format=torch.contiguous_format)),  # type: ignore[call-overload]
        (torch.zeros(1, 3, *reversed(network.size)),),
        cast(Any, stream),  # typed for file names only
        input_names=["images"],
        output_names=["all_boxes", "all_scores"],
        opset_version=OPSET,
        dynamo=False,
    )
    model = onnx.load_from_string(stream.getvalue())
    _suppress_inside(model.graph)
    description = {"layout": "ssd", "first_label": 0, "resize": "letterbox", "colour": "rgb", "divide_by": 255.0}
    metadata = {
        "names": json.dumps(names),
        "imgsz": json.dumps(network.size[::-1]),
        "objslam.detector": json.dumps({**description, "box_form": "xyxy", "box_units": "pixels", "nms": False}),
        **about,
    }
    helper.set_model_props(model, metadata)
    onnx.checker.check_model(model, full_check=True)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(model.SerializeToString())


def _suppress_inside(graph: Any) -> None:
    """Replace the outputs all_boxes (1, A, 4) and all_scores (1, C, A) by the boxes that stay, with labels and scores."""

    def constant(name: str, values: Any, kind: type) -> str:
        graph.initializer.append(numpy_helper.from_array(np.array(values, dtype=kind), name))
        return name

    limits = [
        constant("most", [PER_CLASS], np.int64),
        constant("most_overlap", [OVERLAP], np.float32),
        constant("least_score", [SCORE], np.float32),
    ]
    constant("zero", [0], np.int64)
    constant("one", [1], np.int64)
    constant("class_and_box", [1, 2], np.int64)
    nodes: tuple[tuple[str, list[str], list[str], dict[str, int]], ...] = (
        ("NonMaxSuppression", ["all_boxes", "all_scores", *limits], ["kept"], {}),
        ("Squeeze", ["all_boxes", "zero"], ["flat_boxes"], {}),
        ("Squeeze", ["all_scores", "zero"], ["flat_scores"], {}),
        ("Gather", ["kept", "class_and_box"], ["pairs"], {"axis": 1}),
        ("GatherND", ["flat_scores", "pairs"], ["kept_scores"], {}),
        ("Shape", ["kept_scores"], ["count"], {}),
        ("TopK", ["kept_scores", "count"], ["scores", "order"], {"axis": 0}),
        ("Gather", ["pairs", "order"], ["ordered"], {"axis": 0}),
        ("Split", ["ordered"], ["label_column", "box_column"], {"axis": 1}),
        ("Squeeze", ["label_column", "one"], ["labels"], {}),
        ("Squeeze", ["box_column", "one"], ["places"], {}),
        ("Gather", ["flat_boxes", "places"], ["boxes"], {"axis": 0}),
    )
    graph.node.extend(helper.make_node(kind, takes, gives, **cast(Any, options)) for kind, takes, gives, options in nodes)
    del graph.output[:]
    graph.output.extend(
        [
            helper.make_tensor_value_info("boxes", TensorProto.FLOAT, ["detections", 4]),
            helper.make_tensor_value_info("labels", TensorProto.INT64, ["detections"]),
            helper.make_tensor_value_info("scores", TensorProto.FLOAT, ["detections"]),
        ]
    )


def run_onnx(file: Path, images: NDArray[np.uint8]) -> list[Boxes]:
    """What the exported model finds in each of the images (N, H, W, 3)."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    found = []
    for image in images:
        boxes, labels, scores = session.run(["boxes", "labels", "scores"], {"images": to_input(image[None]).numpy()})
        found.append((torch.from_numpy(boxes), torch.from_numpy(labels), torch.from_numpy(scores)))
    return found


def parity(network: Ssd, file: Path, images: NDArray[np.uint8], margin: float = 0.02) -> tuple[float, float]:
    """How far torch and onnxruntime are apart over the images: boxes in px, scores.

    AssertionError where one finds what the other does not, with a score more than `margin` above the lowest that is kept.
    """
    worst_box = worst_score = 0.0
    for ours, theirs in zip(detect(network, images), run_onnx(file, images), strict=True):
        for first, second in ((ours, theirs), (theirs, ours)):
            clear = first[2] > SCORE + margin
            partner, found = _partners(first, second)
            assert bool(found[clear].all()), "torch and onnxruntime do not find the same boxes"
            both = clear & found
            if both.any():
                worst_box = max(worst_box, float((first[0][both] - second[0][partner[both]]).abs().max()))
                worst_score = max(worst_score, float((first[2][both] - second[2][partner[both]]).abs().max()))
    return worst_box, worst_score


def _partners(first: Boxes, second: Boxes) -> tuple[Tensor, Tensor]:
    """Return for each box of the first the box of the second with its label that overlaps it most, and whether by 0.9."""
    if len(second[0]) == 0:
        return torch.zeros(len(first[0]), dtype=torch.int64), torch.zeros(len(first[0]), dtype=torch.bool)
    share = overlap(first[0], second[0]) * (first[1][:, None] == second[1][None])
    best, partner = share.max(dim=1)
    return partner, best > 0.9
