"""Other labels of a thing: a detector changes its mind, or another thing stands right beside."""

import numpy as np
import pytest
from association_scenes import Scene, watch

from objslam.association.gating import gate_limit
from objslam.association.label_fusion import fused_labels
from objslam.association.landmarks import Landmarks, State
from objslam.association.observations import PosedRays, observe
from objslam.association.visibility import CameraFrames
from objslam.core.geometry import lift_se2

CUP = np.array([1.5, 0.0, 0.3])
GATE = gate_limit(0.997)


def around(count: int = 60) -> np.ndarray:
    """Robot poses (count, 4, 4) on a third of a circle about the cup, looking at it."""
    angle = np.linspace(0.0, 2 * np.pi / 3, count)
    return lift_se2(np.column_stack([CUP[0] + 2 * np.cos(angle), 2 * np.sin(angle), angle + np.pi]))


def with_a_cup(scene: Scene, cup: np.ndarray) -> State:
    """The state with one landmark, the cup, which owns the boxes of its label. cup: (3,) m, where the landmark is."""
    poses = scene.keyframes.map_T_camera
    obs, _, _ = observe(PosedRays(scene.rays, scene.keyframes, scene.cameras, poses, scene.rays.sigma))
    landmarks = Landmarks.new(cup[None], np.full(1, 3.0), np.zeros(1, dtype=np.int64), 2)
    view = CameraFrames(scene.keyframes.stamps, scene.cameras, scene.keyframes.camera, poses, 0.0, 0.0)
    return State(obs, view, landmarks, np.where(obs.label == 0, 0, -1))


@pytest.mark.parametrize("apart", [0.0, 0.035])
def test_a_thing_beside_a_cup_is_not_the_cup(apart):
    """The bearings hardly tell the cup from the bottle beside it, and a frame often shows only one of them. In the control,
    the detector calls the cup a bottle in some frames, and then it has no box of a cup."""
    names, size = ("cup", "bottle"), 0.03
    if apart:
        points = np.stack([CUP, CUP + np.array([0.0, 0.0, apart])])
        scene = watch(points, around(), names=names, label=np.array([0, 1]), missed=0.4, size=size)
        at = np.arange(len(scene.rays)) % 4 > 0  # There are fewer boxes of the bottle.
        few = (scene.rays.label == 0) | at
        scene = Scene(scene.keyframes, scene.rays.take(few), scene.cameras, scene.whose[few], scene.points, scene.label)
    else:
        scene = watch(CUP[None], around(), names=names, missed=0.1, size=size)
        scene.rays.label[:] = np.random.default_rng(0).random(len(scene.rays)) < 0.3
    state = with_a_cup(scene, CUP)
    assert fused_labels(state, GATE)[0].tolist() == [True, not apart]
