"""All settings in one, loaded from YAML and overrides and dumped as YAML."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, Field, ValidationError

from objslam.config.calibration import CalibrationSettings
from objslam.config.detector import Detector
from objslam.config.estimation import AssociationSettings, Fixed, Joint, Triangulation
from objslam.config.live import Live
from objslam.config.measurements import Depth, Localization, Odometry, Planar, Poses, RayNoise
from objslam.config.output import Output, Reconstruction
from objslam.config.section import Section
from objslam.errors import ConfigError


class Settings(Section):
    """All settings of a run."""

    mode: Literal["fixed", "joint"] = "fixed"
    seed: Annotated[int, Field(ge=0)] = 0
    detector: Detector = Detector()
    poses: Poses = Poses()
    rays: RayNoise = RayNoise()
    depth: Depth = Depth()
    odometry: Odometry = Odometry()
    planar: Planar = Planar()
    localization: Localization = Localization()
    calibration: CalibrationSettings = CalibrationSettings()
    association: AssociationSettings = AssociationSettings()
    triangulation: Triangulation = Triangulation()
    fixed: Fixed = Fixed()
    joint: Joint = Joint()
    live: Live = Live()
    reconstruction: Reconstruction = Reconstruction()
    output: Output = Output()


def load_settings(file: Path | None = None, overrides: tuple[str, ...] = ()) -> Settings:
    """Settings from the defaults, then a YAML file, then `key=value` overrides (dotted keys, YAML values).

    A later source replaces the values of an earlier one. ConfigError names the file or override, the key and the problem.
    """
    data: dict[str, Any] = {}
    if file is not None:
        data = _read_yaml(file)
        _find_names(_validate(data, str(file)), data, file.parent)
    for text in overrides:
        key, sign, value = text.partition("=")
        if not sign or not key:
            raise ConfigError(f"--set {text!r} is not key=value", hint="for example --set joint.loss=cauchy")
        try:
            _put(data, key.strip().split("."), yaml.safe_load(value))
        except (yaml.YAMLError, ValueError) as error:  # PyYAML lets the ValueError of an impossible date through
            raise ConfigError(f"the value of --set {text!r} is not YAML") from error
        _validate(data, f"--set {text}")
    return _validate(data, "settings")


def dump_settings(settings: Settings) -> str:
    """The settings as YAML that `load_settings` reads back."""
    return yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False)


def _read_yaml(file: Path) -> dict[str, Any]:
    try:
        data = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read the settings: {error}", where=str(file)) from error
    except (yaml.YAMLError, ValueError) as error:  # as above
        mark = getattr(error, "problem_mark", None)
        where = f"{file}:{mark.line + 1}" if mark else str(file)
        raise ConfigError(f"not YAML: {getattr(error, 'problem', error)}", where=where) from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError("the settings must be a mapping of keys to values", where=str(file))
    return data


def _find_names(settings: Settings, data: dict[str, Any], folder: Path) -> None:
    """A names file that lies beside the settings file is meant, wherever the run is started."""
    names = settings.detector.names
    if isinstance(names, str) and is_file(folder / names):
        data["detector"]["names"] = str((folder / names).resolve())


def is_file(path: Path) -> bool:
    """Whether there is a file that can be looked at; no text that is no path at all is an error."""
    try:
        return path.is_file()
    except OSError:  # too long for a name, or in a folder that is closed to us
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
            message = f"{key}: {first['msg'][0].lower()}{first['msg'][1:]}, got {first['input']!r}"
        raise ConfigError(message, where=where, hint="`objslam config dump` shows every setting") from error


def _meant(key: str) -> str:
    """The setting that a mistyped key may stand for, as a question; nothing where none is like it."""
    import difflib

    def names(section: type[BaseModel], prefix: str) -> Iterator[str]:
        for name, of in section.model_fields.items():
            if isinstance(of.annotation, type) and issubclass(of.annotation, BaseModel):
                yield from names(of.annotation, f"{prefix}{name}.")
            else:
                yield f"{prefix}{name}"

    near = difflib.get_close_matches(key, list(names(Settings, "")), 1, 0.75)
    return f" (did you mean {near[0]}?)" if near else ""
