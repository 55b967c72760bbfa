"""The types of the values in summary.json, evaluation.json and doubts.json, for each key that a command reads.

A folder may come from another person, so a value of a wrong type must give a clear error of one line. A key that no command
reads may have any value.
"""

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from objslam.core.result import DoubtKind
from objslam.core.types import Up

_Integer = Annotated[int, Field(ge=-(2**63), lt=2**63)]
_Number = Annotated[float, Field(gt=-1e300, lt=1e300)]


class _Shape(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False)


class _Parameter(_Shape):
    value: _Number
    sigma: _Number
    prior_sigma: _Number
    unit: str
    observable: bool


class _Calibration(_Shape):
    parameters: dict[str, _Parameter]
    traded_off: list[list[str]] = []


class _Assessment(_Shape):
    level: Literal["good", "check", "bad"]
    reasons: list[str] = []


class _Localisation(_Shape):
    localised: bool
    line: str


class _Place(_Shape):
    x: _Number
    y: _Number
    z: _Number
    yaw_deg: _Number


class _SiteSession(_Place):
    name: str
    sigma: _Place
    log_odds: _Number | None = None
    common_objects: _Integer = 0


class _Part(_Shape):
    begin: _Number | None = None
    end: _Number | None = None


class Summary(_Shape):
    """The content of summary.json. Each key may be missing, as in the summary of an older run."""

    log: str = ""
    log_path: str | None = None
    part: _Part | None = None
    map_frame: str = ""
    planar: bool = True
    up: Up = "z"
    counts: dict[str, _Integer] = {}
    calibration: _Calibration | None = None
    unexplained_share: dict[str, _Number] = {}
    dropped: dict[str, _Integer] = {}
    dropped_examples: dict[str, list[str]] = {}
    cost_before: _Number | None = None
    cost_after: _Number | None = None
    iterations: _Integer | None = None
    seconds: dict[str, _Number] = {}
    versions: dict[str, str] = {}
    warnings: list[str] = []
    assessment: _Assessment | None = None
    localisation: _Localisation | None = None
    doubts: dict[str, _Integer] = {}
    cut_off: dict[str, _Integer] = {}
    sessions: list[_SiteSession] = []


class _Match(_Shape):
    id: _Integer
    error: _Number
    truth_id: _Integer


class _Missed(_Shape):
    label: str
    truth_id: _Integer


class _False(_Shape):
    label: str
    id: _Integer


class EvaluationFile(_Shape):
    """The content of evaluation.json."""

    truth: str | None = None
    align: str
    radius: _Number
    matched: _Integer | None = None
    missed: _Integer | None = None
    false: _Integer | None = None
    precision: _Number | None = None
    recall: _Number | None = None
    position_rmse: _Number | None = None
    position_median: _Number | None = None
    position_max: _Number | None = None
    ate: _Number | None = None
    ate_max: _Number | None = None
    objects: list[_Match] = []
    missed_objects: list[_Missed] = []
    false_objects: list[_False] = []
    warnings: list[str] = []

    @model_validator(mode="after")
    def _counts_belong_to_errors(self) -> Self:
        if self.position_rmse is not None and None in (self.matched, self.missed, self.false):
            raise ValueError("position_rmse needs the counts matched, missed and false")
        return self


class _Doubt(_Shape):
    kind: DoubtKind
    reason: str
    label: str
    text: str
    objects: list[_Integer]
    position: Annotated[list[_Number], Field(min_length=3, max_length=3)] | None
    numbers: dict[str, _Number | None]
    rays: list[Annotated[int, Field(ge=0, lt=2**63)]]


class DoubtsFile(_Shape):
    """The content of doubts.json."""

    doubts: list[_Doubt]


def fault_of(data: dict[str, Any], shape: type[BaseModel]) -> str | None:
    """Return the first fault of data that do not fit a shape, as "key: what is wrong". Return None if the data fit."""
    try:
        shape.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        return f"{'.'.join(map(str, first['loc']))[:80]}: {first['msg'][0].lower()}{first['msg'][1:]}"
    return None
