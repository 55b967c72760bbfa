import re

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from objslam.core.camera import Camera, RangeNoise
from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.io.camera_yaml import read_camera, write_camera

_TEXT = """\
image_width: 640
image_height: 480
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [500.5, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 1e-05, 5e-4, 0.0]}
base_T_camera:
  translation: [0.1, 0.2, 1.3]
  rotation_xyzw: [-0.5, 0.5, -0.5, 0.5]
depth_scale: 5000
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""


def _read(tmp_path, text, **options):
    file = tmp_path / "camera.yaml"
    file.write_text(text, encoding="utf-8")
    ledger = Ledger()
    return read_camera(file, ledger, **options), ledger, file


def test_a_ros_calibration_is_read(tmp_path):
    camera, ledger, _ = _read(tmp_path, _TEXT)
    assert (camera.name, camera.width, camera.height, camera.depth_scale) == ("front", 640, 480, 5000.0)
    assert camera.matrix.tolist() == [[500.5, 0, 320], [0, 501, 240], [0, 0, 1]]
    assert camera.distortion_model == "plumb_bob"
    assert camera.distortion.tolist() == [0.1, -0.2, 1e-05, 5e-4, 0.0]
    # REP 103: the optical z axis is base x, the optical x axis is base -y
    np.testing.assert_allclose(camera.base_T_camera, [[0, 0, 1, 0.1], [-1, 0, 0, 0.2], [0, -1, 0, 1.3], [0, 0, 0, 1]])
    assert not ledger.lines()


@pytest.mark.parametrize(
    "camera",
    [
        Camera("camera", 640, 480, np.array([[0.1 + 0.2, 0, 1 / 3], [0, 1e-5, 2 / 3], [0, 0, 1]])),
        Camera("yes", 1, 2, np.diag([1e6, 3.3e-6, 1]), "equidistant", np.array([1e-300, -2e-5, 3, 0.1]), depth_scale=3.3e22),
        Camera("Küche 1", 9, 9, np.diag([9.0, 9, 1]), "rational_polynomial", np.arange(14) / 7, depth_scale=1e-6),
    ],
)
def test_written_cameras_read_back(tmp_path, camera):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([0.3, -2.0, 0.7]).as_matrix(), [0.1, 1 / 3, -1e-9]
    camera = Camera(**(vars(camera) | {"base_T_camera": pose}))
    write_camera(camera, tmp_path / "camera.yaml")
    read = read_camera(tmp_path / "camera.yaml", Ledger())
    assert vars(read).keys() == vars(camera).keys()
    for name in ("name", "width", "height", "distortion_model", "depth_scale"):
        assert getattr(read, name) == getattr(camera, name)
    for name in ("matrix", "distortion"):
        assert np.array_equal(getattr(read, name), getattr(camera, name))
    np.testing.assert_allclose(read.base_T_camera, pose, atol=1e-15)
    assert yaml.safe_load((tmp_path / "camera.yaml").read_text(encoding="utf-8"))["camera_name"] == camera.name


@pytest.mark.parametrize(
    "matrix",
    [
        "[500.5, 0, 320, 0, 501, 240, 0, 0, 1]",
        "[[500.5, 0, 320], [0, 501, 240], [0, 0, 1]]",
        "{data: [500.5, 0, 320, 0, 501, 240, 0, 0, 1]}",
    ],
)
def test_other_forms_of_a_matrix(tmp_path, matrix):
    text = yaml.safe_dump(yaml.safe_load(_TEXT) | {"camera_matrix": yaml.safe_load(matrix)})
    assert _read(tmp_path, text)[0].matrix.tolist() == [[500.5, 0, 320], [0, 501, 240], [0, 0, 1]]


@pytest.mark.parametrize(
    ("model", "coefficients", "expected"),
    [
        ("plumb_bob", "[0.1, 0.2, 0.3, 0.4]", ("plumb_bob", [0.1, 0.2, 0.3, 0.4])),
        ("plumb_bob", "[[0.1, 0.2, 0.3, 0.4, 0.5]]", ("plumb_bob", [0.1, 0.2, 0.3, 0.4, 0.5])),
        ("plumb_bob", "[]", ("plumb_bob", [0] * 5)),
        ("plumb_bob", "", ("plumb_bob", [0] * 5)),
        ('""', "{rows: 0, cols: 0, data: []}", ("plumb_bob", [0] * 5)),
        ("rational_polynomial", "[1, 2, 3, 4, 5, 6, 7, 8]", ("rational_polynomial", [1, 2, 3, 4, 5, 6, 7, 8])),
        ("rational_polynomial", f"[{', '.join('0' * 12)}]", ("rational_polynomial", [0] * 12)),
        ("equidistant", "[1, 2, 3, 4]", ("equidistant", [1, 2, 3, 4])),
    ],
)
def test_distortion_models(tmp_path, model, coefficients, expected):
    lines = _TEXT.splitlines()
    lines[7], lines[8] = f"distortion_model: {model}", f"distortion_coefficients: {coefficients}"
    camera, _, _ = _read(tmp_path, "\n".join(lines))
    assert (camera.distortion_model, camera.distortion.tolist()) == expected


def test_a_camera_tells_the_noise_of_its_depths(tmp_path):
    camera, _, file = _read(tmp_path, _TEXT + "depth_noise: {sigma: 0.01, sigma_per_m: 5e-3, bias: 0}\n")
    assert camera.depth_noise == RangeNoise(0.01, 0.005, 0.0)
    write_camera(camera, file)
    assert read_camera(file, Ledger()).depth_noise == camera.depth_noise
    assert _read(tmp_path, _TEXT)[0].depth_noise is None


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ("0.01", "depth_noise must be a mapping"),
        ("{sigma: 0.01, sigma_per_m: 0.005}", "depth_noise.bias is missing"),
        ("{sigma: 0, sigma_per_m: 0.005, bias: 0.02}", "depth_noise.sigma must be above zero"),
        ("{sigma: 0.01, sigma_per_m: -0.005, bias: 0.02}", "depth_noise.sigma_per_m must be at least zero"),
        ("{sigma: .inf, sigma_per_m: 0.005, bias: 0.02}", "depth_noise.sigma must be a finite number"),
    ],
)
def test_what_is_wrong_with_the_noise_of_depths_is_told(tmp_path, noise, message):
    with pytest.raises(LogError, match=f"camera.yaml:15: {message}"):
        _read(tmp_path, _TEXT + f"depth_noise: {noise}\n")


def test_a_camera_that_sees_no_sizes_is_kept(tmp_path):
    camera, _, file = _read(tmp_path, _TEXT + "sees_size: false\n")
    assert not camera.sees_size
    write_camera(camera, file)
    assert not read_camera(file, Ledger()).sees_size
    assert _read(tmp_path, _TEXT)[0].sees_size
    with pytest.raises(LogError, match=r"camera.yaml:15: sees_size must be true or false, not 'maybe'"):
        _read(tmp_path, _TEXT + "sees_size: maybe\n")


def test_optional_keys(tmp_path):
    lines = [line for i, line in enumerate(_TEXT.splitlines()) if i not in (2, 9, 10, 11, 12)]
    camera, _, _ = _read(tmp_path, "\n".join(lines), place_needed=False, depth_scale=7.0)
    assert camera.name == "camera"
    assert camera.depth_scale == 7.0
    assert np.array_equal(camera.base_T_camera, np.eye(4))
    assert _read(tmp_path, _TEXT, name="left")[0].name == "left"


@pytest.mark.parametrize(
    "key", ["image_width", "image_height", "camera_matrix", "distortion_model", "distortion_coefficients", "base_T_camera"]
)
def test_a_missing_key_is_named(tmp_path, key):
    data = yaml.safe_load(_TEXT)
    del data[key]
    with pytest.raises(LogError, match=f"{key} is missing") as caught:
        _read(tmp_path, yaml.safe_dump(data))
    assert caught.value.where == str(tmp_path / "camera.yaml")
    assert "image" in caught.value.hint or "camera_matrix" in caught.value.hint  # what was found instead


@pytest.mark.parametrize("key", ["camera_matrix", "base_T_camera"])
def test_the_form_of_a_missing_key_is_valid(tmp_path, key):
    data = yaml.safe_load(_TEXT)
    del data[key]
    with pytest.raises(LogError) as caught:
        _read(tmp_path, yaml.safe_dump(data))
    form = caught.value.hint.removeprefix("write ").partition(" for a camera")[0].partition(";")[0]
    for name, value in {"fx": 500, "fy": 501, "cx": 320, "cy": 240, "x": 0.1, "y": 0.2, "z": 0.3}.items():
        form = re.sub(rf"\b{name}\b", str(value), form)
    camera = _read(tmp_path, yaml.safe_dump(data) + form)[0]
    assert camera.matrix[1:].tolist() == [[0, 501, 240], [0, 0, 1]]
    if key == "base_T_camera":
        assert camera.base_T_camera[:3].tolist() == [[0, 0, 1, 0.1], [-1, 0, 0, 0.2], [0, -1, 0, 0.3]]


@pytest.mark.parametrize(
    ("line", "text", "message"),
    [
        (1, "image_width: 0", "image_width must be a whole number"),
        (1, "image_width: -640", "image_width must be a whole number"),
        (1, "image_width: 640.5", "image_width must be a whole number"),
        (1, "image_width: 1e12", "image_width must be a whole number of pixels, 1 to 65536"),
        (1, "image_width: wide", "image_width must be a finite number, got 'wide'"),
        (1, "image_width: .nan", "image_width must be a finite number"),
        (1, "image_width: [640]", "image_width must be one value"),
        (2, "image_width: 480", "occurs twice"),
        (2, "? [a, b] : 480", "not a word"),
        (3, "camera_name: [front]", "camera_name must be one value"),
        (5, "  rows: 2", "camera_matrix says 2 x 3 but has 9"),
        (7, "  data: [500, 0, 320, 0, 500, 240]", "camera_matrix says 3 x 3 but has 6"),
        (7, "  data: 500", "camera_matrix.data must be a list"),
        (7, "  data: [0, 0, 320, 0, 501, 240, 0, 0, 1]", "focal length"),
        (7, "  data: [500, 0, 320, 0, -501, 240, 0, 0, 1]", "focal length"),
        (7, "  data: [500, 0, 320, 0, 501, 240, 0, 0, 2]", "not a pinhole matrix"),
        (7, "  data: [500, 0, 320, 3, 501, 240, 0, 0, 1]", "not a pinhole matrix"),
        (7, "  data: [500, 0, 320, x, 501, 240, 0, 0, 1]", "camera_matrix.data must be a finite number, got 'x'"),
        (7, "  data: [[[500]], 0, 320, 0, 501, 240, 0, 0, 1]", "must be one value"),
        (7, "  numbers: [500, 0, 320, 0, 501, 240, 0, 0, 1]", "camera_matrix.data is missing"),
        (8, "distortion_model: fisheye", "unknown distortion_model 'fisheye'"),
        (8, "distortion_model: equidistant", "equidistant takes 4 distortion_coefficients, got 5"),
        (8, 'distortion_model: ""', "unknown distortion_model ''"),
        (9, "distortion_coefficients: [1, 2, 3, 4, 5, 6, 7, 8]", "plumb_bob takes 4 or 5 distortion_coefficients, got 8"),
        (9, "distortion_coefficients: none", "must be a list of numbers"),
        (11, "  translation: [1, 2]", "translation must be 3 numbers, got 2"),
        (11, "  position: [1, 2, 3]", "base_T_camera.translation is missing"),
        (12, "  rotation_xyzw: [0, 0, 0]", "rotation_xyzw must be 4 numbers, got 3"),
        (12, "  rotation_xyzw: [0, 0, 0, 0]", "rotation_xyzw must have length 1, has 0"),
        (12, "  rotation_xyzw: [1, 1, 1, 1]", "rotation_xyzw must have length 1, has 2"),
        (12, "  rotation_xyzw: [0, 0, 0, .inf]", "must be a finite number"),
        (13, "depth_scale: 0", "depth_scale must be above zero"),
        (13, "depth_scale: -1000", "depth_scale must be above zero"),
        (13, "depth_scale: {a: 1}", "depth_scale must be one value"),
        (9, "distortion_coefficients: [1, 2", "not YAML"),
        (2, "image_height: !!python/object/apply:os.system [true]", "image_height must be one value"),
        (2, "image_height: *nothing", "not YAML"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_its_line(tmp_path, line, text, message):
    lines = _TEXT.splitlines()
    lines[line - 1] = text
    with pytest.raises(LogError) as caught:
        _read(tmp_path, "\n".join(lines))
    assert message in caught.value.message
    found_at = {5: 7, 8: 9} if "says" in message or "takes" in message else {}  # where the numbers are
    if "is missing" in message:
        found_at = {7: 5, 11: 11}  # where the block begins
    if message == "not YAML" and line == 9:
        found_at = {9: 10}  # the list runs on into the next line
    assert caught.value.where == f"{tmp_path / 'camera.yaml'}:{found_at.get(line, line)}"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "nothing in it"),
        (b"# only a comment\n", "nothing in it"),
        (b"- a\n- b\n", "must be a mapping"),
        (b"text", "must be a mapping"),
        (b"\xff\xfe\x00", "not UTF-8"),
        (b"a: \x00", "not YAML"),
        (b"[" * 5000, "nested too deeply"),
        (b"%YAML:1.0\n---\nCamera.fx: 500\n", "not YAML"),
        (b"a: 1\n---\nb: 2\n", "not YAML"),
    ],
)
def test_what_is_no_camera_file(tmp_path, content, message):
    file = tmp_path / "camera.yaml"
    file.write_bytes(content)
    with pytest.raises(LogError, match=message) as caught:
        read_camera(file, Ledger())
    assert caught.value.where.startswith(str(file))


def test_aliases_that_contain_themselves_or_explode(tmp_path):
    bomb = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
    )
    for matrix in ("&m [*m]", "*i"):
        with pytest.raises(LogError):
            _read(tmp_path, bomb + f"image_width: 6\nimage_height: 4\ncamera_matrix: {matrix}\n")


def test_doubtful_calibrations_are_warned_about(tmp_path):
    _, ledger, file = _read(tmp_path, _TEXT.replace("[500.5, 0.0, 320.0", "[500.5, 2.5, 960.0"))
    assert [w.startswith(str(file)) for w in ledger.warnings] == [True, True]
    assert "skew of 2.5" in ledger.warnings[0]
    assert "640x480" in ledger.warnings[1]


def test_no_file(tmp_path):
    with pytest.raises(LogError, match="No such file"):
        read_camera(tmp_path / "camera.yaml", Ledger())


def test_a_quaternion_of_absurd_length_is_refused_without_a_warning(tmp_path, recwarn):
    (tmp_path / "camera.yaml").write_text(_TEXT.replace("rotation_xyzw: [-0.5", "rotation_xyzw: [1.0e+300"))
    with pytest.raises(LogError, match="must have length 1, has inf"):
        read_camera(tmp_path / "camera.yaml", Ledger())
    assert not recwarn.list
