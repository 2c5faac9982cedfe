"""Sound files: read in pieces by the package soundfile, after a check of their headers.

A long recording is never held in memory. Libraries read a truncated file as a shorter one, so the
size that a header announces is compared with the file's. WAV (RIFF, RIFX, RF64), W64, AIFF and CAF
consist of chunks with a name and a size, and one holds the sound; AU has one header. FLAC and ALAC
announce a number of samples, and spend a bit or more on each that is not predicted exactly: a file
of fewer bits than samples is mostly digital silence, or incomplete.
"""

import os
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float

from pipistrelle.config import InputError
from pipistrelle.detection.sounds.description import FILE, Description
from pipistrelle.files import check_ordinary
from pipistrelle.refusals import refusal

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
    """The layout of chunks in a kind of file."""

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


class _Announced(NamedTuple):
    """Size of the sound that a header announces."""

    size: int
    """Announced size [byte]."""
    there: int
    """Size from its beginning to the end of the file [byte]."""
    rate: int | None = None
    """Bytes per second, if announced."""


class Header(NamedTuple):
    """The beginning of a sound file."""

    magic: bytes
    """Its first four bytes."""
    length: int
    """Length of the file [byte]."""
    sound: _Announced | None
    """None if the kind of file does not announce a size."""


def header_of(path: Path) -> Header:
    """Read the announced size from a sound file's header."""
    length = path.stat().st_size
    with path.open("rb") as raw:
        magic = raw.read(4)
        return Header(magic, length, _announced(raw, magic, length))


def check_header(path: Path, file: "SoundFile", header: Header) -> None:
    """Raise if a header does not agree with the file: size, samples or rate."""
    magic, length, said = header
    if said is not None:
        _check_size(path, file, said, magic)
    if not 1 <= file.frames < 2**50:
        found = "no samples, or a number of them that was never filled in, as in a pipe"
        raise refusal(path, found, "a whole sound file", "convert it to WAV")
    samples = file.frames * file.channels
    if {file.format, file.subtype} & {*PACKED} and samples > 8 * length:
        found = f"a header of {samples} samples in {length} bytes"
        expected = "a bit or more for each: the noise of microphones takes several"
        raise refusal(path, found, expected, "copy it again, or cut digital silence out")


def _check_size(path: Path, file: "SoundFile", said: _Announced, magic: bytes) -> None:
    """Raise if the announced size is not filled in, exceeds the file, or contradicts a field."""
    if said.size in UNFILLED and said.size != said.there:
        raise InputError(
            f"{path}: found a header in which the size of its sound was never filled in "
            f"({said.size:#x}), as where a recorder writes into a pipe, expected the size; fill it "
            "in by 'sox --ignore-length OLD.wav NEW.wav' or 'ffmpeg -i OLD.wav -c copy NEW.wav'"
        )
    if said.size > said.there:
        found = (
            f"a header of {said.size} bytes of sound, of which {said.size - said.there} are missing"
        )
        raise refusal(path, found, "a whole sound file", "copy it again")
    width = WIDTHS.get(file.subtype)
    if width is None or magic not in (b"RIFF", b"RIFX", b"RF64", b"riff"):
        return
    block = file.channels * width
    for found, expected, unit in (
        (said.rate, block * file.samplerate, "bytes a second"),
        (said.size // block, file.frames, "samples"),
    ):
        if found not in (None, expected):
            raise refusal(path, f"a header of {found} {unit}", f"{expected} by its other fields",
                          "mend its header, or convert it anew")  # fmt: skip


def _announced(raw: BinaryIO, magic: bytes, length: int) -> _Announced | None:
    """Return the announced size; None for an unknown kind, or a file without sound."""
    if magic == b".snd" and length >= 12:
        begin, size = struct.unpack(">II", raw.read(8))
        there = max(length - begin, 0)
        return _Announced(there if size == UNTIL_THE_END[magic] else size, there)
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
            return _Announced(there if size == UNTIL_THE_END.get(magic) else size, there, rate)
        at += max(size - kind.own, 0) + kind.head.size
        at += -at % kind.even
    return None


if TYPE_CHECKING:
    from soundfile import SoundFile

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
            with faults_named(self.paths[number]):
                if file.tell() != place:
                    file.seek(place)
                got = len(file.read(wanted, out=samples[done : done + wanted]))
            if got != wanted:
                found = f"{place + got} samples in place of the {file.frames} that it announces"
                raise refusal(self.paths[number], found, "a whole file", "copy it anew")
            done += wanted
        return samples

    def refuse_odd(self, first: int, samples: Float[np.ndarray, "t m"]) -> None:
        """Raise if samples are not finite, or larger than `LARGEST_SAMPLE`."""
        odd = ~(np.abs(samples) <= LARGEST_SAMPLE)
        if odd.any():
            row, channel = (int(one[0]) for one in np.nonzero(odd))
            number = int(np.searchsorted(self._begin, first + row, side="right")) - 1
            where = f"{self.paths[number]}, channel {channel + 1}"
            place = first + row - int(self._begin[number])
            found = f"{samples[row, channel]} as sample {place} (from 0)"
            expected = f"finite numbers, up to {LARGEST_SAMPLE:g}"
            raise refusal(where, found, expected, "cut it out, or record anew")


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
            raise refusal(where, found, f"{about.samples}", "copy the sound anew")
        yield sound


def _paths(folder: Path, about: Description) -> list[Path]:
    """Return the sound files, in their order."""
    if about.sound:
        return [folder / name for name in about.sound]
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDINGS)
    if not found:
        expected = f"a file that ends in {', '.join(ENDINGS)}"
        raise refusal(folder, "no sound file", expected, "add it, or name it in 'sound'")
    return found


def _opened(path: Path) -> "SoundFile":
    """Open a sound file, and check its header."""
    try:
        import soundfile
    except ImportError:
        raise InputError(
            f"{path}: is read by the package soundfile, which is not installed; install it by "
            "python -m pip install 'pipistrelle[sound]'"
        ) from None
    check_ordinary(path)
    if not path.exists():
        found = "a link to no file" if path.is_symlink() else "no such file"
        raise refusal(path, found, "a sound file", f"add it, or correct {FILE}")
    with faults_named(path):
        if not path.stat().st_size:
            raise refusal(path, "an empty file", "a sound file", "copy it again")
        header = header_of(path)
        name: Any = os.fsencode(path)  # bytes, as text that is not UTF-8 is refused
        file = soundfile.SoundFile(name)
    try:
        check_header(path, file, header)
    except BaseException:
        file.close()
        raise
    return file


@contextmanager
def faults_named(path: Path) -> Iterator[None]:
    """Turn failures of soundfile into errors that name the file."""
    from soundfile import SoundFileError

    try:
        yield
    except InputError:
        raise
    except PermissionError:
        fix = "give yourself the permission to read it"
        raise refusal(path, "a file that may not be read", "a sound file", fix) from None
    except (SoundFileError, OSError, ValueError, TypeError, OverflowError) as error:
        what: Any = str(error).strip().splitlines() or [type(error).__name__]
        found = what[-1].removeprefix("Error opening ").strip(" .")
        raise refusal(path, f"no sound that can be read ({found[-120:]})", "a sound file",
                      "convert it to WAV or FLAC") from None  # fmt: skip
