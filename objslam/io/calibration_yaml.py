"""Read and write the shared errors of a robot as YAML: what `objslam calibrate` found, and what a run starts from."""

from pathlib import Path

import numpy as np
import yaml

from objslam.core.calibration import UNITS, Calibration, kind
from objslam.errors import ConfigError
from objslam.io.text import read_bytes


def dump_calibration(calibration: Calibration) -> str:
    """Return the YAML text of a calibration. `load_calibration` reads it."""
    parameters = {
        name: {
            "value": float(value),
            "sigma": float(sigma),
            "prior_sigma": float(prior),
            "unit": UNITS.get(kind(name), "share"),
        }
        for name, value, sigma, prior in zip(
            calibration.names, calibration.values, calibration.sigma, calibration.prior, strict=True
        )
    }
    data = {"parameters": parameters, "covariance": calibration.covariance.tolist()}
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=200)


def load_calibration(path: Path) -> Calibration:
    """Read a file of `objslam calibrate`. ConfigError names the file and what is wrong in it."""
    try:
        data = yaml.safe_load(read_bytes(path).decode())
        parameters = data["parameters"]
        columns = [np.array([float(of[key]) for of in parameters.values()]) for key in ("value", "prior_sigma")]
        covariance = np.array(data["covariance"], dtype=np.float64).reshape(len(parameters), len(parameters))
        np.linalg.cholesky(covariance)
        if not all(np.isfinite(part).all() for part in (*columns, covariance)) or not (columns[1] > 0).all():
            raise ValueError("a number is not finite or a prior sigma is not positive")
    except (yaml.YAMLError, TypeError, KeyError, ValueError, AttributeError, np.linalg.LinAlgError) as error:
        hint = "write it with objslam calibrate"
        raise ConfigError(f"this is no calibration of shared errors: {error}", where=str(path), hint=hint) from error
    return Calibration(tuple(map(str, parameters)), columns[0], covariance, columns[1])
