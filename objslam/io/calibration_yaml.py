"""Read and write the shared errors of a robot as YAML. `objslam calibrate` writes this file, and a run can start from it."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from objslam.config.yaml_text import parse_yaml
from objslam.core.arrays import Floats
from objslam.core.calibration import MOST_SCALE, SCALES, Calibration, kind
from objslam.core.validity import covariance_fault
from objslam.errors import ConfigError, LogError, one_line
from objslam.io.text import read_bytes

_MOST_BYTES = 1 << 20
"""The largest size of a calibration file, bytes. A larger file is refused unread. A robot with ten cameras needs 100 kB."""
_HINT = "write it with objslam calibrate"


def dump_calibration(calibration: Calibration) -> str:
    """Return the YAML text of a calibration. `load_calibration` reads it."""
    return yaml.safe_dump(calibration.to_dict(), sort_keys=False, default_flow_style=None, width=200)


def load_calibration(path: Path) -> Calibration:
    """Return the shared errors from a file of `objslam calibrate`, or from the summary.json of a run that estimated them.

    Raises ConfigError, which names the file and the fault in it.
    """
    try:
        if path.is_file() and path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"it is larger than {_MOST_BYTES >> 20} MiB")
        text = read_bytes(path).decode()
        _refuse_duplicates(yaml.compose(text, Loader=yaml.SafeLoader))
        return _calibration(parse_yaml(text))
    except LogError as error:
        raise ConfigError(error.message, where=error.where, hint="give a file of objslam calibrate") from error
    except (yaml.YAMLError, ValueError, OSError, RecursionError, OverflowError) as error:
        what = one_line(error)[:300]
        raise ConfigError(f"this is not a calibration of shared errors: {what}", where=str(path), hint=_HINT) from error


def _refuse_duplicates(node: yaml.Node | None) -> None:
    """Raise ValueError if a mapping, or a mapping in its values, has a key twice. PyYAML would take the last value."""
    seen = set()
    for key, value in node.value if isinstance(node, yaml.MappingNode) else ():
        if not isinstance(key, yaml.ScalarNode):
            raise ValueError(f"line {key.start_mark.line + 1} has a key that is not a name")
        if key.value in seen:
            raise ValueError(f"{key.value} occurs twice, the second time in line {key.start_mark.line + 1}")
        seen.add(key.value)
        _refuse_duplicates(value)


def _calibration(data: Any) -> Calibration:
    """Return the calibration in the data of a YAML file. Raises ValueError, which says what is wrong."""
    if isinstance(data, dict) and "calibration" in data:  # the summary.json of a run
        data = data["calibration"]
    parameters = data.get("parameters") if isinstance(data, dict) else None
    if not isinstance(parameters, dict) or not parameters:
        raise ValueError("it has no parameters")
    names = tuple(map(str, parameters))
    values, prior = (_column(parameters, key) for key in ("value", "prior_sigma"))
    expected = _column(parameters, "prior_mean", 0.0)
    for name, value, sigma in zip(names, values.tolist(), prior.tolist(), strict=True):
        if sigma <= 0:
            raise ValueError(f"prior_sigma of {name} is not positive")
        if kind(name) in SCALES and abs(value) > MOST_SCALE:
            raise ValueError(f"{name} is {value:g}, and no scale errs by more than {MOST_SCALE:g}")
    before = _covariance(data, "prior_covariance", names) if "prior_covariance" in data else np.diag(prior**2)
    return Calibration(names, values, _covariance(data, "covariance", names), prior, expected, before)


def _column(parameters: dict[Any, Any], key: str, default: float | None = None) -> Floats:
    """Return the numbers (P,) that the P parameters have under `key`. A parameter without the key has `default`.

    Raises ValueError for a value that is not a finite number.
    """
    numbers = []
    for name, of in parameters.items():
        value = of.get(key, default) if isinstance(of, dict) else None
        try:
            numbers.append(float(value))  # type: ignore[arg-type]
        except (TypeError, ValueError):
            raise ValueError(f"{key} of {name} is not a number") from None
        if isinstance(value, bool) or not np.isfinite(numbers[-1]):
            raise ValueError(f"{key} of {name} is not a finite number")
    return np.array(numbers)


def _covariance(data: dict[str, Any], key: str, names: tuple[str, ...]) -> Floats:
    """Return the covariance (P, P) of the parameters under `key`. Raises ValueError, which says what is wrong."""
    size, rows = len(names), data.get(key)
    if not isinstance(rows, list) or len(rows) != size or any(not isinstance(r, list) or len(r) != size for r in rows):
        raise ValueError(f"{key} must be {size} x {size} numbers, as there are {size} parameters")
    try:
        matrix = np.array([[float(number) for number in row] for row in rows])
    except (TypeError, ValueError):
        raise ValueError(f"{key} is not a matrix of numbers") from None
    if (fault := covariance_fault(matrix)) is not None:
        raise ValueError(f"{key} {fault}")
    if (np.diagonal(matrix) <= 0).any():
        raise ValueError(f"{key} has a variance that is not positive")
    scale = np.sqrt(np.diagonal(matrix))
    matrix = (matrix + matrix.T) / 2
    try:
        np.linalg.cholesky(matrix / np.outer(scale, scale))  # The correlation is tested, because the units differ.
    except np.linalg.LinAlgError:
        raise ValueError(f"{key} is not positive definite") from None
    return matrix
