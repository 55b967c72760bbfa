"""The settings: nested, with a default for everything; YAML files and `--set key=value` change them.

What describes objects, rooms or robots is a setting; what a method needs for itself is a constant beside the method.
"""

from objslam.config.calibration import CalibrationSettings
from objslam.config.detector import Activation, BoxForm, BoxUnits, Colour, Detector, Layout, Resize, Role
from objslam.config.estimation import AssociationSettings, Fixed, Joint, Loss, Triangulation
from objslam.config.live import Live
from objslam.config.measurements import Depth, Localization, Odometry, Planar, Poses, RayNoise
from objslam.config.output import Output, Reconstruction
from objslam.config.section import Device, Finite, NotNegative, Positive, Section, Share
from objslam.config.settings import Settings, dump_settings, is_file, load_settings

__all__ = [
    "Activation",
    "AssociationSettings",
    "BoxForm",
    "BoxUnits",
    "Colour",
    "CalibrationSettings",
    "Depth",
    "Detector",
    "Device",
    "Finite",
    "Fixed",
    "Joint",
    "Layout",
    "Live",
    "Localization",
    "Loss",
    "NotNegative",
    "Odometry",
    "Output",
    "Planar",
    "Poses",
    "Positive",
    "RayNoise",
    "Reconstruction",
    "Resize",
    "Role",
    "Section",
    "Settings",
    "Share",
    "Triangulation",
    "dump_settings",
    "is_file",
    "load_settings",
]
