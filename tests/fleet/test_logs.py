"""Finding the logs of a fleet, and the fields that their folders name."""

import pytest
from fleet import fleet_logs  # noqa: F401 - It registers the store that throws.

from objslam.errors import ConfigError, LogError
from objslam.fleet.logs import Layout, find_logs
from objslam.sources import SOURCES


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)


def found(*sources, template="{site}/{log}", by="site"):
    return find_logs([str(one) for one in sources], Layout(template, by))


def test_folders_are_searched_for_logs_of_every_kind(tmp_path):
    touch(tmp_path, "a/log/camera.yaml", "a/log/cameras/front/camera.yaml", "a/drive.mcap", "a/notes.txt", "readme.md")
    touch(tmp_path, "b/bag/metadata.yaml", "b/bag/bag_0.db3", "b/bag/bag_1.db3", "b/ds6/Barcodes.dat", "b/old.bag")
    paths = [one.path.removeprefix(f"{tmp_path}/") for one in found(tmp_path)]
    assert paths == ["a/drive.mcap", "a/log", "b/bag", "b/ds6", "b/old.bag"]
    assert [one.site for one in found(tmp_path)] == ["a", "a", "b", "b", "b"]
    assert [one.path for one in found(tmp_path / "*", tmp_path / "a")] == [one.path for one in found(tmp_path)]


@pytest.mark.parametrize("mark", [mark for source in SOURCES for mark in source.marks])
def test_a_mark_of_any_source_makes_a_folder_a_log(tmp_path, mark):
    touch(tmp_path, f"a/drive/{mark}", "a/drive/more/notes.txt", "b/notes.txt")
    assert [one.path.removeprefix(f"{tmp_path}/") for one in found(tmp_path)] == ["a/drive"]


def test_a_path_without_a_log_that_is_named_counts_as_one(tmp_path):
    touch(tmp_path, "a/good/odometry.txt", "a/bad/notes.txt")
    assert [one.path.rpartition("/")[2] for one in found(tmp_path / "a" / "*")] == ["bad", "good"]
    with pytest.raises(LogError, match="nothing is there"):
        found(tmp_path / "c")


def test_a_fingerprint_changes_with_any_file(tmp_path):
    touch(tmp_path, "a/log/camera.yaml", "a/log/rgb/1.png")
    (before,) = found(tmp_path)
    assert found(tmp_path) == [before]
    (tmp_path / "a/log/rgb/1.png").write_text("other")
    (after,) = found(tmp_path)
    assert after.fingerprint != before.fingerprint


def test_folders_name_site_robot_and_day(tmp_path):
    touch(tmp_path, "berlin/r1-2026-11-20/log/odometry.txt")
    template = "{site}/{robot}-{day}/{log}"
    (one,) = found(tmp_path, template=template)
    assert (one.site, one.robot, one.day) == ("berlin", "r1", "2026-11-20")
    assert found(tmp_path, template=template, by="robot")[0].site == "r1"
    assert found(tmp_path, by="folder")[0].site == "r1-2026-11-20"
    assert found(tmp_path, by="none")[0].site == "all"
    with pytest.raises(ConfigError, match="does not fit"):
        found(tmp_path, template="{site}/x{robot}/{log}")
    with pytest.raises(ConfigError, match="no field"):
        Layout("{site}/{log}", "robot")
    with pytest.raises(ConfigError, match="each field once"):
        Layout("{a}/{a}", "a")


def test_a_store_that_throws_now_and_then_hides_no_log(tmp_path):
    for k in range(40):
        touch(tmp_path, f"site_{k % 4}/log_{k}/camera.yaml", f"site_{k % 4}/log_{k}/cameras/a/rgb/1.png")
    here = [(one.path, one.size) for one in found(tmp_path)]
    assert len(here) == 40
    for source in (tmp_path, f"{tmp_path}/*/log_*"):  # fsspec's own listing leaves out a folder that fails.
        assert [(one.path.removeprefix("flaky://"), one.size) for one in found(f"flaky://{source}")] == here
    assert len(found(f"flaky://{tmp_path}/site_[12]/log_1?")) == 5
    with pytest.raises(LogError, match="nothing is there"):
        found(f"flaky://{tmp_path}/nothing")
