"""The base class of all settings, and the value types of settings."""

from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
Device = Literal["auto", "cpu", "cuda"]


def _as_names(given: object) -> object:
    """Return a list for a single name, and texts for class numbers, as people type them. Anything else stays as it is."""
    one = [given] if isinstance(given, str | int) and not isinstance(given, bool) else given
    if not isinstance(one, list | tuple):
        return one
    return tuple(str(name) if isinstance(name, int) and not isinstance(name, bool) else name for name in one)


Names = Annotated[tuple[Annotated[str, Field(min_length=1)], ...], BeforeValidator(_as_names)]
"""Names of classes. A single name is a list of one."""


class Section(BaseModel):
    """Hold one section of the settings. A section is immutable and rejects unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)
