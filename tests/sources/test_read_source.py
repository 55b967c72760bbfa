import pytest

from objslam import sources
from objslam.core.diagnostics import Ledger
from objslam.errors import ConfigError, LogError
from objslam.sources import SOURCES, SourceOptions, read
from objslam.sources.options import flags, names

_CAMERA = """\
image_width: 640
image_height: 480
camera_matrix: [500, 0, 320, 0, 500, 240, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients: []
base_T_camera: {translation: [0, 0, 0], rotation_xyzw: [0, 0, 0, 1]}
"""
_POSE = "1.5 1 2 3 0 0 0 1\n"


def _write(folder, files):
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def _log(folder):
    return _write(folder, {"camera.yaml": _CAMERA, "odometry.txt": _POSE})


def _mrclam(folder):
    names = ("Robot1_Odometry.dat", "Robot1_Measurement.dat")
    return _write(folder, {"Barcodes.dat": "6 63\n", names[0]: "1 1 1\n2 1 1\n", names[1]: "1.5 63 2 0.1\n"})


def _numbered(folder):
    return _write(folder, {"truth_cam_poses.txt": _POSE, "boxes/0000.txt": "1 2 3 4 0.5\n"})


def _stamped(folder):
    return _write(folder, {"groundtruth.txt": _POSE, "boxes/1.5.txt": "41 1 2 3 4 0.5\n"})


@pytest.mark.parametrize(
    ("make", "name"), [(_log, "log"), (_mrclam, "mrclam"), (_numbered, "tum_numbered"), (_stamped, "tum")]
)
def test_the_kind_is_guessed(tmp_path, make, name):
    make(tmp_path)
    assert [source.name for source in SOURCES if source.detects(tmp_path)] == [name]
    options = SourceOptions(robot=1 if name == "mrclam" else None)
    log = read(tmp_path, Ledger(), options)
    assert log.odometry or log.localization
    given = read(tmp_path, Ledger(), SourceOptions(format=name, robot=options.robot))
    assert given.name == log.name


def test_a_log_folder_comes_first(tmp_path):
    _stamped(_log(tmp_path))
    assert read(tmp_path, Ledger()).odometry is not None


def test_options_reach_the_reader(tmp_path):
    log = read(_mrclam(tmp_path / "a"), Ledger(), SourceOptions(robot=1, anonymous=True))
    assert log.cameras[0].detections.label_names == ("landmark",)
    log = read(_numbered(tmp_path / "b"), Ledger(), SourceOptions(label="cabinet"))
    assert log.cameras[0].detections.label_names == ("cabinet",)


def test_options_without_a_meaning_are_named(tmp_path):
    ledger = Ledger()
    read(_log(tmp_path), ledger, SourceOptions(robot=3, label="x", anonymous=True, with_range=False))
    assert [
        f": {flag} has no meaning" in w
        for flag, w in zip(("--robot", "--without-range", "--anonymous", "--label"), ledger.warnings, strict=True)
    ] == [True] * 4
    ledger = Ledger()
    read(tmp_path, ledger, SourceOptions(format="log"))
    assert not ledger.lines()


@pytest.mark.parametrize("source", [source for source in SOURCES if source.options], ids=lambda source: source.name)
def test_the_options_of_every_source_are_among_those_of_all(source):
    assert names(source.options) <= names(SourceOptions)
    everything = flags(SourceOptions)
    for name, declared in flags(source.options).items():  # two sources may share an option, not have two of one name
        assert everything[name] == declared
        assert getattr(SourceOptions, name) == getattr(source.options, name)


def test_nothing_that_fits_lists_what_was_looked_for(tmp_path):
    (tmp_path / "notes.md").touch()
    with pytest.raises(LogError, match=r"the folder holds notes\.md") as caught:
        read(tmp_path, Ledger())
    assert caught.value.where == str(tmp_path)
    for source in SOURCES:
        assert f"{source.name}: {source.looks_for}" in caught.value.hint


@pytest.mark.parametrize(
    ("files", "given", "what", "hint"),
    [
        (["drive.mp4"], "drive.mp4", "a video has neither poses nor a calibration", "images"),
        (["drive.MP4", "more.avi"], "", "a video has neither poses nor a calibration", "images"),
        (["log.zip"], "log.zip", "an archive", "unpack"),
        (["log.tar.gz"], "log.tar.gz", "an archive", "unpack"),
        (["1.jpg"], "1.jpg", "a single image", "camera.yaml"),
        (["notes.txt"], "notes.txt", "no ROS bag", "camera.yaml"),
        ([], "", "the folder is empty", "camera.yaml"),
        (["1.jpg", "2.PNG", "notes.txt"], "", "2 images, but camera.yaml, rgb.txt, and the poses", "README"),
        (["rgb/1.jpg", "rgb.txt"], "", "1 images in rgb/, but camera.yaml, and the poses", "README"),
        (["mine/camera.yaml", "mine/odometry.txt"], "", "the recordings are in its subfolders", "mine"),
    ],
)
def test_what_no_source_reads_is_called_by_its_name(tmp_path, files, given, what, hint):
    folder = tmp_path / "given"
    folder.mkdir()
    for name in files:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("something")
    with pytest.raises(LogError) as caught:
        read(folder / given, Ledger())
    assert what in caught.value.message
    assert hint in caught.value.hint
    assert len(str(caught.value)) < 300 + len(str(folder))


def test_an_empty_file_is_called_empty(tmp_path):
    (tmp_path / "photo.jpg").touch()
    with pytest.raises(LogError, match="the file is empty"):
        read(tmp_path / "photo.jpg", Ledger())


@pytest.mark.parametrize("order", [1, -1])
def test_half_a_log_says_what_is_missing(tmp_path, monkeypatch, order):
    monkeypatch.setattr(sources, "SOURCES", SOURCES[::order])
    (tmp_path / "camera.yaml").write_text(_CAMERA)
    with pytest.raises(LogError, match=r"neither odometry\.txt nor localization\.txt"):
        read(tmp_path, Ledger())


@pytest.mark.parametrize("name", ["missing", "x" * 300, "nul\0"])
def test_no_such_path(tmp_path, name):
    with pytest.raises(LogError, match="cannot be read"):
        read(tmp_path / name, Ledger())


def test_mrclam_needs_a_robot(tmp_path):
    with pytest.raises(LogError, match="the folder has: 1"):
        read(_mrclam(tmp_path), Ledger())


def test_an_unknown_format(tmp_path):
    with pytest.raises(ConfigError, match="there is no format 'bag'"):
        read(tmp_path, Ledger(), SourceOptions(format="bag"))


def test_a_format_that_does_not_fit(tmp_path):
    (tmp_path / "file").touch()
    for source in SOURCES:
        for path in (tmp_path, tmp_path / "file"):
            with pytest.raises(LogError):
                read(path, Ledger(), SourceOptions(format=source.name, robot=1))


def test_a_result_is_no_log(tmp_path):
    for name in ("objects.json", "summary.json"):
        (tmp_path / name).write_text("{}")
    with pytest.raises(LogError, match="this is a result, not a log"):
        read(tmp_path, Ledger())


def test_numbered_labels_get_names_while_any_recording_is_read(tmp_path):
    box = '{"stamp": 1.5, "boxes": [[1, 2, 30, 40], [5, 6, 70, 80]], "labels": ["41", "99"], "scores": [0.9, 0.8]}\n'
    folder, ledger = _write(_log(tmp_path / "log"), {"detections.jsonl": box}), Ledger()
    found = read(folder, ledger, SourceOptions(class_names="coco")).cameras[0].detections
    assert [found.label_names[label] for label in found.label] == ["cup", "99"]
    assert [line for line in ledger.warnings if "class number" in line] == [
        "1 box keeps a class number that coco does not name: 99"
    ]
    assert read(folder, Ledger()).cameras[0].detections.label_names == ("41", "99")
    with pytest.raises(ConfigError, match="no names file"):
        read(folder, Ledger(), SourceOptions(class_names="missing.txt"))
