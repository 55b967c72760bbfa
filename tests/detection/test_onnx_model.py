"""Models that are damaged or made to harm: what they ask for is refused before it takes the memory of the computer."""

import resource

import numpy as np
import pytest
from onnx import TensorProto, helper
from tiny_models import Graph, tiny_model

from objslam.config import Detector
from objslam.detection import onnx_model
from objslam.detection.detector import load_detector
from objslam.detection.onnx_model import open_network
from objslam.errors import DetectorError

CPU = Detector(device="cpu")
GIB = 1 << 30


def model(path, output, size=(64, 64)):
    """Write a model with an image input of this size (w, h) that returns what `output` makes in its graph."""
    graph = Graph()
    graph.rename(output(graph), "output0")
    given = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, size[1], size[0]])
    return graph.save(path, [given], [helper.make_tensor_value_info("output0", TensorProto.FLOAT, None)], {})


def filled(graph, *shape):
    return graph("Expand", graph("ReduceMax", "images", keepdims=0), graph.ints(*shape))


def taken():
    """The most memory that this process has taken so far, bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@pytest.mark.parametrize("count", [9 * GIB // 4, 1 << 40])
def test_a_model_that_needs_more_memory_than_it_gets(tmp_path, count):
    file, before = model(tmp_path / "m.onnx", lambda graph: graph("ReduceMax", filled(graph, count))), taken()
    with pytest.raises(DetectorError, match=r"images of 64x64, the model needs more than [0-9.]+ GiB of memory"):
        load_detector(file, CPU)
    assert taken() - before < GIB


def test_the_models_of_a_process_get_half_of_a_small_computer(monkeypatch):
    monkeypatch.setattr(onnx_model, "_MOST_MEMORY", 8 * GIB)  # The tests have less.
    monkeypatch.setattr(onnx_model.os, "sysconf", {"SC_PHYS_PAGES": 1 << 20, "SC_PAGE_SIZE": 4096}.__getitem__)
    assert onnx_model._memory() == 2 * GIB
    monkeypatch.setattr(onnx_model.os, "sysconf", {"SC_PHYS_PAGES": 1 << 30, "SC_PAGE_SIZE": 4096}.__getitem__)
    assert onnx_model._memory() == 8 * GIB


def test_an_output_of_too_many_values(tmp_path, monkeypatch):
    monkeypatch.setattr(onnx_model, "_MOST_VALUES", 84_000)
    network = open_network(model(tmp_path / "m.onnx", lambda graph: filled(graph, 1, 84, 1000)), CPU)
    image = np.zeros((1, 3, 64, 64), dtype=np.float32)
    assert network.run(image)[0].shape == (1, 84, 1000)
    network = open_network(model(tmp_path / "m.onnx", lambda graph: filled(graph, 1, 84, 1001)), CPU)
    with pytest.raises(DetectorError, match="output0 has 84084 values, objslam takes at most 84000"):
        network.run(image)


def test_an_input_of_too_many_pixels(tmp_path):
    open_network(model(tmp_path / "m.onnx", lambda graph: filled(graph, 1), (8192, 8192)), CPU)
    file = model(tmp_path / "m.onnx", lambda graph: filled(graph, 1), (8193, 8192))
    with pytest.raises(DetectorError, match="the model takes larger images than objslam"):
        open_network(file, CPU)


def test_a_broken_model_prints_nothing(tmp_path, capfd):
    file = tiny_model(tmp_path / "m.onnx", "yolov8", size=(64, 64))
    file.write_bytes(file.read_bytes().replace(b"Transpose", b"Tr\xffnspose"))
    with pytest.raises(DetectorError, match="not an ONNX model"):
        open_network(file, CPU)
    assert capfd.readouterr() == ("", "")
