"""Sound files and their description: ``recording.toml``, ``array.csv`` and the samples.

Samples are read in pieces by the package soundfile, after a check of the header. A long recording
is never held in memory. Libraries read a truncated file as a shorter one, so the size that a header
announces is compared with the file's. WAV (RIFF, RIFX, RF64), W64, AIFF and CAF consist of chunks
with a name and a size, and one holds the sound; AU has a header. FLAC and ALAC announce a number
of samples, and spend a bit or more on each that is not predicted exactly: a file of fewer bits than
samples is mostly digital silence, or incomplete.
"""

import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from pydantic import ConfigDict, Field, ValidationError, field_validator, model_validator

from pipistrelle.acoustics.call import Call, ToneBurst, opened_sound, sound_faults, sound_of
from pipistrelle.arrays.layout import Layout, Scattered, at_one_centre, read_array, scattered
from pipistrelle.config import (
    MAX_OTHERS,
    SWEEP,
    TONE,
    CallConfig,
    InputError,
    Level,
    NonNegative,
    Positive,
    Real,
    Section,
)
from pipistrelle.files import read_text
from pipistrelle.refusals import refusal, table_refusal
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
    """Keys of a call in ``recording.toml``; its sound file is relative to the recording."""

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
    """The vehicle's own call, and its times, as keys of ``recording.toml``."""

    duration: Annotated[float, Field(ge=1e-5, le=1.0)]
    """Length [s]."""
    deaf: Annotated[float, Field(ge=1e-5, le=10.0)] | None = None
    """Time after its beginning in which nothing else is received [s]; None: its duration."""
    window: Literal["rectangular"] = "rectangular"
    level_db: Level | None = None
    period: Annotated[float, Field(ge=1e-3, le=1e4)] | None = None
    """Time from a call to the next [s]."""
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
    """A caller other than the vehicle, as keys of ``recording.toml``."""

    name: _Name
    level_db: Level | None = None
    landmark: Annotated[int, Field(ge=0, lt=2**53)] | None = None
    """Its label in the truth."""
    moves: bool = False
    own_clock: bool = False
    """Whether it calls independently of the vehicle: its measurements are then left out."""


class Description(Section):
    """The keys of ``recording.toml``, which describes a sound recording."""

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
        """Return the call of each caller, the vehicle's first; `folder`: of the recording."""
        duration, calls = self.call.duration, []
        for key, one in zip(self._keys(), (self.call, *self.callers), strict=True):
            file = {} if one.call in (TONE, SWEEP) else {"call": str(folder / one.call)}
            where = f"{folder / FILE}, key '{key}'"
            sound = sound_of(one.model_copy(update=file), duration, where)
            calls.append(sound or ToneBurst(one.frequency, duration))
        return tuple(calls)

    def _keys(self) -> list[str]:
        """Return the keys of all callers' tables in ``recording.toml``, the vehicle's first."""
        return ["call", *(f"callers.{j}" for j in range(1, len(self.callers) + 1))]


def read_description(folder: Path) -> Description:
    """Read ``recording.toml`` of a folder; raise at its first fault."""
    path = folder / FILE
    raw = parse_toml(read_text(path), path)
    try:
        return Description.model_validate(raw)
    except ValidationError as error:
        raise table_refusal(path, error, Description, "format") from None


if TYPE_CHECKING:
    from soundfile import SoundFile

WIDTHS = {"PCM_S8": 1, "PCM_U8": 1, "ULAW": 1, "ALAW": 1, "PCM_16": 2, "PCM_24": 3, "PCM_32": 4,
          "FLOAT": 4, "DOUBLE": 8}  # fmt: skip
"""Bytes of a sample, for subtypes of constant width."""
UNFILLED = (0, 0x7FFFF000, 0x7FFFFFFF, 0xFFFFFFFF)
"""Sizes that programs write before they know the true size, and cannot correct in a pipe."""
UNTIL_THE_END = {b"caff": 2**64 - 1, b".snd": 0xFFFFFFFF}
"""Sizes that mean everything up to the end of the file."""
MOST_CHUNKS = 10_000
"""Most chunks that are read."""
PACKED = ("FLAC", "ALAC_16", "ALAC_20", "ALAC_24", "ALAC_32")
"""Formats and subtypes of lossless compression, by prediction and Rice's code."""


class _Kind(NamedTuple):
    """The layout of chunks in a kind of sound file, such as WAV."""

    first: int
    """Offset of the first chunk [byte]."""
    head: struct.Struct
    """Name and size."""
    own: int
    """Bytes of the head that the size includes."""
    even: int
    """Alignment of chunks after the first [byte]."""
    data: bytes
    """Name of the chunk that holds the sound."""


_KINDS = {
    b"RIFF": _Kind(12, struct.Struct("<4sI"), 0, 2, b"data"),
    b"RF64": _Kind(12, struct.Struct("<4sI"), 0, 2, b"data"),
    b"RIFX": _Kind(12, struct.Struct(">4sI"), 0, 2, b"data"),
    b"FORM": _Kind(12, struct.Struct(">4sI"), 0, 2, b"SSND"),
    b"caff": _Kind(8, struct.Struct(">4sQ"), 0, 1, b"data"),
    b"riff": _Kind(
        40, struct.Struct("<16sQ"), 24, 8, bytes.fromhex("64617461f3acd3118cd100c04f8edb8a")
    ),
}


def _check_header(path: Path, file: "SoundFile") -> None:
    """Raise if a sound file's header contradicts the file: its size, samples or rate."""
    length = path.stat().st_size
    with path.open("rb") as raw:
        magic = raw.read(4)
        announced = _announced(raw, magic, length)
    if announced is not None:
        _check_size(path, file, magic, *announced)
    if not 1 <= file.frames < 2**50:
        found = "no samples, or a number of them that was never filled in, as in a pipe"
        raise refusal(path, found, "a whole sound file", "convert it to WAV")
    samples = file.frames * file.channels
    if {file.format, file.subtype} & {*PACKED} and samples > 8 * length:
        found = f"a header of {samples} samples in {length} bytes"
        expected = "a bit or more for each: the noise of microphones takes several"
        raise refusal(path, found, expected, "copy it again, or cut digital silence out")


def _check_size(
    path: Path, file: "SoundFile", magic: bytes, size: int, there: int, rate: int | None
) -> None:
    """Raise if the announced size is not filled in, exceeds the file, or contradicts the header."""
    if size in UNFILLED and size != there:
        raise InputError(
            f"{path}: found a header in which the size of its sound was never filled in "
            f"({size:#x}), as where a recorder writes into a pipe, expected the size; fill it "
            "in by 'sox --ignore-length OLD.wav NEW.wav' or 'ffmpeg -i OLD.wav -c copy NEW.wav'"
        )
    if size > there:
        found = f"a header of {size} bytes of sound, of which {size - there} are missing"
        raise refusal(path, found, "a whole sound file", "copy it again")
    width = WIDTHS.get(file.subtype)
    if width is None or magic not in (b"RIFF", b"RIFX", b"RF64", b"riff"):
        return
    block = file.channels * width
    for found, expected, unit in (
        (rate, block * file.samplerate, "bytes a second"),
        (size // block, file.frames, "samples"),
    ):
        if found not in (None, expected):
            raise refusal(path, f"a header of {found} {unit}", f"{expected} by its other fields",
                          "mend its header, or convert it again")  # fmt: skip


def _announced(raw: BinaryIO, magic: bytes, length: int) -> tuple[int, int, int | None] | None:
    """Return the announced and the actual size of a file's sound, and its bytes per second.

    None for an unknown kind, or a file without sound; the last is None if not announced.
    """
    if magic == b".snd" and length >= 12:
        begin, size = struct.unpack(">II", raw.read(8))
        there = max(length - begin, 0)
        return there if size == UNTIL_THE_END[magic] else size, there, None
    if magic not in _KINDS:
        return None
    kind, rate, long = _KINDS[magic], None, None
    at = kind.first
    for _ in range(MOST_CHUNKS):
        raw.seek(at)
        head = raw.read(kind.head.size + 16)
        if len(head) < kind.head.size:
            return None
        name, size = kind.head.unpack_from(head)
        after = head[kind.head.size :]
        if name == b"ds64" and len(after) == 16:
            long = struct.unpack("<8xQ", after)[0]
        if name[:4] == b"fmt " and len(after) == 16:
            rate = struct.unpack(f"{kind.head.format[0]}8xI4x", after)[0]
        if name == kind.data:
            there = length - at - kind.head.size
            size = long if size == 0xFFFFFFFF and long is not None else size - kind.own
            return there if size == UNTIL_THE_END.get(magic) else size, there, rate
        at += max(size - kind.own, 0) + kind.head.size
        at += -at % kind.even
    return None


ENDINGS = (".wav", ".rf64", ".w64", ".flac", ".aif", ".aiff", ".caf", ".au")
"""Suffixes of sound files."""


LARGEST_SAMPLE = 1e12
"""Largest valid sample, in units of a file's 1."""


class Sound:
    """Consecutive sound files, read as a single recording."""

    def __init__(self, paths: Sequence[Path], files: "Sequence[SoundFile]") -> None:
        self.paths, self._files = paths, files
        self._begin = np.cumsum([0, *(file.frames for file in files)])
        self.rate, self.channels = float(files[0].samplerate), files[0].channels
        self.samples = int(self._begin[-1])
        """Samples per channel."""
        kinds = [file.subtype for file in files if file.subtype.startswith("PCM_")]
        widths = [int(kind.removeprefix("PCM_").strip("SU")) for kind in kinds]
        self.quantum = max((2.0 ** (1 - bits) for bits in widths), default=0.0)
        """Largest step of a sample, in units of 1; 0 for floats."""

    def read(self, first: int, count: int) -> Float[np.ndarray, "t m"]:
        """Read `count` samples of all channels from sample `first`, as float32."""
        if not 0 <= first <= first + count <= self.samples:
            raise ValueError(f"samples {first} to {first + count} of {self.samples}")
        samples = np.empty((count, self.channels), dtype=np.float32)
        done = 0
        while done < count:
            number = int(np.searchsorted(self._begin, first + done, side="right")) - 1
            file, place = self._files[number], first + done - int(self._begin[number])
            wanted = min(count - done, file.frames - place)
            with sound_faults(str(self.paths[number])):
                if file.tell() != place:
                    file.seek(place)
                got = len(file.read(wanted, out=samples[done : done + wanted]))
            if got != wanted:
                found = f"{place + got} samples in place of the {file.frames} that it announces"
                raise refusal(self.paths[number], found, "a whole file", "copy it again")
            done += wanted
        return samples

    def refuse_odd(self, first: int, samples: Float[np.ndarray, "t m"]) -> None:
        """Raise if samples are not finite, or larger than `LARGEST_SAMPLE`."""
        largest = max(-samples.min(initial=0.0), samples.max(initial=0.0))
        if not largest <= LARGEST_SAMPLE:
            odd = np.nonzero(~(np.abs(samples) <= LARGEST_SAMPLE))
            row, channel = (int(one[0]) for one in odd)
            number = int(np.searchsorted(self._begin, first + row, side="right")) - 1
            where = f"{self.paths[number]}, channel {channel + 1}"
            place = first + row - int(self._begin[number])
            found = f"{samples[row, channel]} as sample {place} (from 0)"
            expected = f"finite numbers, up to {LARGEST_SAMPLE:g}"
            raise refusal(where, found, expected, "cut it out, or record again")


@contextmanager
def open_sound(folder: Path, about: Description) -> Iterator[Sound]:
    """Open a recording's sound files; raise if a file is missing, broken or not as described."""
    with ExitStack() as stack:
        paths = _paths(folder, about)
        files = [stack.enter_context(_opened(path)) for path in paths]
        first = files[0]
        for path, file in zip(paths, files, strict=True):
            for found, expected, unit in (
                (file.channels, first.channels, "channels"),
                (file.samplerate, about.sample_rate or first.samplerate, "Hz"),
            ):
                if found != expected:
                    whose = FILE if unit == "Hz" and about.sample_rate else paths[0].name
                    fix = "correct the one that is wrong"
                    raise refusal(path, f"{found} {unit}", f"{expected:g} {unit} ({whose})", fix)
        sound = Sound(paths, files)
        if about.samples not in (None, sound.samples):
            found = f"{sound.samples} samples in {', '.join(path.name for path in paths)}"
            where = f"{folder / FILE}, key 'samples'"
            raise refusal(where, found, f"{about.samples}", "copy the sound again")
        yield sound


def _paths(folder: Path, about: Description) -> list[Path]:
    """Return the paths of a recording's sound files, in their order."""
    if about.sound:
        return [folder / name for name in about.sound]
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDINGS)
    if not found:
        expected = f"a file that ends in {', '.join(ENDINGS)}"
        raise refusal(folder, "no sound file", expected, "add it, or name it in 'sound'")
    return found


def _opened(path: Path) -> "SoundFile":
    """Open a sound file, and raise if its header contradicts the file."""
    file = opened_sound(path, str(path))
    try:
        with sound_faults(str(path)):
            _check_header(path, file)
    except BaseException:
        file.close()
        raise
    return file
