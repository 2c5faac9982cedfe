"""The keys of ``log.toml``: motion model, initial pose, noise, sensor and callers."""

from collections.abc import Mapping
from math import inf, pi
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, ValidationError, field_validator

from pipistrelle.config import (
    LATEST,
    LONGEST_STEP,
    MAX_OTHERS,
    AngleStd,
    DistanceStd,
    InputError,
    NonNegative,
    Positive,
    Probability,
    Real,
    Section,
)
from pipistrelle.detection.logs.poses import POSE
from pipistrelle.detection.logs.recording import LogCaller
from pipistrelle.detection.logs.text_tables import FORMER_NAMES
from pipistrelle.files import read_text
from pipistrelle.refusals import expectation, meant, refusal, shown, values_expected
from pipistrelle.settings import parse_toml

_Triple = Annotated[tuple[Real, Real, Real], Field(strict=False)]
_Triple_std = Annotated[tuple[NonNegative, NonNegative, NonNegative], Field(strict=False)]
_Bounds = Annotated[tuple[Positive, Positive], Field(strict=False)]
_Turn = Annotated[Positive, Field(le=2.0 * pi)]
_Point = Annotated[tuple[Real, Real], Field(strict=False)]
_Point_std = Annotated[tuple[NonNegative, NonNegative], Field(strict=False)]

NOISY = {
    "unicycle": ("velocity", "angular_rate"),
    "bicycle": ("speed", "steering"),
    "ackermann": ("speed", "steering"),
    "poses": ("forward", "sideways", "turn"),
}
"""Quantities of each motion model that have a standard deviation in ``log.toml``."""
ODOMETRY = NOISY | {"poses": POSE}
"""Columns of a row of odometry, besides its time."""


class _Caller(Section):
    model_config = ConfigDict(strict=True)

    name: Annotated[str, Field(pattern=r"^\w[\w-]*$", max_length=40)]
    landmark: Annotated[int, Field(ge=0, lt=2**53)]
    moves: bool = False
    place: _Point | None = None
    place_std: _Point_std | None = None

    @field_validator("place")
    @classmethod
    def _of_what_stands(cls, place: Any, known: Any) -> Any:
        if place is not None and known.data.get("moves"):
            raise ValueError("no place of a caller that moves")
        return place

    @field_validator("place_std")
    @classmethod
    def _of_a_place(cls, std: Any, known: Any) -> Any:
        if std is not None and known.data.get("place") is None:
            raise ValueError("a place beside it")
        return std


class _Association(Section):
    """Properties of the sensor, by the names of the settings of `association`."""

    model_config = ConfigDict(strict=True)

    detection: Probability | None = None
    clutter: Positive | None = None
    bearing_std: Positive | None = None
    max_range: Positive | None = None
    field_of_view: _Turn | None = None


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
    callers: Annotated[tuple[_Caller, ...], Field(strict=False, max_length=MAX_OTHERS)] = ()

    @field_validator("callers")
    @classmethod
    def _apart(cls, callers: tuple[_Caller, ...]) -> tuple[_Caller, ...]:
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
        """Return the values as fields of a `Log`."""
        values = {name: getattr(self, name) for name in type(self).model_fields if name in TOLD}
        values["control_std"] = tuple(getattr(self, f"{name}_std") for name in NOISY[self.motion])
        values["association"] = self.association.model_dump(exclude_none=True)
        values["callers"] = tuple(LogCaller(**caller.model_dump()) for caller in self.callers)
        return values

    def text(self) -> str:
        """Return the text of ``log.toml``."""
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
OF_FILES = ("format", "step", "time_offset")
"""Keys that affect how the tables are read."""
SHARED = tuple(name for name in Vehicle.model_fields if name not in OF_FILES)
"""Keys that every log has."""
TOLD = (*SHARED, "wheelbase", "speed_offset")
"""Keys that become fields of a `Log`, if the motion model has them."""


def read_vehicle(path: Path) -> tuple[Vehicle, tuple[str, ...]]:
    """Read a ``log.toml``; return its values and the former names of keys in it."""
    raw = parse_toml(read_text(path), path)
    former = tuple(key for key in raw if FORMER_NAMES.get(key, key) not in raw)
    raw |= {FORMER_NAMES[key]: raw.pop(key) for key in former}
    return vehicle_of(raw, path), former


def vehicle_of(table: Mapping[str, Any], where: object) -> Vehicle:
    """Validate a table of the keys of ``log.toml``; raise its first error, at `where`."""
    model = KINDS.get(str(table.get("motion")), _Unicycle)
    try:
        return model.model_validate(table)
    except ValidationError as error:
        faults = error.errors(include_url=False)
    rank = {"format": 0, "motion": 1}
    other = {"extra_forbidden": 2}
    fault = min(faults, key=lambda f: rank.get(str(f["loc"][0]), other.get(f["type"], 3)))
    if fault["type"] == "missing" and len(fault["loc"]) == 1:
        raise _missing(where, [f["loc"][0] for f in faults if f["type"] == "missing"], model)
    raise _key_refusal(where, fault, model)


def _missing(where: object, names: list[Any], model: type[Vehicle]) -> InputError:
    """Return the error of missing keys; without a motion, only keys that all models share."""
    known = Vehicle.model_fields if "motion" in names else model.model_fields
    named = [repr(name) for name in names if name in known]
    expected, plural = f"the keys {', '.join(known)}", "s" * (len(named) > 1)
    return refusal(where, f"no key{plural} {', '.join(named)}", expected, f"add {', '.join(named)}")


def _key_refusal(path: object, fault: Any, model: type[Vehicle]) -> InputError:
    known, name = model.model_fields, fault["loc"][0]
    if name == "callers" and len(fault["loc"]) > 2:
        return _caller_refusal(path, fault)
    if name == "callers" and fault["type"] == "too_long":
        found = f"{len(fault['input'])} callers"
        return refusal(f"{path}, key 'callers'", found, f"at most {MAX_OTHERS}", "leave some out")
    if name in known and (count := values_expected(fault, known[name])) is not None:
        found = f"{len(fault['input'])} values"
        return refusal(f"{path}, key {name!r}", found, f"{count}", "mend the list")
    if name == "association" and len(fault["loc"]) > 1:
        known = _Association.model_fields
    parts = (f"[{p}]" if isinstance(p, int) else f".{p}" for p in fault["loc"])
    key = "".join(parts).removeprefix(".")
    if fault["type"] == "extra_forbidden":
        near = meant(str(fault["loc"][-1]), known)
        fix = f"did you mean {near!r}?" if near else "remove it"
        return refusal(path, f"the unknown key {key!r}", f"one of {', '.join(known)}", fix)
    found = shown(fault["input"])
    return refusal(f"{path}, key {key!r}", found, expectation(fault), "correct the value")


def _caller_refusal(path: object, fault: Any) -> InputError:
    """Return the error of a key of a caller, numbered from 1."""
    _, number, name, *_ = fault["loc"]
    key, known = f"callers.{number + 1}.{name}", _Caller.model_fields
    if fault["type"] == "missing":
        return refusal(path, f"no key {key!r}", "a name and a landmark", f"add {key!r}")
    if fault["type"] == "extra_forbidden":
        near = meant(name, known)
        fix = f"did you mean {near!r}?" if near else "remove it"
        return refusal(path, f"the unknown key {key!r}", f"one of {', '.join(known)}", fix)
    expected = expectation(fault)
    if name == "name" and fault["type"] in ("string_pattern_mismatch", "string_too_long"):
        expected = "letters, digits, _ and -, 40 at most"
    return refusal(f"{path}, key {key!r}", shown(fault["input"]), expected, "correct the value")
