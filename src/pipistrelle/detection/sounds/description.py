"""A sound recording's description: the keys of ``recording.toml``, the array in ``array.csv``."""

from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Int
from pydantic import ConfigDict, Field, ValidationError, field_validator, model_validator

from pipistrelle.acoustics.call import Call, ToneBurst, sound_of
from pipistrelle.arrays.array_file import read_array
from pipistrelle.arrays.layout import Layout, Scattered, at_one_centre, scattered
from pipistrelle.config import (
    MAX_OTHERS,
    SWEEP,
    TONE,
    CallConfig,
    Level,
    NonNegative,
    Positive,
    Real,
    Section,
)
from pipistrelle.files import read_text
from pipistrelle.refusals import expectation, meant, refusal, shown
from pipistrelle.settings import parse_toml

ARRAY_FILE = "array.csv"


class RecordedArray(NamedTuple):
    """The microphones of a recording, and their channels in the sound file."""

    layout: Layout | Scattered
    channel: Int[np.ndarray, "f e"]
    """Channel of each microphone, from 0."""
    face: tuple[str, ...]
    """Names of the groups of microphones that are scanned together."""

    @property
    def used(self) -> Int[np.ndarray, " m"]:
        """The channels that have a microphone, in order."""
        return np.unique(self.channel)


def recorded_array(folder: Path, channels: int, *, one_centre: bool) -> RecordedArray:
    """Read a recording's ``array.csv``; `one_centre` puts all faces at the vehicle's position."""
    path = folder / ARRAY_FILE
    microphones = read_array(path, some=True)
    if (most := int(microphones.channel.max())) > channels:
        found, expected = f"channel {most}, of sound that has {channels}", f"1 to {channels}"
        raise refusal(path, found, expected, "correct the channels")
    if one_centre:
        layout, which = at_one_centre(microphones, str(path))
        names = tuple(microphones.face[first] for first in which[:, 0])
        return RecordedArray(layout, microphones.channel[which] - 1, names)
    free = scattered(microphones, str(path))
    names = tuple(name or "those without a face" for name in free.name)
    return RecordedArray(free, microphones.channel[np.newaxis] - 1, names)


FILE = "recording.toml"
_Name = Annotated[str, Field(pattern=r"^\w[\w-]*$", max_length=40)]
_FileName = Annotated[str, Field(min_length=1, max_length=200)]
_Rate = Annotated[float, Field(ge=100, le=1e8)]
_Channel = Annotated[int, Field(ge=1, le=1024)]


class _Told(CallConfig):
    """A call, with the keys of the settings; a file name is relative to the recording."""

    model_config = ConfigDict(strict=True)

    band: Annotated[tuple[Positive, Positive], Field(strict=False)] = (60e3, 35e3)
    frequency: Positive = 0.0
    """Frequency of a tone or centre of a file's band [Hz]; a sweep has `band`."""

    @model_validator(mode="after")
    def _of_some_frequency(self) -> "_Told":
        for key in ("band",) if self.call == SWEEP else ("frequency",):
            if key not in self.model_fields_set:
                raise ValueError(f"a {key} for a call that is {self.call!r}")
        return self


class OwnCall(_Told):
    """The vehicle's own call, and its times."""

    duration: Annotated[float, Field(ge=1e-5, le=1.0)]
    """Length [s]."""
    deaf: Annotated[float, Field(ge=1e-5, le=10.0)] | None = None
    """Time after its beginning in which nothing else is received [s]; None: its duration."""
    window: Literal["rectangular"] = "rectangular"
    level_db: Level | None = None
    period: Annotated[float, Field(ge=1e-3, le=1e4)] | None = None
    """Time from one call to the next [s]."""
    first: NonNegative = 0.0
    """Time of the first call after the beginning of the sound, with a period [s]."""
    trigger: _Channel | None = None
    """Channel whose level rises when a call begins."""

    @model_validator(mode="after")
    def _one_way(self) -> "OwnCall":
        if self.period is not None and self.trigger is not None:
            raise ValueError("a period or a trigger, not both")
        if self.deaf is not None and self.deaf < self.duration:
            raise ValueError("deaf for as long as the duration, or longer")
        if self.period is not None and self.period <= self.duration:
            raise ValueError("a period that is longer than the duration")
        return self


class OtherCaller(_Told):
    """A caller other than the vehicle."""

    name: _Name
    level_db: Level | None = None
    landmark: Annotated[int, Field(ge=0, lt=2**53)] | None = None
    """Its label in the truth."""
    moves: bool = False
    own_clock: bool = False
    """Whether it calls independently of the vehicle: its measurements are then left out."""


class Description(Section):
    """The keys of ``recording.toml``."""

    model_config = ConfigDict(strict=True)

    format: Literal[1]
    sound: Annotated[tuple[_FileName, ...], Field(strict=False)] = ()
    """The sound files, in the order of time; empty: all in the folder, by name."""
    sample_rate: _Rate | None = None
    """Sample rate that the files must have [Hz]."""
    samples: Annotated[int, Field(ge=1, lt=2**62)] | None = None
    """Samples per channel, in all files."""
    start: Real = 0.0
    """Time of the first sample, by the odometry's clock [s]."""
    scale: Positive = 1.0
    """Amplitude of the value 1 in the files."""
    speed_of_sound: Annotated[float, Field(ge=10, le=10_000)]
    """Converts delays to ranges and phases to bearings [m/s]."""
    one_centre: bool = False
    """Whether all faces are treated as if at the vehicle's position, as in the simulated square."""
    medium: dict[str, Any] = Field(default_factory=dict)
    """Description of the medium, for the reader only."""
    call: OwnCall
    callers: Annotated[tuple[OtherCaller, ...], Field(strict=False, max_length=MAX_OTHERS)] = ()
    log: dict[str, Any]
    """Keys of the ``log.toml`` to write: motion, start and noise."""

    @field_validator("sound")
    @classmethod
    def _in_the_folder(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if any(Path(name).name != name for name in names) or len({*names}) < len(names):
            raise ValueError("names of files in the folder, each once")
        return names

    @model_validator(mode="after")
    def _apart(self) -> "Description":
        names = {"vehicle", *(one.name.casefold() for one in self.callers)}
        if len(names) <= len(self.callers):
            raise ValueError('a name of its own for each caller, not "vehicle", a or A alike')
        everyone = (self.call, *self.callers)
        tones = {(one.call, one.sweep, one.band, one.frequency) for one in everyone}
        if len(tones) <= len(self.callers):
            raise ValueError("a frequency of its own for each who calls")
        return self

    def calls(self, folder: Path) -> tuple[Call, ...]:
        """Return the calls of all callers, the vehicle's first; `folder`: of the recording."""
        duration, calls = self.call.duration, []
        for key, one in zip(self._keys(), (self.call, *self.callers), strict=True):
            file = {} if one.call in (TONE, SWEEP) else {"call": str(folder / one.call)}
            where = f"{folder / FILE}, key '{key}'"
            sound = sound_of(one.model_copy(update=file), duration, where)
            calls.append(sound or ToneBurst(one.frequency, duration))
        return tuple(calls)

    def _keys(self) -> list[str]:
        """Return the keys of the tables of all callers, the vehicle's first."""
        return ["call", *(f"callers.{j}" for j in range(1, len(self.callers) + 1))]


def read_description(folder: Path) -> Description:
    """Read ``recording.toml`` of a folder; raise at its first fault."""
    path = folder / FILE
    raw = parse_toml(read_text(path), path)
    try:
        return Description.model_validate(raw)
    except ValidationError as error:
        fault = min(error.errors(include_url=False), key=lambda f: f["loc"][:1] != ("format",))
    loc = fault["loc"]
    key = ".".join(str(part + 1) if isinstance(part, int) else part for part in loc)
    if fault["type"] == "missing":
        raise refusal(path, f"no key {key!r}", "it", f"add {key!r}")
    if fault["type"] == "extra_forbidden":
        known = {"call": OwnCall, "callers": OtherCaller}.get(str(loc[0]), Description)
        fields = known.model_fields if len(loc) > 1 else Description.model_fields
        near = meant(str(loc[-1]), fields)
        fix = f"did you mean {near!r}?" if near else "remove it"
        raise refusal(path, f"the unknown key {key!r}", f"one of {', '.join(fields)}", fix)
    where = f"{path}, key {key!r}" if key else str(path)
    found = shown(fault["input"]) if key else "keys that do not go together"
    raise refusal(where, found, expectation(fault), "correct the value")
