"""objslam: object SLAM for mobile robots, from detector boxes and planar poses to a map of objects in 3D."""

__version__ = "0.1.0"
