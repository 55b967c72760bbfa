"""The class of all settings. Settings are loaded from a YAML file and from overrides, and are written as YAML."""

import reprlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, Field, ValidationError

from objslam.config import mapping
from objslam.config.calibration import CalibrationSettings
from objslam.config.checks import Checks
from objslam.config.detector import Detector
from objslam.config.encoder import Encoder
from objslam.config.noise import Noise
from objslam.config.section import Section
from objslam.config.tags import Tags
from objslam.config.yaml_text import MAX_YAML, parse_yaml
from objslam.errors import ConfigError

_SHOWN = 200  # The largest number of characters of a wrong value that a message shows.


class Settings(Section):
    """Hold all settings of a run."""

    mode: Literal["auto", "fixed", "joint"] = "auto"
    """Which poses are solved. fixed: the objects are solved at the given poses. joint: poses and objects are solved
    together. auto: joint if the log has no localisation, or if its localisation covers too few boxes or proves wrong, else
    fixed. In fixed mode, the covariances do not contain the drift of odometry."""
    seed: Annotated[int, Field(ge=0)] = 0
    detector: Detector = Detector()
    encoder: Encoder = Encoder()
    poses: mapping.Poses = mapping.Poses()
    rays: mapping.RayNoise = mapping.RayNoise()
    depth: mapping.Depth = mapping.Depth()
    tags: Tags = Tags()
    odometry: mapping.Odometry = mapping.Odometry()
    planar: mapping.Planar = mapping.Planar()
    localization: mapping.Localization = mapping.Localization()
    calibration: CalibrationSettings = CalibrationSettings()
    noise: Noise = Noise()
    checks: Checks = Checks()
    association: mapping.AssociationSettings = mapping.AssociationSettings()
    triangulation: mapping.Triangulation = mapping.Triangulation()
    bodies: mapping.Bodies = mapping.Bodies()
    fixed: mapping.Fixed = mapping.Fixed()
    joint: mapping.Joint = mapping.Joint()
    live: mapping.Live = mapping.Live()
    reconstruction: mapping.Reconstruction = mapping.Reconstruction()
    output: mapping.Output = mapping.Output()

    @property
    def finds_localization_noise(self) -> bool:
        """Whether a run estimates the size of the noise of localised poses. With `noise.localization=auto`, a run estimates
        this size if the section `localization` has its default values."""
        use, usual = self.noise.localization, self.localization == mapping.Localization()
        return usual if use == "auto" else use


def load_settings(file: Path | None = None, overrides: tuple[str, ...] = ()) -> Settings:
    """Return the settings from a YAML file and from overrides. An override `key=value` has a dotted key and a YAML value. It
    replaces the value in the file. ConfigError names the file or the override, the key and the problem."""
    data: dict[str, Any] = {}
    if file is not None:
        data = _read_yaml(file)
        # If detector.names is the relative path of a file beside the settings file, it becomes an absolute path.
        names = _validate(data, str(file)).detector.names
        if isinstance(names, str) and is_file(file.parent / names):
            data["detector"]["names"] = str((file.parent / names).resolve())
    for text in overrides:
        key, sign, value = text.partition("=")
        if not sign or not key:
            raise ConfigError(f"--set {text!r} is not key=value", hint="for example --set joint.loss=cauchy")
        try:
            _put(data, key.strip().split("."), parse_yaml(value))
        except yaml.YAMLError as error:
            raise ConfigError(f"the value of --set {text!r} is not YAML") from error
        _validate(data, f"--set {text}")
    return _validate(data, "settings")


def change_settings(settings: Settings, changes: Mapping[str, Any]) -> Settings:
    """Return the settings with changed values. changes: the new values by key. A key is dotted, such as "rays.pixel_sigma".
    It may also name a section, and its value is then a mapping of keys in this section. ConfigError names the key and the
    problem."""
    data = settings.model_dump(exclude_unset=True)
    _change(data, [], changes)
    return _validate(data, "settings")


def _change(data: dict[str, Any], above: list[str], changes: Mapping[str, Any]) -> None:
    for key, value in changes.items():
        keys = above + (key.split(".") if isinstance(key, str) else [key])
        if isinstance(value, Mapping):
            _change(data, keys, value)
        else:
            _put(data, keys, value)


def dump_settings(settings: Settings) -> str:
    """Return the settings as YAML text for `load_settings`."""
    return yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False)


def _read_yaml(file: Path) -> dict[str, Any]:
    try:
        with file.open("rb") as stream:
            raw = stream.read(MAX_YAML + 1)
        if len(raw) > MAX_YAML:
            raise ConfigError(f"the settings are longer than {MAX_YAML:,} bytes", where=str(file))
        data = parse_yaml(raw.decode("utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read the settings: {error}", where=str(file)) from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{file}:{mark.line + 1}" if mark else str(file)
        raise ConfigError(f"not YAML: {getattr(error, 'problem', error)}", where=where) from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError("the settings must be a mapping of keys to values", where=str(file))
    return data


def is_file(path: Path) -> bool:
    """Return whether a path is an accessible file. A text that cannot be a path gives False."""
    try:
        return path.is_file()
    except OSError:  # the name is too long, or the folder is not accessible
        return False


def _put(data: dict[str, Any], keys: list[str], value: Any) -> None:
    for key in keys[:-1]:
        inner = data.setdefault(key, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"--set {'.'.join(keys)}: {key} has no keys below it")
        data = inner
    data[keys[-1]] = value


def _validate(data: dict[str, Any], where: str) -> Settings:
    try:
        return Settings.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            message = f"there is no setting {key}{_meant(key)}"
        else:
            wrong = f"{first['msg'][0].lower()}{first['msg'][1:]}".replace("a valid tuple", "a list")
            message = f"{key}: {wrong}, got {_short(first['input'])}"
        raise ConfigError(message, where=where, hint="`objslam config dump` shows every setting") from error


def _short(value: Any) -> str:
    """Return the text of a wrong value. Aliases in YAML can make a value of any size, so long parts are left out."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = _SHOWN
    return short.repr(value)


def _meant(key: str) -> str:
    """Return a question for a message: whether the user meant the setting whose key is closest to a mistyped key. Return an
    empty text if no key is close."""
    import difflib

    def names(section: type[BaseModel], prefix: str) -> Iterator[str]:
        for name, of in section.model_fields.items():
            if isinstance(of.annotation, type) and issubclass(of.annotation, BaseModel):
                yield from names(of.annotation, f"{prefix}{name}.")
            else:
                yield f"{prefix}{name}"

    return "".join(f" (did you mean {name}?)" for name in difflib.get_close_matches(key, list(names(Settings, "")), 1, 0.75))
