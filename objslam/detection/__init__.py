"""Run a CNN detector, which may be any ONNX model, on the images of a log. Only this folder imports onnxruntime."""

from objslam.detection.cache import default_cache
from objslam.detection.detect_log import detect_log
from objslam.detection.detector import Boxes, Detector, load_detector

__all__ = ["Boxes", "Detector", "default_cache", "detect_log", "load_detector"]
