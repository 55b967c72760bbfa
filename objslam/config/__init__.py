"""The settings of a run, in nested sections. Every setting has a default. YAML files and `--set key=value` change settings.
Values that describe objects, rooms or robots are settings. Values that only a method needs are constants in the code."""

from objslam.config.calibration import CalibrationSettings
from objslam.config.detector import Detector
from objslam.config.encoder import Encoder
from objslam.config.mapping import AssociationSettings, Live, Loss, Odometry, Output, Reconstruction, Triangulation
from objslam.config.noise import Noise
from objslam.config.section import Device, NotNegative, Positive, Section
from objslam.config.settings import Settings, dump_settings, is_file, load_settings

__all__ = [
    "AssociationSettings",
    "CalibrationSettings",
    "Detector",
    "Device",
    "Encoder",
    "Live",
    "Loss",
    "Noise",
    "NotNegative",
    "Odometry",
    "Output",
    "Positive",
    "Reconstruction",
    "Section",
    "Settings",
    "Triangulation",
    "dump_settings",
    "is_file",
    "load_settings",
]
