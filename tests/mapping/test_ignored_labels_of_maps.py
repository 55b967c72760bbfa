"""A map is the map of the log without the ignored boxes."""

from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from more_boxes import with_boxes
from quick import HELD

from objslam.api.sites import diff
from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.errors import OutputError
from objslam.frontend.boxes.ignored_labels import IGNORED_LABELS
from objslam.frontend.keyframes import build_keyframes
from objslam.io.results.read import load_views
from objslam.io.views_parquet import Views, dump_views, read_views
from objslam.mapping import pipeline
from objslam.output.result_folder import write_result
from objslam.simulation import preset, simulate


@pytest.fixture(scope="module")
def drive():
    return simulate(preset("demo", frames=120, localization=None, odometry=Odometry()), 3)


@pytest.fixture(scope="module")
def crowded(drive):
    """The drive with a person in each image, who stands where no robot part is: the boxes move."""
    count = len(drive.cameras[0].detections.frame_stamps)
    left = np.linspace(20, 300, count)
    return with_boxes(drive, np.arange(count), np.column_stack([left, left, left + 80, left + 160]), "person")


def mapped(log, *more):
    return pipeline.run(log, load_settings(None, ("mode=joint", *HELD, *more)), Ledger())


def places(result):
    return {(one.label, *np.round(one.position, 6)) for one in result.map.objects}


def test_an_offline_map_is_that_of_the_log_without_these_boxes(drive, crowded):
    plain = mapped(drive)
    result = mapped(crowded, "rays.ignore_labels=person")
    assert places(result) == places(plain)
    assert result.summary["dropped"][IGNORED_LABELS] == len(drive.cameras[0].detections.frame_stamps)
    assert result.summary["counts"]["detections"] == len(crowded.cameras[0].detections)


def test_a_map_says_nothing_about_things_whose_label_it_left_out(drive, tmp_path):
    label = mapped(drive).map.resolved()[0].label
    for name, more in (("before", ()), ("without", (f"rays.ignore_labels={label}",))):
        write_result(mapped(drive, *more, "output.recording=false", "output.picture=false"), tmp_path / name)
    assert load_views(tmp_path / "without").ignored == (label,)
    outcomes = [one.outcome for one in diff(tmp_path / "before", tmp_path / "without").changes if one.item.label == label]
    assert outcomes
    assert not {"gone", "moved"} & set(outcomes)
    # A later map that did not leave the label out says that these things are gone.
    views = load_views(tmp_path / "without")
    (tmp_path / "without" / "views.parquet").write_bytes(dump_views(replace(views, ignored=())))
    assert any(one.item.label == label for one in diff(tmp_path / "before", tmp_path / "without").of("gone"))


@pytest.mark.parametrize("header", [b'{"cup": 1}', b"[1]", b"[", b"[" * 100_000])
def test_ignored_labels_that_no_run_wrote_are_one_error(drive, tmp_path, header):
    file = tmp_path / "views.parquet"
    frames = build_keyframes(drive, load_settings(None, ("mode=joint",)), Ledger())
    file.write_bytes(dump_views(Views.of(frames, (drive.cameras[0].camera,), load_settings(None, ()))))
    assert read_views(file).ignored == ()
    table = pq.read_table(file)
    pq.write_table(table.replace_schema_metadata({**table.schema.metadata, b"objslam.ignored_labels": header}), file)
    with pytest.raises(OutputError, match="not what a run writes"):
        read_views(file)
