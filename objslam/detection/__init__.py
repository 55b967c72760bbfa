"""Run a CNN detector and an image encoder on the images of a log. Both are ONNX models, and only this folder runs them."""

from objslam.detection.cache import default_cache
from objslam.detection.detect_log import detect_log
from objslam.detection.detector import Boxes, Detector, load_detector
from objslam.detection.embed_log import embed_log
from objslam.detection.encoder import Encoder, load_encoder

__all__ = ["Boxes", "Detector", "Encoder", "default_cache", "detect_log", "embed_log", "load_detector", "load_encoder"]
