"""Read and write camera.yaml, which has ROS camera_info keys and the pose of the camera on the robot.

The reader uses YAML nodes, because they keep line numbers. It also reads 1e-05 as a number, although YAML 1.1 reads text.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_args

import numpy as np
import yaml

from objslam.core.arrays import Floats
from objslam.core.camera import COEFFICIENTS, Camera, DistortionModel, RangeNoise
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import pose_from_quaternion, quaternion
from objslam.core.validity import MAX_SIDE, camera_fault, lengths, valid_positions
from objslam.errors import LogError
from objslam.io.text import misspelt, read_bytes

_CAMERAS = "cameras"
_AHEAD = "rotation_xyzw: [-0.5, 0.5, -0.5, 0.5]"
_FORMS = {
    "camera_matrix": "camera_matrix: [fx, 0, cx, 0, fy, cy, 0, 0, 1]",
    "base_T_camera": f"base_T_camera: {{translation: [x, y, z], {_AHEAD}}} for a camera that looks straight ahead",
    "rotation_xyzw": f"{_AHEAD} for a camera that looks straight ahead",
}
"""Examples of keys with values in the right form, for error messages. People often write these keys in another way."""
_KEYS = frozenset(
    (
        *("camera_name", "image_width", "image_height", "camera_matrix", "distortion_model", "distortion_coefficients"),
        *("base_T_camera", "depth_scale", "depth_noise", "sees_size", "rectification_matrix", "projection_matrix"),
    )
)
"""The known keys of a camera. The last two occur in files of ROS, and are not read."""
_Mapping = dict[str, yaml.Node]


@dataclass(frozen=True)
class Calibration:
    """A camera from a file. placed: whether the file has base_T_camera. If the file does not have it, the pose of the
    camera is the identity."""

    camera: Camera
    placed: bool


@dataclass(frozen=True)
class Mount:
    """The pose (4, 4) of a camera on the robot, from a file without the camera's calibration. name: "" if it is missing."""

    name: str
    base_T_camera: Floats


def read_camera(
    path: Path, ledger: Ledger, *, name: str | None = None, place_needed: bool = True, depth_scale: float = 1000.0
) -> Camera:
    """Read a camera file. Raises LogError with the line of an invalid value.

    name: the camera name. If it is None, the name is camera_name from the file, or "camera" if the file has no name.
    place_needed: whether base_T_camera must be in the file. If False, a missing base_T_camera is the identity.
    depth_scale: the value for a file without depth_scale, in units of the depth image per metre.
    """
    return _read(path, _load(path, read_bytes(path), "the file"), ledger, name, place_needed, depth_scale).camera


def read_calibrations(path: Path, ledger: Ledger) -> tuple[Calibration, ...]:
    """Return the camera of a file, or its named cameras under the key `cameras`. Raises LogError with the line of an error.

    Cameras for which the file has only base_T_camera are left out. `read_mounts` reads them.
    """
    return tuple(_read(path, keys, ledger, name) for name, keys in _sections(path) if not _only_mount(keys))


def read_mounts(path: Path) -> tuple[Mount, ...]:
    """Return the cameras for which a file has only base_T_camera and perhaps a name. `read_calibrations` reads all others.

    Raises LogError with the line of an error.
    """
    named = [(name, keys) for name, keys in _sections(path) if _only_mount(keys)]
    return tuple(
        Mount(
            name or (_text(path, keys["camera_name"], "camera_name") if "camera_name" in keys else ""),
            _pose(path, keys["base_T_camera"]),
        )
        for name, keys in named
    )


def _sections(path: Path) -> list[tuple[str | None, _Mapping]]:
    """Return the name and the keys of each camera in a file. The name is None if the file has a single camera."""
    top = _load(path, read_bytes(path), "the file")
    if _CAMERAS not in top:
        return [(None, top)]
    cameras = _mapping(path, top[_CAMERAS], _CAMERAS)
    if not cameras:
        raise _error(path, top[_CAMERAS], "no camera in it")
    return [(name, _mapping(path, node, f"{_CAMERAS}.{name}")) for name, node in cameras.items()]


def _only_mount(keys: _Mapping) -> bool:
    return "base_T_camera" in keys and set(keys) <= {"base_T_camera", "camera_name"}


def _read(
    path: Path, top: _Mapping, ledger: Ledger, name: str | None = None, placed: bool = False, depth_scale: float = 1000.0
) -> Calibration:
    for key, meant in misspelt(top, _KEYS).items():
        ledger.warn(f"{path}: the key {key} is not known, and is not read (did you mean {meant}?)")
    width, height = _size(path, top, "image_width"), _size(path, top, "image_height")
    matrix = _matrix(path, _get(path, top, "camera_matrix"))
    if abs(matrix[0, 1]) > 1e-6 * matrix[0, 0]:
        ledger.warn(f"{path}: camera_matrix has a skew of {matrix[0, 1]:g} px, which is left out")
    if not (0 <= matrix[0, 2] <= width and 0 <= matrix[1, 2] <= height):
        ledger.warn(f"{path}: the principal point lies outside the image: is the calibration for {width}x{height}?")
    model, distortion = _distortion(path, top)
    placed = placed or "base_T_camera" in top
    base_T_camera = _pose(path, _get(path, top, "base_T_camera")) if placed else np.eye(4)
    if "depth_scale" in top:
        depth_scale = _number(path, top["depth_scale"], "depth_scale")
        if depth_scale <= 0:
            raise _error(path, top["depth_scale"], "depth_scale must be above zero", "units per metre, such as 1000 for mm")
    sees_size = _text(path, top["sees_size"], "sees_size") if "sees_size" in top else "true"
    if sees_size not in ("true", "false"):
        raise _error(path, top["sees_size"], f"sees_size must be true or false, not {sees_size[:40]!r}")
    noise = _depth_noise(path, top["depth_noise"]) if "depth_noise" in top else None
    if name is None:
        name = _text(path, top["camera_name"], "camera_name") if "camera_name" in top else "camera"
    sees = sees_size == "true"
    camera = Camera(name, width, height, matrix, model, distortion, base_T_camera, depth_scale, sees, noise)
    if (fault := camera_fault(camera)) is not None:
        raise LogError(f"camera {fault}: a number is too large or too small", where=str(path))
    return Calibration(camera, placed)


def parse_camera(text: bytes, place: str, ledger: Ledger, name: str | None) -> Camera:
    """Return the camera in the text of a camera file. Raises LogError, which names `place` as the file.

    name: the camera name, as for `read_camera`. The text must have base_T_camera.
    """
    path = Path(place)
    return _read(path, _load(path, text, "the camera"), ledger, name, True).camera


def write_camera(camera: Camera, path: Path) -> None:
    """Write a camera file. Every number except the quaternion of the rotation is read back as the same float."""
    path.write_text(dump_camera(camera), encoding="utf-8")


def dump_camera(camera: Camera) -> str:
    """Return the text of a camera file, as `write_camera` writes it."""
    return _dumped(camera_keys(camera))


def camera_keys(camera: Camera) -> dict[str, Any]:
    """Return the keys and values of a camera file for `camera`."""
    return {
        "camera_name": camera.name,
        "image_width": int(camera.width),
        "image_height": int(camera.height),
        "camera_matrix": {"rows": 3, "cols": 3, "data": camera.matrix.ravel().tolist()},
        "distortion_model": camera.distortion_model,
        "distortion_coefficients": {"rows": 1, "cols": len(camera.distortion), "data": camera.distortion.tolist()},
        "base_T_camera": _written(camera.base_T_camera),
        "depth_scale": float(camera.depth_scale),
        **({} if camera.sees_size else {"sees_size": False}),
        **({} if camera.depth_noise is None else {"depth_noise": asdict(camera.depth_noise)}),
    }


def write_mounts(mounts: Mapping[str, Floats], path: Path) -> None:
    """Write a file that `read_mounts` reads. mounts: maps the name of each camera to its base_T_camera (4, 4)."""
    cameras = {name: {"base_T_camera": _written(pose)} for name, pose in mounts.items()}
    path.write_text(_dumped({_CAMERAS: cameras}), encoding="utf-8")


def _written(pose: Floats) -> dict[str, list[float]]:
    return {"translation": pose[:3, 3].tolist(), "rotation_xyzw": quaternion(pose[None])[0].tolist()}


def _dumped(data: Mapping[str, Any]) -> str:
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, allow_unicode=True, width=125)


def _error(path: Path, node: yaml.Node, message: str, hint: str | None = None) -> LogError:
    return LogError(message, where=f"{path}:{node.start_mark.line + 1}", hint=hint)


def _load(path: Path, text: bytes, what: str) -> _Mapping:
    """Return the nodes of the values in a YAML mapping, by key. `what` is the name of the text in error messages."""
    try:
        node = yaml.compose(text.decode("utf-8-sig"), Loader=yaml.SafeLoader)
    except UnicodeDecodeError as error:
        raise LogError(f"not UTF-8 text (byte {error.start})", where=str(path)) from error
    except yaml.MarkedYAMLError as error:
        where = f"{path}:{error.problem_mark.line + 1}" if error.problem_mark else str(path)
        raise LogError(f"not YAML: {error.problem}", where=where, hint="ROS camera_info keys are expected") from error
    except yaml.YAMLError as error:
        raise LogError(f"not YAML: {str(error).splitlines()[0]}", where=str(path)) from error
    except RecursionError as error:
        raise LogError("not a camera file: nested too deeply", where=str(path)) from error
    if node is None:
        raise LogError("nothing in it", where=str(path), hint="ROS camera_info keys are expected")
    return _mapping(path, node, what)


def _mapping(path: Path, node: yaml.Node, what: str) -> _Mapping:
    if not isinstance(node, yaml.MappingNode):
        raise _error(path, node, f"{what} must be a mapping of keys to values")
    result: _Mapping = {}
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode) or key.value in result:
            raise _error(path, key, f"a key of {what} occurs twice or is not a word")
        result[key.value] = value
    return result


def _get(path: Path, mapping: _Mapping, key: str, inside: str = "", at: yaml.Node | None = None) -> yaml.Node:
    if key not in mapping:
        where = f"{path}:{at.start_mark.line + 1}" if at else str(path)
        found = f"found: {', '.join(mapping) or 'nothing'}"[:200]
        hint = f"write {_FORMS[key]}; {found}" if key in _FORMS else found
        raise LogError(f"{inside}{key} is missing", where=where, hint=hint)
    return mapping[key]


def _text(path: Path, node: yaml.Node, what: str) -> str:
    if not isinstance(node, yaml.ScalarNode):
        raise _error(path, node, f"{what} must be one value")
    return str(node.value)


def _number(path: Path, node: yaml.Node, what: str) -> float:
    text = _text(path, node, what)
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise _error(path, node, f"{what} must be a finite number, got {text[:40]!r}")
    return number


def _size(path: Path, top: _Mapping, key: str) -> int:
    node = _get(path, top, key)
    number = _number(path, node, key)
    if not 1 <= number <= MAX_SIDE or number != int(number):
        raise _error(path, node, f"{key} must be a whole number of pixels, 1 to {MAX_SIDE}, got {number:g}")
    return int(number)


def _numbers(path: Path, node: yaml.Node, what: str) -> tuple[Floats, yaml.Node]:
    """Return the numbers of a node, and the node of the list that contains these numbers.

    node: a mapping {rows, cols, data}, a flat list or a list of rows.
    """
    if isinstance(node, yaml.MappingNode):
        fields = _mapping(path, node, what)
        values, data = _numbers(path, _get(path, fields, "data", f"{what}.", node), f"{what}.data")
        if "rows" in fields and "cols" in fields:
            rows, cols = (_number(path, fields[key], f"{what}.{key}") for key in ("rows", "cols"))
            if rows * cols != len(values):
                raise _error(path, data, f"{what} says {rows:g} x {cols:g} but has {len(values)} numbers")
        return values, data
    if not isinstance(node, yaml.SequenceNode):
        raise _error(path, node, f"{what} must be a list of numbers")
    items: list[yaml.Node] = []
    for item in node.value:
        items += item.value if isinstance(item, yaml.SequenceNode) else [item]
    return np.array([_number(path, item, f"each value of {what}") for item in items], dtype=np.float64), node


def _matrix(path: Path, node: yaml.Node) -> Floats:
    values, data = _numbers(path, node, "camera_matrix")
    form = "fx 0 cx, 0 fy cy, 0 0 1"
    if len(values) != 9:
        raise _error(path, data, f"camera_matrix must be 3x3, got {len(values)} numbers", form)
    matrix = values.reshape(3, 3)
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise _error(path, data, "camera_matrix has a focal length that is not above zero", form)
    if matrix[1, 0] != 0 or not np.array_equal(matrix[2], [0, 0, 1]):
        raise _error(path, data, "camera_matrix is not a pinhole matrix", form)
    return matrix


def _distortion(path: Path, top: _Mapping) -> tuple[DistortionModel, Floats]:
    node = _get(path, top, "distortion_model")
    given = _text(path, node, "distortion_model")
    coefficients = _get(path, top, "distortion_coefficients")
    empty = isinstance(coefficients, yaml.ScalarNode) and coefficients.value in ("", "~", "null")
    values, data = (np.zeros(0), coefficients) if empty else _numbers(path, coefficients, "distortion_coefficients")
    if given in ("", "plumb_bob") and not len(values):  # Simulators write this form for a camera without distortion.
        return "plumb_bob", np.zeros(5)
    model = next((known for known in get_args(DistortionModel) if known == given), None)
    if model is None:
        raise _error(path, node, f"unknown distortion_model {given[:40]!r}", f"known: {', '.join(COEFFICIENTS)}")
    if len(values) not in COEFFICIENTS[model]:
        counts = " or ".join(map(str, COEFFICIENTS[model]))
        raise _error(path, data, f"{model} takes {counts} distortion_coefficients, got {len(values)}")
    return model, values


def _depth_noise(path: Path, node: yaml.Node) -> RangeNoise:
    told = _mapping(path, node, "depth_noise")
    noise = {}
    for key in (one.name for one in fields(RangeNoise)):
        noise[key] = _number(path, _get(path, told, key, "depth_noise.", node), f"depth_noise.{key}")
        if noise[key] < 0 or (key == "sigma" and noise[key] == 0):
            least = "above zero" if key == "sigma" else "at least zero"
            raise _error(path, told[key], f"depth_noise.{key} must be {least}", "metres, and metres per metre")
    return RangeNoise(**noise)


def _pose(path: Path, node: yaml.Node) -> Floats:
    form = "base_T_camera: {translation: [x, y, z], rotation_xyzw: [x, y, z, w]}"
    fields = _mapping(path, node, "base_T_camera")
    parts = []
    for key, size in (("translation", 3), ("rotation_xyzw", 4)):
        values, data = _numbers(path, _get(path, fields, key, "base_T_camera.", node), key)
        if len(values) != size:
            raise _error(path, data, f"{key} must be {size} numbers, got {len(values)}", form)
        parts.append(values)
    translation, xyzw = parts
    if not valid_positions(translation):
        raise _error(path, fields["translation"], "translation is too far away", "metres")
    length = float(lengths(xyzw))
    if not abs(length - 1) < 0.01:
        raise _error(path, fields["rotation_xyzw"], f"rotation_xyzw must have length 1, has {length:g}", "x, y, z, w")
    return pose_from_quaternion(translation[None], xyzw[None])[0]
