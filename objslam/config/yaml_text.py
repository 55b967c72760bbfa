"""Parse YAML texts of users. Any text that PyYAML cannot turn into plain data raises yaml.YAMLError."""

from typing import Any

import yaml

MAX_YAML = 1 << 20
"""The maximum number of characters of a YAML text. A longer text is refused, because PyYAML takes seconds for a megabyte.
Settings need a few kB. With a larger number, a large text takes more time."""


def parse_yaml(text: str) -> Any:
    """Return the plain data of a YAML text. Raises yaml.YAMLError for a text that is not YAML, too long or too deep."""
    if len(text) > MAX_YAML:
        raise yaml.YAMLError(f"longer than {MAX_YAML >> 20} MiB")
    try:
        return yaml.safe_load(text)
    except (ValueError, LookupError, AttributeError, TypeError, OverflowError) as error:  # from PyYAML's constructors
        raise yaml.YAMLError(f"{error}, in a value that cannot be read") from error
    except RecursionError as error:
        raise yaml.YAMLError("nested too deeply") from error
