"""A joint solve after a map at given poses that err begins with the objects of this map."""

from dataclasses import replace

import numpy as np
import pytest
from lasting_localization import with_lasting

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.types import Association
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.mapping import joint_solve, pipeline
from objslam.mapping.fixed.map_at_poses import MapAtPoses
from objslam.simulation import DriveSettings, PoseNoise, simulate


@pytest.fixture(scope="module")
def drive():
    """A drive between twelve things of two labels, whose localisation errs by 6 cm and 2 degrees for 20 s."""
    rng = np.random.default_rng(5)
    angle = 2 * np.pi * np.arange(12) / 12
    placed = np.column_stack([3.5 * np.cos(angle), 3.5 * np.sin(angle), rng.uniform(0.2, 0.8, 12)])
    settings = DriveSettings(
        name="hall",
        room=(10.0, 10.0),
        frames=200,
        frame_rate=2.0,
        speed=0.3,
        objects=0,
        placed=tuple((("post", "bin")[k % 2], tuple(at)) for k, at in enumerate(placed.tolist())),
        odometry=Odometry(),
        localization=PoseNoise(xy=0.005, yaw=0.001),
    )
    return with_lasting(simulate(settings, 3), 7.0, 20.0, 3, xy=0.01)


def test_the_second_solve_does_not_search_at_the_poses_again(drive, monkeypatch):
    begun, stages = [], []

    def searched(*_):
        raise AssertionError("the objects at the poses were searched again")

    better = joint_solve._or_as_in_fixed_mode
    monkeypatch.setattr(joint_solve, "associate_at_poses", searched)
    monkeypatch.setattr(joint_solve, "_or_as_in_fixed_mode", lambda a, b: (begun.append(a.at_poses), better(a, b))[1])
    settings = load_settings(None, ("output.recording=false", "bodies.use=false"))
    result = pipeline.run(drive, settings, Ledger(), lambda stage, *_: stages.append(stage))
    assert result.summary["mode"] == "joint"
    again = [stage.startswith("poses too, ") for stage in stages]
    assert again == sorted(again)  # The lines of the second solve say that they are of it.
    assert 0 < sum(again) < len(again)
    assert len(begun) >= 1
    assert all(one is not None and one.count >= 10 for one in begun)
    told = evaluate(result.map, drive.truth, None, align="none", radius=0.5).to_dict()
    assert told["matched"] >= 11  # The same as with a search at the poses.
    assert told["false"] == 0


def test_only_the_rays_of_the_map_have_its_objects(drive):
    settings = load_settings(None, ())
    rays = build_rays(drive, build_keyframes(drive, settings, Ledger()), settings, Ledger())
    known = MapAtPoses(None, rays, Association(np.zeros(len(rays), dtype=np.int64), np.zeros(1, dtype=np.int64)), True)
    assert known.association_of(replace(rays, direction=-rays.direction)) is known.association
    bearings = replace(rays, box=np.full_like(rays.box, np.nan))
    assert replace(known, rays=bearings).association_of(bearings) is known.association
    assert replace(known, trusted=False).association_of(rays) is None
    assert known.association_of(rays.take(np.arange(len(rays) - 1))) is None
    assert known.association_of(replace(rays, box=rays.box + 1)) is None
    assert known.association_of(replace(rays, label_names=rays.label_names[::-1])) is None
