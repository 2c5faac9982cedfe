r"""Calls: tone bursts, sweeps and recorded files; their waveforms, bands and cross talk.

Recorder and matched filter know only the waveform of a `Call`. A motion at the speed v scales
a call in time, :math:`s(a (t - \tau))` with a the ratio of the received frequency to the sent one.

A `Sweep` passes through a band. By the linear law its frequency is linear in time, by the
hyperbolic law its period is,

.. math:: f(t) = f_0 + (f_1 - f_0) \frac{t}{T}, \qquad
          \frac{1}{f(t)} = \frac{1}{f_0} + \left(\frac{1}{f_1} - \frac{1}{f_0}\right) \frac{t}{T} ,

and a call of the second law that is scaled in time is the same call at another time, except at its
ends: no motion makes its echo fainter. With both laws a Doppler shift looks like a delay,

.. math:: \delta = -(a - 1) \frac{f_1 T}{f_1 - f_0} ,

to first order (`coupling`).

A real recording is matched in each call's band, the middle of its spectrum that holds nearly all of
its energy. The matched filter has at least twice as many outputs per second as the widest band has
Hz, so that nothing between them is lost. With the spectrum S in the band,

.. math:: f_c = \frac{\int f |S|^2}{\int |S|^2}, \qquad
          \beta^2 = (2\pi)^2 \frac{\int (f - f_c)^2 |S|^2}{\int |S|^2} ,

the Cramer-Rao bound of a delay is :math:`1 / (2 p \beta^2)`, with p the power of the output in
units of its noise.

Sources: Klauder et al., Bell System Technical Journal 39 (1960), for the linear law; Kroszczynski,
Proceedings of the IEEE 57 (1969), and Altes & Titlebaum, Journal of the Acoustical Society of
America 48 (1970), for the hyperbolic law; Van Trees, Detection, Estimation, and Modulation Theory
III (1971), Sec. 10.2, for the bound.
"""

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

import numpy as np
from jaxtyping import Complex, Float

from pipistrelle.config import BLOCK, SWEEP, TONE, CallConfig, InputError
from pipistrelle.files import check_ordinary
from pipistrelle.refusals import refusal
from pipistrelle.settings import CALL_KEYS, CALLERS, Layer, beside


class Call(Protocol):
    """Interface of a call: its centre frequency, duration and waveform."""

    @property
    def frequency(self) -> float:
        """Centre frequency of the call's band [Hz]."""
        ...

    @property
    def duration(self) -> float:
        """Duration of the call [s]."""
        ...

    def waveform(
        self, time: Float[np.ndarray, "*n"], frequency: float
    ) -> Complex[np.ndarray, "*n"]:
        """Return the call's analytic signal, of unit amplitude, at times since its start [s].

        `frequency`: the centre as received, with Doppler shift [Hz].
        """
        ...


@dataclass(frozen=True, slots=True)
class ToneBurst:
    """A tone switched on and off (Bradley & Abaid, Sec. II-A); its matched output is a triangle."""

    frequency: float
    """[Hz]."""
    duration: float
    """[s]."""

    def waveform(
        self, time: Float[np.ndarray, "*n"], frequency: float
    ) -> Complex[np.ndarray, "*n"]:
        """Return the analytic signal of a tone of the received frequency at given times [s].

        >>> ToneBurst(35e3, 2.8e-3).waveform(np.array([0.0, 1e-5]), 50e3).round(9)
        array([ 1.+0.j, -1.+0.j])
        """
        return np.exp(2j * np.pi * frequency * time)


@dataclass(frozen=True, slots=True)
class Sweep:
    """A call that sweeps through a band, with frequency or period linear in time."""

    start: float
    end: float
    """`start` and `end`: frequency at its beginning and end [Hz]; if equal, it is a tone."""
    duration: float
    """[s]."""
    law: Literal["linear", "hyperbolic"] = "linear"
    """Whether the frequency or the period is linear in time."""
    taper: float = 0.0
    """Share of the call with a cosine rise and fall (Tukey's window): 0 is rectangular, 1 Hann's
    window."""

    @property
    def frequency(self) -> float:
        """Centre frequency of the sweep's band [Hz]."""
        return 0.5 * (self.start + self.end)

    def waveform(
        self, time: Float[np.ndarray, "*n"], frequency: float
    ) -> Complex[np.ndarray, "*n"]:
        """Return the Doppler-scaled sweep (analytic signal) at given times; zero outside the sweep.

        >>> slow = Sweep(60e3, 35e3, 2.8e-3, taper=1.0)
        >>> abs(slow.waveform(np.array([0.0, 1.4e-3, 2.8e-3]), 47.5e3)).round(9)
        array([0., 1., 0.])
        """
        own = np.asarray(time) * (frequency / self.frequency)
        share = own / self.duration
        if self.law == "linear" or self.start == self.end:
            turns = own * (self.start + 0.5 * (self.end - self.start) * share)
        else:
            bend = (1.0 / self.end - 1.0 / self.start) / self.duration
            turns = np.log1p(bend * self.start * np.clip(own, 0.0, self.duration)) / bend
        return tapered(share, self.taper) * np.exp(2j * np.pi * turns)


def tapered(share: Float[np.ndarray, "*n"], taper: float) -> Float[np.ndarray, "*n"]:
    """Return Tukey's window at times given as shares of a call's duration; 0 outside [0, 1].

    >>> tapered(np.array([0.0, 0.1, 0.5, 1.1]), 0.4).round(3)
    array([0. , 0.5, 1. , 0. ])
    """
    edge = np.minimum(share, 1.0 - share)
    inside = edge >= 0.0
    if taper == 0.0:
        return inside.astype(np.float64)
    rise = np.clip(2.0 * edge / taper, 0.0, 1.0)
    return np.where(inside, 0.5 - 0.5 * np.cos(np.pi * rise), 0.0)


def coupling(call: Call) -> float:
    """Return the apparent delay of an echo per relative Doppler shift (received / sent - 1) [s].

    By the call's matched filter. It is 0 for tones to first order, and for files, for which it is
    unknown.

    >>> round(1e3 * coupling(Sweep(60e3, 35e3, 2.8e-3)), 2), coupling(ToneBurst(35e3, 2.8e-3))
    (3.92, 0.0)
    """
    if not isinstance(call, Sweep) or call.start == call.end:
        return 0.0
    return -call.end * call.duration / (call.end - call.start)


if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline
    from soundfile import SoundFile

FINER = 8
"""Interpolation factor of a recorded call."""
LEAST_SAMPLES = 10
"""Fewest samples of a call."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedCall:
    """A call from a sound file, interpolated between its samples, and silent after them."""

    path: str
    frequency: float
    """Centre of its band [Hz]."""
    duration: float
    """Length, with silence [s]."""
    rate: float
    """Sample rate of the file [Hz]."""
    samples: Float[np.ndarray, " n"]
    """Samples of the file."""
    _envelope: "CubicSpline" = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Build the spline of the recording's complex envelope about its centre frequency."""
        from scipy.fft import fft, ifft, next_fast_len
        from scipy.interpolate import CubicSpline

        count = next_fast_len(2 * self.samples.size + 64)
        spectrum = fft(self.samples - self.samples.mean(), count)
        spectrum[count // 2 :] = 0.0  # half of the analytic signal remains
        fine = np.zeros(FINER * count, dtype=np.complex128)
        fine[: count // 2] = spectrum[: count // 2]
        signal = 2.0 * FINER * ifft(fine)[: FINER * self.samples.size]
        time = np.arange(signal.size) / (FINER * self.rate)
        envelope = signal * np.exp(-2j * np.pi * self.frequency * time) / np.abs(signal).max()
        object.__setattr__(self, "_envelope", CubicSpline(time, envelope))

    def waveform(
        self, time: Float[np.ndarray, "*n"], frequency: float
    ) -> Complex[np.ndarray, "*n"]:
        """Return the Doppler-scaled recording (analytic signal) at given times; zero outside it."""
        own = np.asarray(time) * (frequency / self.frequency)
        inside = (own >= 0.0) & (own <= (self.samples.size - 1) / self.rate)
        turned = np.exp(2j * np.pi * self.frequency * own)
        return np.where(inside, self._envelope(np.where(inside, own, 0.0)) * turned, 0.0)


def sound_of(settings: CallConfig, duration: float, key: str) -> Call | None:
    """Build the call that a caller's settings describe; return None for a tone without taper.

    `duration`: of every call [s]; `key`: the caller's section, for errors.

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
    """Return the settings that give a caller this call; empty for a tone without taper.

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
    """Make the paths of calls' sound files in a layer of settings absolute."""
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
    """Read a call from a mono sound file; raise if its length, samples or frequency do not fit.

    `frequency`: centre of its band [Hz]; `duration`: longest allowed [s]; `where`: the setting that
    names the file, for errors.
    """
    place = f"{where}: {path}"
    with opened_sound(path, place) as file, sound_faults(place):
        if file.channels != 1 or not LEAST_SAMPLES <= file.frames <= 10 * file.samplerate:
            found = f"{file.channels} channels and {file.frames} samples"
            raise refusal(place, found, "a sound file of a single call", "save one call alone")
        rate, samples = float(file.samplerate), file.read(dtype="float64")
    longest = round(duration * rate)
    if not LEAST_SAMPLES <= samples.size <= longest:
        fix = "cut it, or set emitter.call_duration, which all calls last"
        expected = f"{LEAST_SAMPLES} to {longest} ({duration:g} s)"
        raise refusal(place, f"{samples.size} samples at {rate:g} Hz", expected, fix)
    if not np.isfinite(samples).all() or not np.ptp(samples) > 0.0:
        found = "samples that are no finite numbers" if np.ptp(samples) != 0.0 else "silence"
        raise refusal(place, found, "a call", "record it again")
    power = np.abs(np.fft.rfft(samples - samples.mean(), 8 * samples.size)) ** 2
    centre = float(np.sum(power * np.arange(power.size)) / power.sum() * rate / (8 * samples.size))
    section = where.rpartition(".")[0]
    if not 0.5 * centre <= frequency <= 2.0 * centre:
        expected = f"about {centre:.0f} Hz, where the band of {path} lies"
        raise refusal(f"{section}.frequency", f"{frequency:g} Hz", expected, "correct it")
    return RecordedCall(str(path), frequency, duration, rate, samples)


def opened_sound(path: Path, where: str) -> "SoundFile":
    """Open a sound file; raise if it is missing, empty or cannot be read; `where`: for errors."""
    try:
        import soundfile
    except ImportError:
        raise InputError(
            f"{where}: is read by the package soundfile, which is not installed; install it by "
            "python -m pip install soundfile"
        ) from None
    check_ordinary(path)
    if not path.exists():
        found = "a link to no file" if path.is_symlink() else "no such file"
        raise refusal(where, found, "a sound file", "add it, or correct its name")
    with sound_faults(where):
        if not path.stat().st_size:
            raise refusal(where, "an empty file", "a sound file", "copy it again")
        name: Any = os.fsencode(path)  # bytes, as text that is not UTF-8 is refused
        return soundfile.SoundFile(name)


@contextmanager
def sound_faults(where: str) -> Iterator[None]:
    """Convert errors of soundfile within the context into an `InputError` with the place."""
    from soundfile import SoundFileError

    try:
        yield
    except InputError:
        raise
    except PermissionError:
        fix = "give yourself the permission to read it"
        raise refusal(where, "a file that may not be read", "a sound file", fix) from None
    except (SoundFileError, OSError, ValueError, TypeError, OverflowError) as error:
        what: Any = str(error).strip().splitlines() or [type(error).__name__]
        found = what[-1].removeprefix("Error opening ").strip(" .")
        raise refusal(where, f"no sound that can be read ({found[-120:]})", "a sound file",
                      "convert it to WAV or FLAC") from None  # fmt: skip


ENERGY = 0.995
"""Share of a call's energy in its band."""
MAX_CROSS_TALK = 0.06
"""Largest allowed relative power of a call in the matched filter of another."""
PADDING = 8
"""Zero-padding factor of a call's spectrum."""
GRID = 128
"""Lags in the period of the slowest carrier; every window is a multiple of it."""


class Band(NamedTuple):
    """Frequency band of a call: its limits, centre and spread, with the call's energy."""

    low: float
    high: float
    centre: float
    """`low`, `high` and the energy-weighted mean `centre` [Hz]."""
    spread: float
    """Root mean square angular frequency about the centre [rad/s]."""
    energy: float
    """Sum of the squares of its samples, in units of its squared amplitude."""


def replica(call: Call, rate: float, scale: float = 1.0) -> Complex[np.ndarray, " n"]:
    """Sample a call's waveform at a rate [Hz], with its centre frequency scaled by a factor."""
    time = np.arange(math.ceil(call.duration * rate - 1e-6)) / rate
    return call.waveform(time, scale * call.frequency)


@lru_cache(maxsize=64)
def band_of(call: Call, rate: float) -> Band:
    """Compute the frequency band that holds nearly all energy of a call sampled at a rate [Hz].

    >>> band = band_of(Sweep(60e3, 35e3, 2.8e-3, taper=0.2), 200e3)
    >>> round(band.low / 1e3), round(band.high / 1e3), round(band.centre / 1e3, 1)
    (35, 60, 47.5)
    """
    sent = replica(call, rate)
    power = np.abs(np.fft.fft(sent, PADDING * sent.size)) ** 2
    bins = np.arange(power.size)
    share = np.cumsum(power) / power.sum()
    edges = np.searchsorted(share, (0.5 * (1.0 - ENERGY), 0.5 * (1.0 + ENERGY)))
    low, high = edges.tolist()
    inside, step = slice(low, high + 1), rate / power.size
    weight = power[inside] / power[inside].sum()
    centre = float(np.sum(weight * bins[inside]))
    spread = 2.0 * np.pi * step * math.sqrt(np.sum(weight * (bins[inside] - centre) ** 2))
    energy = float(np.sum(np.abs(sent) ** 2))
    return Band(low * step, high * step, centre * step, spread, energy)


def extent_of(call: Call, rate: float) -> tuple[float, float]:
    """Return a call's lowest and highest frequency [Hz], equal for a tone burst."""
    if isinstance(call, ToneBurst):
        return call.frequency, call.frequency
    band = band_of(call, rate)
    ends = (call.start, call.end) if isinstance(call, Sweep) else (call.frequency,)
    return min(band.low, *ends), max(band.high, *ends)


def is_whole(count: float) -> bool:
    """Return whether a number is an integer from 1, up to rounding."""
    return round(count) >= 1 and abs(count - round(count)) <= 1e-6


def blocks_of(rate: float, duration: float, tones: Float[np.ndarray, " c"]) -> tuple[int, int]:
    """Return the samples in a block and the blocks in a call, which hold at least its duration [s].

    Of 0.2 ms if all is whole, so that noise is independent between tones; else about a fourteenth
    of the call.

    >>> blocks_of(200e3, 2.8e-3, np.array([35e3, 30e3])), blocks_of(192e3, 5e-4, np.array([40e3]))
    ((40, 14), (8, 12))
    """
    if on_raster(rate, duration, tones):
        return round(rate * BLOCK), round(duration / BLOCK)
    length = duration * rate - 1e-6
    choice = [(math.ceil(length / count), count) for count in range(LEAST_SAMPLES, 21)]
    return min(choice, key=lambda b: (b[0] * b[1], abs(b[1] - 14)))


def on_raster(rate: float, duration: float, tones: Float[np.ndarray, " c"]) -> bool:
    """Return whether blocks of 0.2 ms are whole samples, calls whole blocks, tones whole bins."""
    return all(map(is_whole, (rate * BLOCK, duration / BLOCK, *(tones * BLOCK))))


def check_sampled(
    call: Call, rate: float, *, where: str, duration: str, named: str = "sample rate"
) -> None:
    """Raise if a sample rate [Hz] is too low for a call.

    For errors: `where`, the caller's section; `duration`, the setting of the call's duration;
    `named`, the name of the rate.
    """
    if call.duration * rate < LEAST_SAMPLES:
        found = f"{call.duration:g} s, {call.duration * rate:.3g} samples at {rate:g} Hz"
        raise refusal(duration, found, f"{LEAST_SAMPLES} or more", "correct one of them")
    low, high = extent_of(call, rate)
    if not 0.0 < low <= high < rate / 2.0:
        found = f"a call of {low:.0f} to {high:.0f} Hz, the edges of its spectrum included"
        expected = f"one between 0 and half the {named} of {rate:g} Hz"
        fix = "correct one of them"
        if isinstance(call, ToneBurst):
            found = f"a tone of {call.frequency:g} Hz"
        elif isinstance(call, Sweep):
            begin, end = sorted((call.start, call.end))
            found = f"a sweep of {begin:g} to {end:g} Hz, whose edges reach from {low:.0f} to"
            found += f" {high:.0f} Hz"
            fix += ", or fade the call's ends in and out ('taper')"
        raise refusal(where, found, expected, fix)


def cross_talk(calls: Sequence[Call], rate: float) -> Float[np.ndarray, "c c"]:
    """Return the peak relative power of each call (column) in each call's matched filter (row).

    `rate` [Hz]. Row i is the filter of call i.
    """
    sent = [replica(call, rate) for call in calls]
    count = 2 * max(one.size for one in sent)
    spectra = [np.fft.fft(one / np.linalg.norm(one), count) for one in sent]
    answers = [[np.abs(np.fft.ifft(b * a.conj())).max() ** 2 for b in spectra] for a in spectra]
    return np.array(answers)


def lag_step(calls: Sequence[Call], rate: float) -> int:
    """Return the step between matched-filter outputs, in samples, by the widest band of the calls.

    >>> lag_step([ToneBurst(35e3, 2.8e-3)], 200e3)
    6
    """
    widest = max(band.high - band.low for band in (band_of(call, rate) for call in calls))
    return max(math.floor(rate / (2.0 * widest)), 1)


def bands_of(calls: Sequence[Call], rate: float) -> list[Band]:
    """Return the band of each call's filter; a tone has twice the rate of its outputs.

    A rectangular tone is timed by its edges, which have no band: its filter falls off slowly.
    """
    reach, bands = rate / lag_step(calls, rate), [band_of(call, rate) for call in calls]
    for c, call in enumerate(calls):
        if isinstance(call, ToneBurst):
            low, high = max(call.frequency - reach, 0.0), min(call.frequency + reach, rate / 2.0)
            bands[c] = bands[c]._replace(low=low, high=high)
    return bands


def carrier_of(band: Band, interval: float) -> float:
    """Return the carrier of a band's complex envelope [Hz]: near its middle, and a bin of windows.

    `interval`: between two lags [s].
    """
    cycle = GRID * interval
    return round(0.5 * (band.low + band.high) * cycle) / cycle


def window_lags(least: float) -> int:
    """Return the least number of lags, not below `least`, with a fast Fourier transform."""
    from scipy.fft import next_fast_len

    return GRID * next_fast_len(math.ceil(least / GRID))


def bins_of(band: Band, lags: int, interval: float) -> tuple[int, int, int]:
    """Return the bins of a band's carrier, and of its lowest and highest frequency less that.

    In a window of `lags` times `interval` [s].
    """
    length = lags * interval
    middle = round(carrier_of(band, interval) * length)
    return middle, math.ceil(band.low * length) - middle, math.floor(band.high * length) - middle
