"""Read a model's own description from its metadata. The description is JSON with settings of a detector or an encoder."""

import json
from typing import TypeVar

from objslam.config.section import Section
from objslam.detection.onnx_model import Network
from objslam.errors import DetectorError

Settings = TypeVar("Settings", bound=Section)


def with_description(network: Network, settings: Settings, key: str, user_only: frozenset[str]) -> Settings:
    """Return the settings, with unset values filled in from the model's own description.

    key: the metadata key of the description. Without this key, the settings are unchanged. user_only: the settings that no
    model may describe. Raises DetectorError if the description is invalid.
    """
    text = network.metadata.get(key)
    if text is None:
        return settings
    try:
        described = type(settings).model_validate(json.loads(text))
        if beyond := described.model_fields_set & user_only:
            raise ValueError(f"only the user can set {min(beyond)}")
    except (ValueError, RecursionError) as error:  # The errors of pydantic and json are ValueErrors.
        message = f"{key} in the model's metadata is wrong: {'; '.join(str(error).splitlines()[:3])}"
        raise DetectorError(message, where=str(network.path)) from error
    unset = (name for name in described.model_fields_set if getattr(settings, name) is None)
    return settings.model_copy(update={name: getattr(described, name) for name in unset})
