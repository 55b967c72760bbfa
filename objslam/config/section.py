"""The base class of all settings, and the value types of settings."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
Device = Literal["auto", "cpu", "cuda"]


class Section(BaseModel):
    """Hold one section of the settings. A section is immutable and rejects unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)
