"""Calls as the settings have them: a tone, a sweep, or a WAV file of one's own."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Complex, Float

from pipistrelle.acoustics.call import Call, Sweep
from pipistrelle.config import SWEEP, TONE, CallConfig, InputError
from pipistrelle.files import check_ordinary
from pipistrelle.refusals import refusal
from pipistrelle.settings import CALL_KEYS, CALLERS, Layer, beside

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

FINER = 8
"""How much finer than its file's samples a recorded call is interpolated."""
LEAST_SAMPLES = 10
"""Fewest samples of a recorded call."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedCall:
    """A call from a file, between its samples as its band has it, and silence after them."""

    path: str
    frequency: float
    """Where its band lies [Hz]."""
    duration: float
    """Length, silence included [s]."""
    rate: float
    """Sample rate of the file [Hz]."""
    samples: Float[np.ndarray, " n"]
    """As the file has them."""
    _envelope: "CubicSpline" = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Interpolate the analytic signal, turned back by the band's frequency."""
        from scipy.fft import fft, ifft, next_fast_len
        from scipy.interpolate import CubicSpline

        count = next_fast_len(2 * self.samples.size + 64)
        spectrum = fft(self.samples - self.samples.mean(), count)
        spectrum[count // 2 :] = 0.0  # what is left is the analytic signal's half
        fine = np.zeros(FINER * count, dtype=np.complex128)
        fine[: count // 2] = spectrum[: count // 2]
        signal = 2.0 * FINER * ifft(fine)[: FINER * self.samples.size]
        time = np.arange(signal.size) / (FINER * self.rate)
        envelope = signal * np.exp(-2j * np.pi * self.frequency * time) / np.abs(signal).max()
        object.__setattr__(self, "_envelope", CubicSpline(time, envelope))

    def waveform(
        self, time: Float[np.ndarray, "*n"], frequency: float
    ) -> Complex[np.ndarray, "*n"]:
        """Return the call as it is received; silence before and after."""
        own = np.asarray(time) * (frequency / self.frequency)
        inside = (own >= 0.0) & (own <= (self.samples.size - 1) / self.rate)
        turned = np.exp(2j * np.pi * self.frequency * own)
        return np.where(inside, self._envelope(np.where(inside, own, 0.0)) * turned, 0.0)


def sound_of(settings: CallConfig, duration: float, key: str) -> Call | None:
    """Return what a caller sends, or None where it is a plain tone.

    `duration`: of every call [s]; `key`: the caller's section, for refusals.

    >>> sound_of(CallConfig(call="sweep"), 2.8e-3, "emitter")
    Sweep(start=60000.0, end=35000.0, duration=0.0028, law='linear', taper=0.0)
    """
    if settings.call == TONE:
        if settings.taper == 0.0:
            return None
        return Sweep(settings.frequency, settings.frequency, duration, taper=settings.taper)
    if settings.call == SWEEP:
        return Sweep(*settings.band, duration, settings.sweep, settings.taper)
    if settings.taper != 0.0:
        raise InputError(
            f"{key}.taper: found {settings.taper:g} beside the file {settings.call}, which has its "
            "own; expected 0"
        )
    return read_call(Path(settings.call), settings.frequency, duration, f"{key}.call")


def settings_of(sound: Call | None) -> dict[str, Any]:
    """Return the settings that give a caller's sound again; none of a plain tone.

    >>> settings_of(Sweep(60e3, 35e3, 2.8e-3))["band"]
    [60000.0, 35000.0]
    """
    if isinstance(sound, RecordedCall):
        return {"call": sound.path}
    if not isinstance(sound, Sweep):
        return {}
    if sound.start == sound.end:
        return {"taper": sound.taper}
    band = [sound.start, sound.end]
    return {"call": SWEEP, "sweep": sound.law, "band": band, "taper": sound.taper}


def with_calls(layer: Layer) -> Layer:
    """Return settings whose calls' files are named from the root, so that they hold anywhere."""
    here = Path.cwd() / "settings"
    calls = {key: given for key, given in layer.items() if key in CALL_KEYS}
    named = {
        key: given._replace(value=str(here.parent / given.value))
        for key, given in calls.items()
        if isinstance(given.value, str) and given.value not in ("", TONE, SWEEP)
    }
    if CALLERS in layer:
        given = layer[CALLERS]
        named[CALLERS] = given._replace(value=beside(here, given.value))
    return layer | named


def read_call(path: Path, frequency: float, duration: float, where: str) -> RecordedCall:
    """Read a call from a sound file of one channel, or refuse it.

    `frequency`: where its band lies [Hz]; `duration`: the longest that it may be [s]; `where` the
    file is named, for refusals.
    """
    rate, samples = _samples(path, where)
    place, longest = f"{where}: {path}", round(duration * rate)
    if not LEAST_SAMPLES <= samples.size <= longest:
        fix = "cut it, or set emitter.pulse, which all calls last"
        expected = f"{LEAST_SAMPLES} to {longest} ({duration:g} s)"
        raise refusal(place, f"{samples.size} samples at {rate:g} Hz", expected, fix)
    if not np.isfinite(samples).all() or not np.ptp(samples) > 0.0:
        found = "samples that are no finite numbers" if np.ptp(samples) != 0.0 else "silence"
        raise refusal(place, found, "a call", "record it anew")
    power = np.abs(np.fft.rfft(samples - samples.mean(), 8 * samples.size)) ** 2
    centre = float(np.sum(power * np.arange(power.size)) / power.sum() * rate / (8 * samples.size))
    section = where.rpartition(".")[0]
    if not 0.5 * centre <= frequency <= 2.0 * centre:
        expected = f"about {centre:.0f} Hz, where the band of {path} lies"
        raise refusal(f"{section}.frequency", f"{frequency:g} Hz", expected, "correct it")
    return RecordedCall(str(path), frequency, duration, rate, samples)


def _samples(path: Path, where: str) -> tuple[float, Float[np.ndarray, " n"]]:
    """Return rate and samples of a sound file of one channel, or refuse it."""
    try:
        import soundfile
    except ImportError:
        raise InputError(
            f"{where}: {path} is read by the package soundfile, which is not installed; install it "
            "by python -m pip install 'pipistrelle[sound]'"
        ) from None
    expected = f"{TONE!r}, {SWEEP!r}, or a sound file of one channel"
    check_ordinary(path)
    if not path.exists():
        raise refusal(where, f"{str(path)!r}, no such file", expected, "check the path")
    try:
        with soundfile.SoundFile(path) as file:
            if file.channels != 1 or not LEAST_SAMPLES <= file.frames <= 10 * file.samplerate:
                found = f"{path} with {file.channels} channels and {file.frames} samples"
                raise refusal(where, found, expected, "save one call alone")
            return float(file.samplerate), file.read(dtype="float64")
    except (soundfile.SoundFileError, OSError, ValueError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        found = f"{path}, no sound that can be read"
        raise refusal(where, found, expected, "convert it to WAV") from None
