"""The settings: nested sections with a default for every value, changed by YAML files and `--set key=value`. A value that
describes objects, rooms or robots is a setting, and a value that only a method needs is a constant in the code."""

from objslam.config.detector import Activation, BoxForm, BoxUnits, Colour, Detector, Layout, Resize, Role
from objslam.config.estimation import AssociationSettings, Fixed, Joint, Loss, Triangulation
from objslam.config.live import Live
from objslam.config.measurements import Depth, Localization, Odometry, Planar, Poses, RayNoise
from objslam.config.output import Output, Reconstruction
from objslam.config.section import Device, NotNegative, Positive, Section
from objslam.config.settings import Settings, dump_settings, is_file, load_settings

__all__ = [
    "Activation",
    "AssociationSettings",
    "BoxForm",
    "BoxUnits",
    "Colour",
    "Depth",
    "Detector",
    "Device",
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
    "Triangulation",
    "dump_settings",
    "is_file",
    "load_settings",
]
