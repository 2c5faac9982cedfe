"""The keys of ``log.toml``: motion model, initial pose, noise, sensor and callers."""

from collections.abc import Mapping
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AliasChoices, ConfigDict, Field, ValidationError, field_validator

from pipistrelle.config import (
    LATEST,
    LONGEST_STEP,
    MAX_OTHERS,
    AngleStd,
    DistanceStd,
    NonNegative,
    Positive,
    Probability,
    Real,
    Section,
)
from pipistrelle.detection.logs.poses import MOTION_COVARIANCE, POSE
from pipistrelle.detection.logs.recording import LogCaller
from pipistrelle.files import read_text
from pipistrelle.refusals import table_refusal
from pipistrelle.settings import RENAMED, parse_toml
from pipistrelle.text_tables import Schema

_Triple = Annotated[tuple[Real, Real, Real], Field(strict=False)]
_Triple_std = Annotated[tuple[NonNegative, NonNegative, NonNegative], Field(strict=False)]
_Bounds = Annotated[tuple[Positive, Positive], Field(strict=False)]
_Label = Annotated[int, Field(strict=False, ge=0, lt=2**53)]

NOISY = {
    "unicycle": ("velocity", "angular_rate"),
    "bicycle": ("speed", "steering"),
    "ackermann": ("speed", "steering"),
    "poses": ("forward", "sideways", "turn"),
}
"""Quantities of each motion model that have a standard deviation in ``log.toml``."""
ODOMETRY = {
    motion: Schema(
        file="odometry.csv",
        row="a row holds until the time of the next; the last row only ends the log",
        columns=("time", *names),
    )
    for motion, names in NOISY.items()
}
"""Columns of the odometry of each motion model."""
ODOMETRY["poses"] = Schema(
    file="odometry.csv",
    row="the motions from row to row count; the first pose may be any",
    columns=("time", *POSE),
    optional=MOTION_COVARIANCE,
)


def _also(old: str) -> Any:
    """Return the field of a sensor property that older logs call `old`."""
    return Field(
        validation_alias=AliasChoices(RENAMED[f"association.{old}"].partition(".")[2], old)
    )


class _Association(Section):
    """Sensor properties in ``log.toml``, named like the settings of `association`."""

    model_config = ConfigDict(strict=True)

    detection_rate: Annotated[Probability | None, _also("detection")] = None
    clutter_rate: Annotated[Positive | None, _also("clutter")] = None
    max_angle_std: Annotated[Positive | None, _also("bearing_std")] = None


class Vehicle(Section):
    """The keys of ``log.toml`` that every motion model has."""

    model_config = ConfigDict(strict=True)

    format: Literal[1]
    motion: Literal["unicycle", "bicycle", "ackermann", "poses"]
    initial_pose: _Triple
    initial_pose_std: _Triple_std
    range_std: DistanceStd
    bearing_std: AngleStd
    excess_path_std: DistanceStd | None = None
    range_bounds: _Bounds
    step: Annotated[Positive, Field(le=LONGEST_STEP)] | None = None
    gate: Probability | None = None
    noise_at_rest: bool = True
    sensor_pose: _Triple = (0.0, 0.0, 0.0)
    time_offset: Annotated[Real, Field(ge=-LATEST, le=LATEST)] = 0.0
    association: _Association = _Association()
    callers: Annotated[tuple[LogCaller, ...], Field(strict=False, max_length=MAX_OTHERS)] = ()
    landmarks: Mapping[_Label, Annotated[tuple[Real, Real], Field(strict=False)]] = {}
    landmark_std: NonNegative = 1e-3

    @field_validator("callers")
    @classmethod
    def _apart(cls, callers: tuple[LogCaller, ...]) -> tuple[LogCaller, ...]:
        names = {"vehicle", *(caller.name.casefold() for caller in callers)}
        if len(names) <= len(callers):
            raise ValueError('a name of its own for each caller, not "vehicle", a or A alike')
        if len({caller.landmark for caller in callers}) < len(callers):
            raise ValueError("a landmark of its own for each caller")
        return callers

    @field_validator("range_bounds")
    @classmethod
    def _rising(cls, bounds: tuple[float, float]) -> tuple[float, float]:
        if bounds[0] >= bounds[1]:
            raise ValueError("a near range below a far one")
        return bounds

    def told(self) -> dict[str, Any]:
        """Return the log's values as keyword arguments for `Log`."""
        told = (*SHARED, "wheelbase", "speed_offset")
        values = {name: getattr(self, name) for name in type(self).model_fields if name in told}
        values["control_std"] = tuple(getattr(self, f"{name}_std") for name in NOISY[self.motion])
        values["association"] = self.association.model_dump(exclude_none=True)
        return values

    def text(self) -> str:
        """Format keys and values as the text of a ``log.toml``."""
        import tomli_w

        return tomli_w.dumps(self.model_dump(mode="json", exclude_defaults=True, exclude_none=True))


class _Unicycle(Vehicle):
    velocity_std: NonNegative
    angular_rate_std: NonNegative


class _Bicycle(Vehicle):
    speed_std: NonNegative
    steering_std: NonNegative
    wheelbase: Positive


class _Ackermann(_Bicycle):
    speed_offset: Real = 0.0

    @field_validator("speed_offset")
    @classmethod
    def _within_the_car(cls, offset: float, known: Any) -> float:
        if abs(offset) > 0.5 * known.data.get("wheelbase", inf):
            raise ValueError("at most half the wheelbase")
        return offset


class _Poses(Vehicle):
    forward_std: NonNegative
    sideways_std: NonNegative
    turn_std: NonNegative


KINDS: dict[str, type[Vehicle]] = {
    "unicycle": _Unicycle,
    "bicycle": _Bicycle,
    "ackermann": _Ackermann,
    "poses": _Poses,
}
SHARED = tuple(
    name for name in Vehicle.model_fields if name not in ("format", "step", "time_offset")
)
"""Keys of all logs that do not only affect how the tables are read."""


def read_vehicle(path: Path) -> Vehicle:
    """Read the values of a ``log.toml``."""
    return vehicle_of(parse_toml(read_text(path), path), path)


def vehicle_of(table: Mapping[str, Any], where: object) -> Vehicle:
    """Return the validated keys of a ``log.toml`` table; raise its first error, naming `where`."""
    model = KINDS.get(str(table.get("motion")), _Unicycle)
    try:
        return model.model_validate(table)
    except ValidationError as error:
        known = KINDS.get(str(table.get("motion")), Vehicle)
        raise table_refusal(where, error, known, "format", "motion") from None
