"""Sound files, read in pieces by the package soundfile: a long recording is never in memory."""

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from pipistrelle.config import InputError
from pipistrelle.detection.sounds.description import FILE, Description
from pipistrelle.detection.sounds.sound_header import check_header, header_of
from pipistrelle.files import check_ordinary
from pipistrelle.refusals import refusal

if TYPE_CHECKING:
    from soundfile import SoundFile

ENDINGS = (".wav", ".rf64", ".w64", ".flac", ".aif", ".aiff", ".caf", ".au")
"""Of files that are taken for sound."""


LARGEST_SAMPLE = 1e12
"""No sound is louder, in units of a file's 1."""


class Sound:
    """Sound files that follow one another, as one."""

    def __init__(self, paths: Sequence[Path], files: "Sequence[SoundFile]") -> None:
        self.paths, self._files = paths, files
        self._begin = np.cumsum([0, *(file.frames for file in files)])
        self.rate, self.channels = float(files[0].samplerate), files[0].channels
        self.samples = int(self._begin[-1])
        """Of each channel."""
        kinds = [file.subtype for file in files if file.subtype.startswith("PCM_")]
        widths = [int(kind.removeprefix("PCM_").strip("SU")) for kind in kinds]
        self.quantum = max((2.0 ** (1 - bits) for bits in widths), default=0.0)
        """Largest step of a sample, in units of 1; 0 of floats, and where steps differ."""

    def read(self, first: int, count: int) -> Float[np.ndarray, "t m"]:
        """Read samples of all channels, float32, from number `first` on."""
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
        """Refuse samples that are no finite numbers, or none of a sound."""
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
    """Open the sound files of a recording; refuse what is none, broken, or not as described."""
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
    """Open one sound file, or refuse it."""
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
        name: Any = os.fsencode(path)  # it takes bytes, and refuses text that is not UTF-8
        file = soundfile.SoundFile(name)
    try:
        check_header(path, file, header)
    except BaseException:
        file.close()
        raise
    return file


@contextmanager
def faults_named(path: Path) -> Iterator[None]:
    """Refuse what soundfile cannot read, by the file's name."""
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
