import gzip
import io
import shutil
import tarfile

import cv2
import numpy as np
import pytest

from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.frontend.box_depths import box_depth
from objslam.sources.tum_rgbd import TumOptions
from objslam.sources.tum_rgbd.reader import is_numbered, is_stamped, read_numbered, read_stamped

_POSES = [f"{10 + n}.5 {n} 0 1 0 0 0 1" for n in range(4)]
_CAMERA = """\
image_width: 64
image_height: 48
camera_matrix: [50, 0, 32, 0, 50, 24, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients: []
"""


def _depth(value):
    image = np.zeros((48, 64), dtype=np.uint16)
    image[10:30, 20:40] = value
    return image


@pytest.fixture
def numbered(tmp_path):
    folder = tmp_path / "cabinet"
    for name in ("boxes", "raw_imgs", "depth_imgs"):
        (folder / name).mkdir(parents=True)
    (folder / "truth_cam_poses.txt").write_text("# header\n" + "\n".join(_POSES) + "\n")
    (folder / "camera.yaml").write_text(_CAMERA)
    for n in range(4):
        (folder / "boxes" / f"{n:04d}_yolo2_0.15.txt").write_text("" if n == 2 else f"20\t10\t20\t20\t0.{n + 1}\n")
        (folder / "raw_imgs" / f"{n:04d}_rgb_raw.jpg").touch()
        cv2.imwrite(str(folder / "depth_imgs" / f"{n:04d}_depth_raw.png"), _depth(5000 * (n + 1)))
    return folder


def test_numbered_files_belong_to_the_rows_of_the_poses(numbered):
    ledger = Ledger()
    log = read_numbered(numbered, ledger)
    (camera_log,) = log.cameras
    assert not ledger.lines()
    assert is_numbered(numbered)
    assert log.localization.stamps.tolist() == [10.5, 11.5, 12.5, 13.5]
    assert log.localization.poses[:, 0, 3].tolist() == [0, 1, 2, 3]
    assert camera_log.detections.frame_stamps.tolist() == [10.5, 11.5, 12.5, 13.5]
    assert camera_log.detections.frame.tolist() == [0, 1, 3]
    assert camera_log.detections.scores.tolist() == [0.1, 0.2, 0.4]
    assert camera_log.detections.boxes.tolist() == [[20, 10, 40, 30]] * 3
    assert camera_log.detections.label_names == ("object",)
    assert camera_log.detections.depths.tolist() == [1.0, 2.0, 4.0]
    assert np.array_equal(camera_log.camera.base_T_camera, np.eye(4))
    assert (camera_log.camera.width, camera_log.camera.depth_scale) == (64, 5000.0)
    assert [p.name for p in camera_log.rgb.paths] == [f"{n:04d}_rgb_raw.jpg" for n in range(4)]
    assert camera_log.depth.stamps.tolist() == [10.5, 11.5, 12.5, 13.5]
    assert log.truth is None


def test_a_bad_pose_line_does_not_shift_the_numbers(numbered):
    (numbered / "truth_cam_poses.txt").write_text("\n".join([_POSES[0], "broken", "", "# note", _POSES[2], _POSES[3]]))
    ledger = Ledger()
    detections = read_numbered(numbered, ledger).cameras[0].detections
    assert detections.frame_stamps.tolist() == [10.5, 12.5, 13.5]
    assert detections.scores.tolist() == [0.1, 0.4]
    assert ledger.dropped == {"pose line that is not 8 numbers": 1, "numbered file that no pose belongs to": 3}


def test_odd_files_are_dropped_and_named(numbered, tmp_path):
    (tmp_path / "secret.txt").write_text("1 1 9 9 1\n")
    boxes = numbered / "boxes"
    (boxes / "0001_yolo2_0.25.txt").write_text("1 1 9 9 1\n")
    (boxes / "0002_yolo2_0.15.txt").unlink()
    (boxes / "0002_yolo2_0.15.txt").symlink_to(tmp_path / "secret.txt")
    (boxes / "0007_yolo2_0.15.txt").write_text("1 1 9 9 1\n")
    (boxes / "notes.txt").write_text("1 1 9 9 1\n")
    (boxes / "0003_yolo2_0.15.txt").write_text("1 1 9\n1 1 -9 9 1\n80 1 1 9 9 1\n1.5 1 1 9 9 1\n0 1 1 9 9 1\n\xff")
    ledger = Ledger()
    detections = read_numbered(numbered, ledger, TumOptions(label="cabinet", with_range=False)).cameras[0].detections
    assert detections.frame_stamps.tolist() == [10.5, 11.5, 13.5]
    assert [detections.label_names[i] for i in detections.label] == ["cabinet", "cabinet", "person"]
    assert np.isnan(detections.depths).all()
    assert ledger.dropped == {
        "second file with the same number": 1,
        "numbered file that leaves the folder": 1,
        "numbered file that no pose belongs to": 2,
        'box line that is not "[class] x y w h score"': 2,
        "box line with a class number that is not in COCO": 2,
        "box without area (x2 <= x1 or y2 <= y1)": 1,
    }
    assert ledger.examples["box line with a class number that is not in COCO"] == [
        f"{boxes / '0003_yolo2_0.15.txt'}:{n}" for n in (3, 4)
    ]


def test_depth_images_that_cannot_be_used(numbered):
    depth = numbered / "depth_imgs"
    (depth / "0000_depth_raw.png").write_bytes(b"no image")
    cv2.imwrite(str(depth / "0001_depth_raw.png"), np.zeros((10, 10), dtype=np.uint16))
    (depth / "0003_depth_raw.png").unlink()
    ledger = Ledger()
    detections = read_numbered(numbered, ledger).cameras[0].detections
    assert np.isnan(detections.depths).all()
    assert ledger.dropped == {
        "depth image that cannot be decoded": 1,
        "depth image that is in colour or does not have the camera's size": 1,
        "depth of a frame without a depth image": 1,
    }


def test_images_are_optional_and_boxes_are_not(numbered):
    shutil.rmtree(numbered / "raw_imgs")
    shutil.rmtree(numbered / "depth_imgs")
    log = read_numbered(numbered, Ledger())
    assert log.cameras[0].rgb is None
    assert log.cameras[0].depth is None
    shutil.rmtree(numbered / "boxes")
    (numbered / "boxes").mkdir()
    with pytest.raises(LogError) as caught:
        read_numbered(numbered, Ledger())
    assert caught.value.where == str(numbered / "boxes")


def test_the_depth_of_a_box_is_robust():
    rng = np.random.default_rng(0)
    image = np.full((100, 100), 9000, dtype=np.uint16)  # a wall behind
    image[30:70, 30:70] = 2000 + rng.integers(-20, 20, (40, 40))
    image[45:55, 45:55] = 0  # a hole where the sensor saw nothing
    assert box_depth(image, np.array([25.0, 25, 75, 75]), 100.0) == pytest.approx(2000, abs=5)
    assert box_depth(image.astype(np.float32), np.array([25.0, 25, 75, 75]), 100.0) == pytest.approx(2000, abs=5)
    assert np.isnan(box_depth(np.zeros((100, 100), dtype=np.uint16), np.array([25.0, 25, 75, 75]), 100.0))
    mostly_empty = np.zeros((100, 100), dtype=np.uint16)
    mostly_empty[50, 50] = 2000
    assert np.isnan(box_depth(mostly_empty, np.array([25.0, 25, 75, 75]), 100.0))
    assert box_depth(image, np.array([50.2, 60.2, 50.4, 60.4]), 100.0) > 0  # smaller than a pixel
    for outside in ([-50.0, -50, -10, -10], [200.0, 200, 300, 300], [-1e9, -1e9, 1e9, 1e9]):
        assert box_depth(image, np.array(outside), 100.0) > 0 or outside[0] < -1e8


@pytest.mark.parametrize("share", [0.15, 0.3, 0.45])
@pytest.mark.parametrize("noise", [0, 30])
def test_the_depth_of_a_thin_thing_is_not_that_of_the_wall_behind_it(share, noise):
    """Its box is 0.5 m wide and high at 2 m. A wall at 3 m shows in most of it, and one at 5 m in a corner."""
    rng = np.random.default_rng(0)
    image = np.full((100, 100), 3000.0)
    image[:45, :45] = 5000
    image[:, 50 : 50 + round(25 * share)] = 2000
    image = image + noise * rng.normal(size=image.shape)
    assert box_depth(image, np.array([25.0, 25, 75, 75]), 200.0) == pytest.approx(2000, abs=20)


@pytest.mark.parametrize("noise", [0.0, 40.0, 400.0])
@pytest.mark.parametrize("slope", [0.0, 8.0])
def test_depths_without_a_gap_keep_their_median(noise, slope):
    """Of a noisy wall, and of one that recedes by 0.8 m over the image: far more than a small box is wide."""
    columns = slope * np.arange(100.0)
    image = 4000 + columns + noise * np.random.default_rng(1).normal(size=(100, 100))
    assert box_depth(image, np.array([20.0, 20, 80, 80]), 5000.0) == pytest.approx(4000 + 50 * slope, abs=10 + noise / 10)


def _archive(folder, files, name="yolo.tar.gz"):
    with tarfile.open(folder / name, "w:gz") as archive:
        for path, content in files:
            if isinstance(content, tarfile.TarInfo):
                archive.addfile(content)
                continue
            info = tarfile.TarInfo(path)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))


def _member(path, kind, target=""):
    info = tarfile.TarInfo(path)
    info.type, info.linkname = kind, target
    return info


@pytest.fixture
def stamped(tmp_path):
    folder = tmp_path / "office"
    folder.mkdir()
    (folder / "groundtruth.txt.gz").write_bytes(gzip.compress("\n".join(_POSES).encode()))
    return folder


def test_an_archive_is_read_where_it_is(stamped):
    files = [
        ("boxes", _member("boxes", tarfile.DIRTYPE)),
        ("boxes/12.25.txt", b"41 1 2 3 4 0.5"),
        ("boxes/11.25.txt", b"66 1 2 3 4 0.5\n77 5 6 7 8 0.25\n"),
        ("boxes/13.25.txt", b""),
        ("../../11.75.txt", b"0 1 2 3 4 1\n"),  # only its name counts
        ("boxes/readme.txt", b"hello"),
        ("boxes/14.25.txt", _member("boxes/14.25.txt", tarfile.SYMTYPE, "/etc/passwd")),
        ("boxes/15.25.txt", _member("boxes/15.25.txt", tarfile.LNKTYPE, "boxes/12.25.txt")),
        ("boxes/16.25.txt", _member("boxes/16.25.txt", tarfile.FIFOTYPE)),
        ("boxes/17.25.txt", b"0" * (1 << 20) + b"0"),
        ("more/12.25.txt", b"0 1 2 3 4 1\n"),  # the stamp is there already
    ]
    _archive(stamped, files)
    before = sorted(stamped.parent.rglob("*"))
    ledger = Ledger()
    log = read_stamped(stamped, ledger)
    assert sorted(stamped.parent.rglob("*")) == before
    detections = log.cameras[0].detections
    assert detections.frame_stamps.tolist() == [11.25, 11.75, 12.25, 13.25]
    assert [detections.label_names[i] for i in detections.label] == ["keyboard", "teddy bear", "person", "cup"]
    assert detections.boxes[1].tolist() == [5, 6, 12, 14]
    assert np.isnan(detections.depths).all()
    assert log.localization.stamps.tolist() == [10.5, 11.5, 12.5, 13.5]
    assert log.cameras[0].camera.matrix[0].tolist() == [535.4, 0, 320.1]
    assert ledger.dropped == {
        "box file not named after a stamp": 1,
        "box file that is not a regular file": 3,
        "box file that is too large": 1,
        "detection frame with a stamp that repeats or goes back": 1,
    }
    assert ledger.examples["box file that is too large"] == [f"{stamped / 'yolo.tar.gz'}:17.25.txt"]
    assert "freiburg3" in ledger.warnings[0]


def test_an_archive_that_is_cut_off_gives_what_is_whole(stamped):
    rng = np.random.default_rng(0)
    files = [
        (f"{n}.5.txt", "".join(f"41 {x} 2 3 4 0.5\n" for x in rng.integers(0, 600, 50)).encode()) for n in range(100, 300)
    ]
    _archive(stamped, files)
    whole = (stamped / "yolo.tar.gz").read_bytes()
    (stamped / "yolo.tar.gz").write_bytes(whole[: len(whole) // 2])
    ledger = Ledger()
    detections = read_stamped(stamped, ledger).cameras[0].detections
    assert 50 < len(detections.frame_stamps) < 150
    assert len(detections) == 50 * len(detections.frame_stamps)
    assert "cut off" in ledger.warnings[0]


def test_a_folder_of_boxes(stamped, tmp_path):
    boxes = stamped / "yolo_txts"
    boxes.mkdir()
    (boxes / "11.5.txt").write_text("41 1 2 3 4 0.5\n1 2 3 4 0.25\n")
    (boxes / "12.5.txt").symlink_to(tmp_path / "secret")
    (boxes / "13.5.txt").mkdir()
    (boxes / "README").touch()
    assert is_stamped(stamped)
    ledger = Ledger()
    detections = read_stamped(stamped, ledger, TumOptions(label="thing")).cameras[0].detections
    assert detections.frame_stamps.tolist() == [11.5]
    assert [detections.label_names[i] for i in detections.label] == ["cup", "thing"]
    assert ledger.dropped == {"box file that is not a regular file": 2, "box file not named after a stamp": 1}
    _archive(stamped, [("11.5.txt", b"41 1 2 3 4 0.5")])
    with pytest.raises(LogError, match=r"several sets of boxes: yolo_txts, yolo\.tar\.gz"):
        read_stamped(stamped, Ledger())


def test_images_without_boxes_are_left_to_a_detector(stamped):
    assert not is_stamped(stamped)
    (stamped / "rgb").mkdir()
    (stamped / "rgb" / "a.png").touch()
    (stamped / "rgb.txt").write_text("11.5 rgb/a.png\n")
    assert is_stamped(stamped)
    log = read_stamped(stamped, Ledger())
    assert log.cameras[0].detections is None
    assert len(log.cameras[0].rgb.paths) == 1


def test_depth_images_stamped_on_their_own(stamped):
    (stamped / "camera.yaml").write_text(_CAMERA)
    for n, stamp in enumerate((11.51, 12.53)):
        cv2.imwrite(str(stamped / f"{n}.png"), _depth(5000 * (n + 1)))
        with (stamped / "depth.txt").open("a") as file:
            file.write(f"{stamp} {n}.png\n")
    _archive(stamped, [(f"{s}.txt", b"41 20 10 20 20 0.5") for s in ("11.5", "12.5")])
    ledger = Ledger()
    depths = read_stamped(stamped, ledger).cameras[0].detections.depths
    np.testing.assert_array_equal(depths, [1.0, np.nan])
    assert ledger.dropped == {"depth of a frame without a depth image": 1}


def test_no_path(stamped):
    (stamped / "groundtruth.txt.gz").unlink()
    with pytest.raises(LogError, match=r"groundtruth\.txt"):
        read_stamped(stamped, Ledger())
