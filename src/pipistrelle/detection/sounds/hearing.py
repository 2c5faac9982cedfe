r"""Hear a recording: noise levels, copied channels, and the echoes of each call, into a log.

Each call is processed by the front end of the simulation. The noise of each channel at each
frequency is estimated from the recording. Echoes fill much of the time after a call, so the gap
between calls is divided into stretches, and only the quietest are used. A channel's level is that
of the median of their block sums :math:`S`, as the power of noise is exponentially distributed:

.. math:: \sigma^2 = \operatorname{median}(|S|^2) / \ln 2 ,

and nearly half of the sums may be outliers. If channels, or also frequencies, differ by no more
than chance, all have the mean level, as weighting by chance would bias bearings.

Copied channels: two microphones have independent noise, so no channel is a multiple of another. If
channel j is a copy of i, scaled by a and perhaps delayed by d samples, the residual is only the
rounding to a file's quantum q,

.. math:: \sum_t (x_j[t] - a x_i[t - d])^2 \le \frac{q^2}{12} (1 + a^2) n
          \left(1 + 5 \sqrt{2 / n}\right) ,

five standard deviations over its mean for n samples. If all sound is below that, copies cannot be
detected.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from pipistrelle.acoustics.call import Call, ToneBurst, blocks_of, check_sampled
from pipistrelle.config import Config
from pipistrelle.detection.beams import Wide
from pipistrelle.detection.front_end import (
    Finders,
    FrontEnd,
    find_calls,
    front_end,
    unlabelled_scan,
    with_edge_floor,
)
from pipistrelle.detection.matched import Workspace, filter_blocks
from pipistrelle.detection.scans import Scan
from pipistrelle.detection.snapshots import Detections, detections_at
from pipistrelle.detection.sounds.calls import Blocks, CallOutputs, Calls, ToneSums, calls_of
from pipistrelle.detection.sounds.sound_file import ARRAY_FILE as ARRAY
from pipistrelle.detection.sounds.sound_file import (
    FILE,
    Description,
    RecordedArray,
    Sound,
    open_sound,
    recorded_array,
)
from pipistrelle.jit import kernel
from pipistrelle.refusals import refusal

GROUP, FIRST_GAPS = 64, 8
"""Gaps that are read at a time; gaps from which the quiet stretches are found."""
STRETCHES, QUIET = 8, 3
"""Stretches in a gap, and most stretches that are used."""
MIN_SUMS = 50
"""Fewest block sums of a channel."""
CHANCE = 5.0
"""Least difference of channels' levels, in standard deviations, for them to be distinguished."""


def set_noise(sums: ToneSums | CallOutputs, sound: Sound, calls: Calls, folder: Path) -> None:
    """Measure each channel's noise and mean, and set the gains that scale sums to unit noise."""
    first, gaps = calls.spread(FIRST_GAPS), calls.spread(sums.gaps)
    means, constant = [], np.ones(sound.channels, dtype=bool)
    for samples in calls.gaps(sound, first):
        heard = samples[sums.blocks.blank :]
        means.append(heard.mean(axis=0, dtype=np.float64))
        constant &= (heard == heard[0]).all(axis=0)
    sums.mean = np.mean(means, axis=0)
    quiet = _quiet(_powers(sums, sound, calls, first, range(STRETCHES)))
    groups = np.array_split(gaps, math.ceil(gaps.size / GROUP))
    level, count = np.zeros(sums.gain.shape), 0
    for group in groups:
        power = np.concatenate(_powers(sums, sound, calls, group, quiet))
        count += len(power)
        if len(power):
            middle = np.median(power, axis=0, overwrite_input=True)
            level += middle.astype(np.float64) / math.log(2.0) / len(groups)
    if count < MIN_SUMS * len(groups):
        found = f"{count} blocks in the quietest part of the gaps between calls"
        raise refusal(folder, found, f"{MIN_SUMS} or more", "record for longer")
    silent = (level == 0.0) | constant[sums.channel][:, np.newaxis]
    if silent.any():
        f, _, e = (int(one[0]) for one in np.nonzero(silent))
        where = f"{folder}, channel {sums.channel[f, e] + 1}"
        raise refusal(where, "no noise at all", "a microphone", "take it out of array.csv")
    sums.gain /= np.sqrt(_alike(level, count))


def _powers(
    sums: ToneSums | CallOutputs,
    sound: Sound,
    calls: Calls,
    numbers: Int[np.ndarray, " g"],
    stretches: Sequence[int],
) -> list[Float[np.ndarray, "b f c e"]]:
    """Return the powers of block sums in given sections of given gaps between calls, by section."""
    power: list[list[np.ndarray]] = [[] for _ in stretches]
    for samples in calls.gaps(sound, numbers):
        heard = sums(samples)
        heard = heard[sums.cut : len(heard) - sums.cut : sums.apart]
        edges = np.linspace(0, len(heard), STRETCHES + 1).astype(np.int64)
        for stretch, part in zip(stretches, power, strict=True):
            some = heard[edges[stretch] : edges[stretch + 1]]
            part.append((some.real**2 + some.imag**2).astype(np.float32))
    return [np.concatenate(part) for part in power]


def _quiet(power: Sequence[Float[np.ndarray, "b f c e"]]) -> list[int]:
    """Return the indices of the quietest sections of a gap, up to chance; three at most."""
    level = np.array([np.median(part) if part.size else np.inf for part in power])
    order = level.argsort()[:QUIET]
    count = power[int(order[0])].size
    quiet = level[order] <= level.min() * (1.0 + 3.0 / math.sqrt(max(count, 1)))
    return np.sort(order[quiet]).tolist()


def _alike(power: Float[np.ndarray, "f c e"], count: int) -> Float[np.ndarray, "f c e"]:
    """Average noise powers over channels or frequencies if chance explains their differences."""
    chance = CHANCE / (math.log(2.0) * math.sqrt(count))
    for axes in ((0, 1, 2), (0, 2)):
        mean = power.mean(axis=axes, keepdims=True)
        if np.abs(power / mean - 1.0).max() < chance:
            return np.broadcast_to(mean, power.shape)
    return power


GAPS, SAMPLES = 16, 8192
"""Most gaps that are read, spread over the recording, and most samples of each."""
LATEST = 2
"""Largest delay or advance of a copy [samples]."""
ROUNDING = 1e-12
"""Share of a channel's power that floating-point rounding may add."""


def copied_channels(
    sound: Sound, calls: Calls, blank: int, used: Int[np.ndarray, " m"]
) -> Iterator[str]:
    """Yield a report for each used channel (numbered from 0) that is a copy of another.

    `blank`: samples from the beginning of a call to the first that is used.
    """
    product, source, power, count = _sums(sound, calls, blank, used)
    audible = (source > 0.0)[:, :, np.newaxis] & (power > 0.0)
    scale = product / np.where(source > 0.0, source, 1.0)[:, :, np.newaxis]
    explained = scale * product
    chance = count * (1.0 + 5.0 * math.sqrt(2.0 / max(count, 1)))
    limit = sound.quantum**2 / 12.0 * (1.0 + scale**2) * chance + ROUNDING * power
    copied = audible & (power - explained <= limit) & (explained > limit)
    for j in range(1, used.size):
        if copied[:, :j, j].any():
            late, i = np.argwhere(copied[:, :j, j])[0]
            times, late = scale[late, i, j], int(late) - LATEST
            words = f", times {times:.3g}" if abs(times - 1.0) > 1e-3 else ""
            words += f", {abs(late)} samples {'late' if late > 0 else 'early'}" if late else ""
            yield (
                f"channel {used[j] + 1} is a copy of channel {used[i] + 1}{words}: of one "
                "microphone two are made, and bearings are wrong; mend the route, or take one out "
                "of array.csv"
            )


def _sums(
    sound: Sound, calls: Calls, blank: int, used: Int[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "d m m"], Float[np.ndarray, "d m"], Float[np.ndarray, " m"], int]:
    """Return the products of all channel pairs at each delay, and the squares, summed over time."""
    lates = range(-LATEST, LATEST + 1)
    product, count = np.zeros((len(lates), used.size, used.size)), 0
    source = np.zeros((len(lates), used.size))
    for samples in calls.gaps(sound, calls.spread(GAPS)):
        heard = samples[blank : blank + SAMPLES, used].astype(np.float64)
        if len(heard) <= 2 * LATEST:
            continue
        there = heard[LATEST : len(heard) - LATEST]
        there = there - there.mean(axis=0)
        for row, late in enumerate(lates):
            before = heard[LATEST - late : len(heard) - LATEST - late]
            before = before - before.mean(axis=0)
            _add_products(before, there, product[row])
            source[row] += (before**2).sum(axis=0)
        count += len(there)
    return product, source, source[LATEST], count


@kernel
def _add_products(
    before: Float[np.ndarray, "t m"], now: Float[np.ndarray, "t m"], sums: Float[np.ndarray, "m m"]
) -> None:
    """Add the products of all pairs of columns, summed over time, to the sums.

    The threads of a matrix product would take ten times longer on a busy machine.
    """
    for t in range(len(now)):
        row = now[t]
        for i in range(row.size):
            some, total = before[t, i], sums[i]
            for j in range(row.size):
                total[j] += some * row[j]


Progress = Callable[[str, int, int], None]
"""Called with a stage's name, the calls heard and their number."""


class Frame(NamedTuple):
    """The matched-filter output and detections after a call of the vehicle."""

    time: float
    """Time of the call [s]."""
    matched: Complex[np.ndarray, "l f c e"]
    """Matched-filter output in units of the noise; the next frame overwrites it."""
    start: float
    """Delay of lag 0 [s]."""
    interval: float
    """Time between two lags [s]."""
    detections: Detections
    scan: Scan


@dataclass(frozen=True, slots=True, kw_only=True)
class Hearing:
    """An open recording with its microphones, calls, noise levels and detectors."""

    about: Description
    sound: Sound
    array: RecordedArray
    calls: Calls
    sums: ToneSums | CallOutputs
    config: Config
    end: FrontEnd
    own_clock: Bool[np.ndarray, " c"]
    """Whether each caller calls independently of the vehicle: its detections are left out."""

    @classmethod
    def of(cls, folder: Path, sound: Sound, about: Description, config: Config) -> "Hearing":
        """Prepare an open recording: its microphones, calls, noise and detector."""
        array, sums, sent, calls = prepared(folder, sound, about)
        set_noise(sums, sound, calls, folder)
        settled = _settled(config, about, sound.rate)
        return cls(
            about=about,
            sound=sound,
            array=array,
            calls=calls,
            sums=sums,
            config=settled,
            end=front_end(settled, array.layout, sums.blocks.tones, str(folder / ARRAY), sent),
            own_clock=np.array([False, *(one.own_clock for one in about.callers)]),
        )

    def wide(self, caller: int, group: int) -> Wide | None:
        """Return the wideband detector of a caller and a group; None for a tone."""
        one = self.end.of(caller, group).detector if isinstance(self.end, Finders) else None
        return one if isinstance(one, Wide) and not one.call.tone else None

    def frame(self, k: int, room: Workspace | None = None) -> Frame:
        """Return matched-filter output and detections after a call, numbered from 0."""
        on, cut = self.sums.blocks, self.sums.cut
        matched, time = self._matched(k, room or Workspace()), float(self.calls.time[k])
        lags = {"start": on.blank / on.rate, "interval": on.interval}
        found = find_calls(matched, self.end, **lags, pulse=on.pulse, cut=cut)
        found = with_edge_floor(detections_at(found, ~self.own_clock[found.caller]), self.config)
        scan, _ = unlabelled_scan(time, found, self.config, self.own_clock)
        whole = matched[cut : len(matched) - cut]
        return Frame(time, whole, **lags, detections=found, scan=scan)

    def _matched(self, k: int, room: Workspace) -> Complex[np.ndarray, "l f c e"]:
        """Return the matched-filter outputs after a call; raise if its samples are not finite."""
        on, shape, first = self.sums.blocks, self.sums.gain.shape, int(self.calls.sample[k])
        samples = self.sound.read(first, int(self.calls.length[k]))
        if isinstance(self.sums, CallOutputs):
            self.sound.refuse_odd(first, samples)
            return self.sums(samples, room)
        count = max((len(samples) - on.blank) // on.block, 0)
        blocks = self.sums(samples, room.array("blocks", (count, *shape)))
        if not np.isfinite(blocks).all():
            self.sound.refuse_odd(first, samples)
        out = room.array("matched", (max(count - on.pulse + 1, 0), *shape))
        return filter_blocks(blocks, pulse=on.pulse, block=1, noise_std=1.0, out=out)


def prepared(
    folder: Path, sound: Sound, about: Description
) -> tuple[RecordedArray, ToneSums | CallOutputs, tuple[Call, ...], Calls]:
    """Return a recording's microphones, filters, callers' waveforms, and the vehicle's calls."""
    array = recorded_array(folder, sound.channels, one_centre=about.one_centre)
    sent, where = about.calls(folder), str(folder / FILE)
    for call in sent:
        check_sampled(call, sound.rate, where=where, duration=f"{where}, key 'call.duration'")
    blank = math.ceil((about.call.deaf or 0.0) * sound.rate - 1e-6)
    if all(isinstance(call, ToneBurst) for call in sent):
        tones = np.array([call.frequency for call in sent])
        block, pulse = blocks_of(sound.rate, about.call.duration, tones)
        blank = blank or block * pulse
        sums = ToneSums(Blocks(sound.rate, block, pulse, blank, tones), array.channel)
    else:
        blank = blank or math.ceil(about.call.duration * sound.rate - 1e-6)
        sums = CallOutputs(sent, sound.rate, blank, array.channel)
    return array, sums, sent, calls_of(folder, about, sound, sums.blocks, sent[0])


def hear_recording(
    folder: Path,
    about: Description,
    config: Config,
    frames: Callable[[int], range],
    look: Callable[[Frame], None],
    progress: Progress | None = None,
) -> list[str]:
    """Detect a recording's echoes, call by call; return a line for each reason to doubt them.

    `frames` returns the range of calls to hear, given their number; `look` is called with each
    frame.
    """
    with open_sound(folder, about) as sound:
        hearing = Hearing.of(folder, sound, about, config)
        numbers, room = frames(hearing.calls.sample.size), Workspace()
        after, used = hearing.sums.blocks.blank, hearing.array.used
        odd = [*copied_channels(sound, hearing.calls, after, used)]
        for done, k in enumerate(numbers, start=1):
            look(hearing.frame(k, room))
            if progress:
                progress("hearing", done, len(numbers))
    return odd


def log_callers(about: Description) -> list[dict[str, Any]]:
    """Return the callers as tables for ``log.toml``: name, landmark label and whether it moves."""
    return [
        {"name": one.name, "landmark": number if one.landmark is None else one.landmark}
        | ({"moves": True} if one.moves else {})
        for number, one in enumerate(about.callers, start=1)
    ]


def _settled(config: Config, about: Description, rate: float) -> Config:
    """Return settings with the recording's sample rate, call duration and speed of sound."""
    assumed = config.assumed.speed_of_sound or about.speed_of_sound
    return config.model_copy(
        update={
            "emitter": config.emitter.model_copy(update={"call_duration": about.call.duration}),
            "receiver": config.receiver.model_copy(update={"sample_rate": rate}),
            "assumed": config.assumed.model_copy(update={"speed_of_sound": assumed}),
        }
    )
