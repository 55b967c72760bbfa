"""Tie a growing graph to an older map: the frame F of the graph in the map, and the objects that both have.

The variables and factors are as in `prior_map`. The graph keeps its own frame. F is its pose in the map.
"""

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.rotation import skew
from objslam.graph.factors.frames import F0, P0, frame_prior, object_priors, own_errors
from objslam.graph.isam2 import IncrementalGraph
from objslam.graph.maps.prior_map import LEAST
from objslam.graph.variables import L0

_FRAME, _OBJECT = "map frame", "map object"  # The kinds of these factors in the graph.


def tie_frame(graph: IncrementalGraph, map_T_graph: Floats) -> None:
    """Add F at map_T_graph (4, 4), with a prior that leaves its yaw and shift nearly free."""
    graph.add_variable(F0, gtsam.Pose3(map_T_graph))
    graph.add(_FRAME, [0], [[frame_prior(map_T_graph)]])


def tie_objects(graph: IncrementalGraph, landmarks: Ints, own: Floats, position: Floats, covariance: Floats) -> None:
    """Tie landmarks (n,) to objects of the map with positions (n, 3) m and covariances (n, 3, 3) m^2.

    F must be in the graph. own: (n, 3, 3) m^2, the covariances, in the frame of the graph, of the errors that the graph does
    not contain, such as the offsets of boxes.
    """
    frame = map_T_graph(graph)
    assert frame is not None
    rotation, shift, floor = frame[:3, :3], frame[:3, 3], LEAST**2 * np.eye(3)
    for j, point in zip(landmarks.tolist(), graph.points(landmarks), strict=True):
        graph.add_variable(P0 + j, rotation @ point + shift)
    errors = own_errors(landmarks, rotation @ own @ rotation.T + floor)
    priors = object_priors(P0, landmarks, position, covariance + floor, robust=True)
    graph.add(_OBJECT, landmarks.tolist(), [list(pair) for pair in zip(errors, priors, strict=True)])


def untie(graph: IncrementalGraph) -> None:
    """Remove the map from the graph. The caller must rebuild the graph."""
    for kind in (_OBJECT, _FRAME):
        graph.drop_kind(kind)


def map_T_graph(graph: IncrementalGraph) -> Floats | None:
    """Return the pose (4, 4) of the graph's frame in the map at the last `refresh`. None if the graph has no map."""
    frame = graph.variable(F0)
    return None if frame is None else np.asarray(frame.matrix())


def covariance_in_map(graph: IncrementalGraph, j: int) -> Floats:
    """Return the covariance (3, 3), m^2, of landmark j in the prior map, in the axes of the graph. NaN if it is unknown."""
    joint = graph.joint_covariance(F0, L0 + j)
    if joint is None:
        return np.full((3, 3), np.nan)
    by_frame = np.hstack([-skew(graph.points(np.array([j]))[0]), np.eye(3)])
    cross = by_frame @ joint.at(F0, L0 + j)
    return np.asarray(by_frame @ joint.at(F0, F0) @ by_frame.T + joint.at(L0 + j, L0 + j) + cross + cross.T)
