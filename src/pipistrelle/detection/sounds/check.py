"""Checks of a sound recording: dead or swapped channels, wrong rate, irregular calls.

Array: the *misfit* of a loud echo is the share of its energy that the best beam of a face, or of
all microphones without a face, misses; two swapped channels, or a wrong sign, raise it. A line
counted from its wrong end fits as well, but gives the mirror image of each angle: two faces that
hear one echo then disagree, as they do if faces are swapped.

`Overview` keeps matched-filter output and echoes of some calls for a figure.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations, permutations
from pathlib import Path

import numpy as np
from jaxtyping import Complex, Float, Int

from pipistrelle.acoustics.call import Call, ToneBurst, carrier_of, extent_of, replica
from pipistrelle.config import Config
from pipistrelle.detection.noise import energy_of
from pipistrelle.detection.scans import OWN, Scan
from pipistrelle.detection.snapshots import Detections
from pipistrelle.detection.sounds.calls import Calls
from pipistrelle.detection.sounds.hearing import GAPS, Frame, Hearing, copied_channels, prepared
from pipistrelle.detection.sounds.sound_file import Description, RecordedArray, Sound, open_sound
from pipistrelle.geometry import wrap

CALLS, SNAPSHOTS = 64, 60
"""Most calls that are read, and echoes of a face that are kept."""
MIN_SNAPSHOTS, MIN_PAIRS = 5, 10
MOST_FACES = 4
"""Most faces for which all orders are tried."""
LOUD = 300.0
"""Least power of an echo over the noise of a steered beam."""
WIDEST = 0.2
"""Largest extent of a group of microphones for a tone to reveal their order, in call lengths."""
AROUND, AT_ONCE = 16, 1 << 21
"""Outputs to both sides of an echo that is not of a tone; most numbers in memory at a time."""
MISFIT, BETTER = 0.02, 0.5
"""Least misfit that is reported; largest share of it that a suggested change may leave."""
DISAGREE = 0.15
"""Least median difference between the bearings of two faces that is reported [rad]."""


_Echo = tuple[Float[np.ndarray, " k"], Complex[np.ndarray, "k e"]]
"""A loud echo at a group of microphones: the frequency of its tone, or those of the parts of its
band [Hz], and the matched filters' outputs at each, at the echo's middle."""


def array_faults(hearing: Hearing) -> Iterator[str]:
    """Yield suggested corrections of ``array.csv`` that would explain the loudest echoes better."""
    heard: list[list[_Echo]] = [[] for _ in hearing.array.face]
    pairs: list[tuple[int, float, int, float]] = []
    for k in hearing.calls.spread(CALLS).tolist():
        frame = hearing.frame(k)
        _collect(frame, hearing, heard)
        pairs += _pairs(frame, hearing)
    for g, echoes in enumerate(heard):
        if len(echoes) >= MIN_SNAPSHOTS:
            yield from _order(hearing, g, echoes)
    if len(pairs) >= MIN_PAIRS:
        yield from _faces(hearing, np.array(pairs))


def _collect(frame: Frame, hearing: Hearing, heard: list[list[_Echo]]) -> None:
    """Append a frame's loudest echo of each microphone group and caller, if loud, to `heard`."""
    found = frame.detections
    for g, echoes in enumerate(heard):
        for caller in np.unique(found.caller):
            rows = np.flatnonzero((found.face == g) & (found.caller == caller))
            if rows.size == 0 or len(echoes) >= SNAPSHOTS:
                continue
            d = int(rows[found.power[rows].argmax()])
            echo = _echo(frame, hearing, d) if found.power[d] >= LOUD else None
            if echo is not None:
                echoes.append(echo)


def _echo(frame: Frame, hearing: Hearing, d: int) -> _Echo | None:
    """Return a microphone group's outputs at a detection, or None near the ends of the frame.

    The outputs of a wideband call are split into frequencies, as the microphones of a large array
    receive it at different times.
    """
    found, caller = frame.detections, int(frame.detections.caller[d])
    row, members = hearing.array.layout.members(int(found.face[d]))
    outputs = frame.matched[:, row, caller][:, members]
    at = (found.delay[d] - frame.start) / frame.interval
    wide = hearing.wide(caller, int(found.face[d]))
    if wide is None:
        if not 0 <= round(at) < len(outputs):
            return None
        return hearing.sums.blocks.tones[[caller]], outputs[[round(at)]]
    c, far = wide.beams.speed_of_sound, np.linalg.norm(wide.beams.position, axis=1).max()
    toward = np.array([np.cos(found.bearing[d]), np.sin(found.bearing[d])])
    at -= wide.middle @ toward / c / frame.interval
    reach = AROUND + math.ceil(far / c / frame.interval)
    first, length = round(at) - reach, 2 * reach * frame.interval
    if not 0 <= first <= len(outputs) - 2 * reach:
        return None
    carrier = carrier_of(wide.band, frame.interval)
    limits = (np.array(wide.band[:2]) - carrier) * length
    bins = np.arange(math.ceil(limits[0]), math.floor(limits[1]) + 1)
    spectrum = np.fft.fft(outputs[first : first + 2 * reach], axis=0)[bins]
    turn = np.exp(2j * np.pi * bins / length * (at - first) * frame.interval)
    return carrier + bins / length, spectrum * turn[:, np.newaxis]


def _pairs(frame: Frame, hearing: Hearing) -> list[tuple[int, float, int, float]]:
    """Return faces and angles of loud echoes that two faces detect within a quarter of a call."""
    found, pairs = frame.detections, []
    late = 0.25 * hearing.about.call.duration
    for one, other in combinations(np.flatnonzero(found.power >= LOUD).tolist(), 2):
        same = found.caller[one] == found.caller[other] and found.face[one] != found.face[other]
        face, angle = found.face[[one, other]], found.angle[[one, other]].tolist()
        lines = not np.isnan(hearing.array.layout.normal[face]).any()
        if same and lines and abs(found.delay[one] - found.delay[other]) < late:
            pairs.append((int(face[0]), angle[0], int(face[1]), angle[1]))
    return pairs


def _order(hearing: Hearing, g: int, echoes: list[_Echo]) -> Iterator[str]:
    """Yield a report if swapping two channels of a group, or inverting a channel, fits better."""
    lead, gain = _directions(hearing, g)
    if np.ptp(lead, axis=1).max() > WIDEST * hearing.about.call.duration:  # keep wideband only
        echoes = [echo for echo in echoes if echo[0].size > 1]
    if not echoes:
        return
    row, members = hearing.array.layout.members(g)
    channel = hearing.array.channel[row, members] + 1
    shares = [_shares(echo, lead, gain) for echo in echoes]
    now = 1.0 - float(np.median([share for share, _ in shares]))
    if now < MISFIT:
        return
    changed = 1.0 - np.median([share for _, share in shares], axis=0)
    i, j = divmod(int(changed.argmin()), members.size)
    what = f"swap channels {channel[i]} and {channel[j]}"
    what = what if i != j else f"turn the sign of channel {channel[i]} round"
    misses = f"{_named(hearing, g)}: the best beam misses {now:.1%} of the loudest echoes' energy"
    if changed[i, j] <= BETTER * now:
        yield f"{misses}, {changed[i, j]:.1%} if you {what} in array.csv"
    else:
        yield f"{misses}, and no swap of two channels would help: are places and tone right?"


def _shares(
    echo: _Echo, lead: Float[np.ndarray, "b e"], gain: Float[np.ndarray, " e"]
) -> tuple[float, Float[np.ndarray, "e e"]]:
    """Return an echo's energy share in the best beam, now and after channel swaps or inversions."""
    (frequency, output), now, changed = echo, 0.0, np.zeros((gain.size, gain.size))
    for some in np.array_split(lead, math.ceil(lead.size * gain.size / AT_ONCE)):
        # for each direction, position and channel: the term that would be added to a beam
        heard = np.exp(-2j * np.pi * some[..., np.newaxis] * frequency) @ output
        energy, added = np.abs(heard) ** 2, gain[:, np.newaxis] * heard
        own, own_energy = (np.einsum("bii->bi", each) for each in (added, energy))
        total, whole = own.sum(axis=1), own_energy.sum(axis=1)
        more, louder = added - own[..., np.newaxis], energy - own_energy[..., np.newaxis]
        more[:, range(gain.size), range(gain.size)] = -own
        power = np.abs(total[:, None, None] + more + more.swapaxes(1, 2)) ** 2
        share = power / (whole[:, None, None] + louder + louder.swapaxes(1, 2))
        now = max(now, float((np.abs(total) ** 2 / whole).max()))
        changed = np.maximum(changed, share.max(axis=0))
    return now / np.sum(gain**2), changed / np.sum(gain**2)


def _directions(
    hearing: Hearing, g: int
) -> tuple[Float[np.ndarray, "b e"], Float[np.ndarray, " e"]]:
    """Return the time leads of a group's microphones for many directions [s], and their gains."""
    layout, speed = hearing.array.layout, hearing.config.assumed_sound_speed
    (place, gain), normal = layout.places(g), float(layout.normal[g])
    place = place - gain**2 @ place / np.sum(gain**2)
    reach = np.linalg.norm(place, axis=1).max() * hearing.sums.blocks.tones.max() / speed
    half = math.pi if math.isnan(normal) else 0.5 * math.pi
    bearing = 0.0 if math.isnan(normal) else normal
    bearing += np.linspace(-half, half, 201 + math.ceil(20.0 * math.pi * reach * half))
    toward = np.stack((np.cos(bearing), np.sin(bearing)), axis=-1)
    return toward @ place.T / speed, gain


def _named(hearing: Hearing, g: int) -> str:
    """Return the name of a group of microphones for a message."""
    name = hearing.array.face[g]
    return name if " " in name else f"face {name}"


def _faces(hearing: Hearing, pairs: Float[np.ndarray, "n 4"]) -> Iterator[str]:
    """Yield a report if another order of faces or channels would reconcile two faces' bearings."""
    normal, names = hearing.array.layout.normal, hearing.array.face
    count = len(names)
    face, angle = pairs[:, [0, 2]].astype(np.int64), pairs[:, [1, 3]]

    def differ(order: tuple[int, ...], side: float) -> float:
        bearing = normal[np.array(order)][face] + side * angle
        return float(np.median(np.abs(wrap(bearing[:, 0] - bearing[:, 1]))))

    as_it_is = tuple(range(count))
    now = differ(as_it_is, 1.0)
    if now < DISAGREE:
        return
    moved = sorted(permutations(as_it_is), key=lambda o: sum(map(int.__ne__, o, as_it_is)))
    orders = moved if count <= MOST_FACES else [as_it_is]
    tried = {(order, side): differ(order, side) for side in (-1.0, 1.0) for order in orders}
    said, best = f"two faces that hear one echo differ by {now:.2f} rad", min(tried.values())
    if best > BETTER * now:
        yield f"{said}, and no order of the faces would help"
        return
    fits = [change for change, left in tried.items() if left <= best + 0.02]
    firsts = [next((f for f in fits if f[1] == side), None) for side in (-1.0, 1.0)]
    words = " or ".join(_change(names, *first) for first in firsts if first is not None)
    yield f"{said}, by {best:.2f} rad if in array.csv you {words}"


def _change(names: tuple[str, ...], order: tuple[int, ...], side: float) -> str:
    """Format a correction of ``array.csv``: the order of the faces and of their channels."""
    changes = ["count each face's channels from its other end"] if side < 0 else []
    moved = [(f, o) for f, o in enumerate(order) if f != o]
    changes += [f"let face {names[f]} be where face {names[o]} is" for f, o in moved]
    return " and ".join(changes)


SHOWN_CALLS = 60
"""Most calls that are kept."""
BINS = 400
"""Most delays at which the output is kept, the loudest of each."""


@dataclass(kw_only=True)
class Overview:
    """The matched-filter output and detections of the first calls, for a figure."""

    names: tuple[str, ...]
    """Names of the callers, the vehicle first."""
    time: list[float] = field(default_factory=list)
    """Times of the calls [s]."""
    delay: list[Float[np.ndarray, " n"]] = field(default_factory=list)
    """Delay of each bin since the vehicle's call [s]."""
    level_db: list[Float[np.ndarray, "n c"]] = field(default_factory=list)
    """Level of the loudest face over the noise of its elements, in each bin [dB]."""
    detections: list[Detections] = field(default_factory=list)
    scans: list[Scan] = field(default_factory=list)

    def look(self, frame: Frame) -> None:
        """Store the outputs and detections of a frame, if it is among the first `SHOWN_CALLS`."""
        if len(self.time) == SHOWN_CALLS:
            return
        lags, faces, tones, elements = frame.matched.shape
        parts = frame.matched.reshape(-1).view(frame.matched.real.dtype)
        energy = energy_of(parts, elements) / elements
        loudest = energy.reshape(lags, faces, tones).max(axis=1, initial=0.0)
        edges = np.unique(np.linspace(0, lags, BINS + 1).astype(np.int64))[:-1]
        if edges.size:
            loudest = np.maximum.reduceat(loudest, edges, axis=0)
        self.time.append(frame.time)
        self.delay.append(frame.start + edges * frame.interval)
        self.level_db.append(10.0 * np.log10(np.maximum(loudest, 1e-3)))
        self.detections.append(frame.detections)
        self.scans.append(frame.scan)

    def direct(self, number: int) -> Float[np.ndarray, " k"]:
        """Return the delay of a caller's direct call after each call of the vehicle, or NaN [s]."""
        if number == OWN:
            return np.full(len(self.time), np.nan)
        calls = (found.direct for found in self.detections)
        return np.array([np.nan if one is None else one.delay[number] for one in calls])


RATES = (44_100, 48_000, 88_200, 96_000, 176_400, 192_000, 200_000, 250_000, 256_000, 300_000,
         384_000, 500_000)  # fmt: skip
"""Usual sample rates [Hz]."""
_FAINT, _FLAT = 10 ** (-30 / 20), 10
"""Noise of a dead channel relative to the others'; fewest flat tops of a clipped channel."""
LEAKS = 0.5
"""Least share of the sound during the vehicle's call that is its call at some sample rate."""


def check_recording(folder: Path, about: Description, config: Config) -> list[str]:
    """Return a line for each suspected fault of a recording: channels, rate, clock, array."""
    with open_sound(folder, about) as sound:
        array, sums, sent, calls = prepared(folder, sound, about)
        gaps = calls.spread(GAPS)
        dead, faults = _channels(sound, calls, gaps, array)
        faults += copied_channels(sound, calls, sums.blocks.blank, array.used)
        look = _tone_rate if isinstance(sent[0], ToneBurst) else _call_rate
        faults += look(sound, calls, gaps, sent[0])
        faults += _clock(calls, sound.rate)
        if dead:
            return [*faults, "the order of the channels was not looked at, for some are dead"]
        hearing = Hearing.of(folder, sound, about, config)
        return [*faults, *array_faults(hearing)]


def _channels(
    sound: Sound, calls: Calls, gaps: Int[np.ndarray, " g"], array: RecordedArray
) -> tuple[bool, list[str]]:
    """Find dead, clipped and offset channels; return whether any is dead, and a line for each."""
    noise, mean, flat = [], [], np.zeros(sound.channels)
    for samples in calls.gaps(sound, gaps):
        mean.append(samples.mean(axis=0, dtype=np.float64))
        noise.append(np.median(np.abs(samples - np.median(samples, axis=0)), axis=0))
        most = np.abs(samples).max(axis=0)
        top = (np.abs(samples) == most) & (most > 0.0)
        flat += (top[1:] & top[:-1] & (np.sign(samples[1:]) == np.sign(samples[:-1]))).sum(axis=0)
    level, offset = np.median(noise, axis=0), np.mean(mean, axis=0)
    used = array.used
    usual = float(np.median(level[used]))
    faults, dead = [], [m for m in used if level[m] <= _FAINT * usual]
    for m in used:
        if m in dead:
            faults.append(f"channel {m + 1} is dead: its noise is {level[m]:.2g}, that of the "
                          f"others {usual:.2g}")  # fmt: skip
        elif flat[m] >= _FLAT:
            faults.append(f"channel {m + 1} is clipped: {flat[m]:.0f} samples stay at its largest "
                          "value; turn the gain down")  # fmt: skip
        if m not in dead and abs(offset[m]) > 3.0 * level[m]:
            times = abs(offset[m]) / level[m]
            faults.append(f"channel {m + 1} is off zero by {offset[m]:.3g}, {times:.0f} times its "
                          "noise; hear takes that away")  # fmt: skip
    return bool(dead), faults


def _tone_rate(
    sound: Sound, calls: Calls, gaps: Int[np.ndarray, " g"], sent: Call
) -> Iterator[str]:
    """Yield a report if the tone that leaks into the microphones has the wrong frequency."""
    length = round(sent.duration * sound.rate)
    power = np.zeros(8 * length // 2 + 1)
    for k in gaps:
        samples = sound.read(int(calls.sample[k]), min(length, int(calls.length[k])))
        windowed = (samples - samples.mean(axis=0)) * np.hanning(len(samples))[:, np.newaxis]
        power += (np.abs(np.fft.rfft(windowed, 8 * length, axis=0)) ** 2).sum(axis=1)
    peak = int(power[1:-1].argmax()) + 1
    if not power[peak] > 50.0 * np.median(power):
        return  # no leakage, or silence
    a, b, c = np.log(power[peak - 1 : peak + 2])
    found = (peak + 0.5 * (a - c) / (a - 2.0 * b + c)) * sound.rate / (8 * length)
    own = sent.frequency
    if abs(found - own) <= 0.5 * sound.rate / length:
        return
    fits = sound.rate * own / found
    near = min(RATES, key=lambda rate: abs(rate - fits))
    usual = f", as {near} Hz nearly would" if abs(near / fits - 1.0) < 0.005 else ""
    yield (
        f"while the vehicle calls, {found:.0f} Hz are loudest, not {own:g} Hz (call.frequency): a "
        f"sample rate of {fits:.0f} Hz in place of {sound.rate:g} Hz would explain it{usual}"
    )


def _call_rate(
    sound: Sound, calls: Calls, gaps: Int[np.ndarray, " g"], sent: Call
) -> Iterator[str]:
    """Yield a report if the vehicle's call in the recording fits another sample rate better."""
    share = {}
    for rate in (sound.rate, *RATES):
        if extent_of(sent, rate)[1] >= rate / 2.0:
            continue
        own, energy, answer = replica(sent, rate), 0.0, 0.0
        for k in gaps:
            some = sound.read(int(calls.sample[k]), min(own.size, int(calls.length[k])))
            some = some - some.mean(axis=0)
            against = np.fft.fft(own, 2 * own.size).conj()[:, np.newaxis]
            answers = np.fft.ifft(np.fft.fft(some, 2 * own.size, axis=0) * against, axis=0)
            answer += float((np.abs(answers) ** 2).max(axis=0).sum())
            energy += 0.5 * float((some**2).sum() * np.sum(np.abs(own) ** 2))
        share[rate] = answer / energy if energy > 0.0 else 0.0  # silence
    best = max(share, key=lambda rate: share[rate])
    if share[best] > LEAKS and share[sound.rate] < BETTER * share[best]:
        yield (
            f"while the vehicle calls, {share[sound.rate]:.0%} of the sound are its call at "
            f"{sound.rate:g} Hz, and {share[best]:.0%} at a sample rate of {best:g} Hz"
        )


def _clock(calls: Calls, rate: float) -> Iterator[str]:
    """Yield a report if a few intervals between calls deviate from the usual interval."""
    gap = np.diff(calls.sample)
    if gap.size < 5:
        return
    usual = float(np.median(gap))
    off = np.abs(gap - usual) > max(2.0, 1e-4 * usual)
    odd = np.flatnonzero(off)
    if not 0 < odd.size <= 0.2 * gap.size:
        return  # regular, or irregular by design
    k = int(odd[0])
    more = f", and {odd.size - 1} more such" if odd.size > 1 else ""
    yield (
        f"from call {k} to the next (counted from 0) there are {gap[k]} samples, elsewhere "
        f"{usual:.0f}{more}: {abs(gap[k] - usual) / rate:.3g} s were "
        f"{'lost' if gap[k] < usual else 'put in'}, or the call is not when it is said to be"
    )
