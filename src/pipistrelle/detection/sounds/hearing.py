"""Sound in: a recording is heard call by call, by the front end of the simulation, into a log."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from pipistrelle.acoustics.call import Call, Sweep, ToneBurst
from pipistrelle.arrays.bands import extent_of
from pipistrelle.config import Config
from pipistrelle.detection.echoes import unlabelled_scan, with_edge_floor
from pipistrelle.detection.front_end import FrontEnd, Mixed, find_calls, front_end
from pipistrelle.detection.matched import Workspace, filter_blocks
from pipistrelle.detection.scans import Scan
from pipistrelle.detection.snapshots import Detections, detections_at
from pipistrelle.detection.sounds.call_outputs import CallOutputs
from pipistrelle.detection.sounds.calls import Calls, calls_of
from pipistrelle.detection.sounds.copied_channels import copied_channels
from pipistrelle.detection.sounds.description import FILE, Description
from pipistrelle.detection.sounds.noise_level import set_noise
from pipistrelle.detection.sounds.recorded_array import FILE as ARRAY
from pipistrelle.detection.sounds.recorded_array import RecordedArray, recorded_array
from pipistrelle.detection.sounds.sound_file import Sound, open_sound
from pipistrelle.detection.sounds.tone_sums import Blocks, ToneSums, blocks_of
from pipistrelle.detection.wideband import Wide
from pipistrelle.refusals import refusal

Progress = Callable[[str, int, int], None]
"""Called with a stage's name, the calls heard and their number."""


class Frame(NamedTuple):
    """What was heard after one call of the vehicle."""

    time: float
    """Of the call [s]."""
    matched: Complex[np.ndarray, "l f c e"]
    """The matched filters' output, in units of the noise; the next frame overwrites it."""
    start: float
    """Delay of lag 0 [s]."""
    interval: float
    """Between two lags [s]."""
    detections: Detections
    scan: Scan


@dataclass(frozen=True, slots=True, kw_only=True)
class Hearing:
    """A recording that is open, and all that is the same for each of its calls."""

    folder: Path
    about: Description
    sound: Sound
    array: RecordedArray
    blocks: Blocks
    calls: Calls
    sums: ToneSums | CallOutputs
    config: Config
    end: FrontEnd
    own_clock: Bool[np.ndarray, " c"]
    """Whether each caller has a clock of its own: its rows are left out."""

    @classmethod
    def of(cls, folder: Path, sound: Sound, about: Description, config: Config) -> "Hearing":
        """Look at a recording: its microphones, when its vehicle called, and its noise.

        `config`: sections detection, matching and assumed count; the rest is the recording's.
        """
        array = recorded_array(folder, sound.channels, one_centre=about.one_centre)
        sums, sent = sums_of(folder, sound, about, array)
        blocks = sums.blocks
        calls = calls_of(folder, about, sound, blocks, sent[0])
        set_noise(sums, sound, calls, folder)
        settled = _settled(config, about, sound.rate)
        return cls(
            folder=folder,
            about=about,
            sound=sound,
            array=array,
            blocks=blocks,
            calls=calls,
            sums=sums,
            config=settled,
            end=front_end(settled, array.layout, blocks.tones, str(folder / ARRAY), sent),
            own_clock=np.array([False, *(one.own_clock for one in about.callers)]),
        )

    def wide(self, caller: int, group: int) -> Wide | None:
        """Return what finds a call in a group's outputs over its whole band; None of a tone."""
        wide = self.end.wide if isinstance(self.end, Mixed) else ()
        return next((one for p, g, one in wide if (p, g) == (caller, group)), None)

    def frames(self, numbers: Sequence[int]) -> Iterator[Frame]:
        """Hear what came after some of the calls, numbered from 0 on."""
        calls, room = self.calls, Workspace()
        for k in numbers:
            first = int(calls.sample[k])
            samples = self.sound.read(first, int(calls.length[k]))
            matched = self._matched(first, samples, room)
            yield self._frame(float(calls.time[k]), matched, samples)

    def _matched(
        self, first: int, samples: Float[np.ndarray, "t m"], room: Workspace
    ) -> Complex[np.ndarray, "l f c e"]:
        """Filter what came after one call, which begins with a sample; refuse no numbers."""
        on, shape = self.blocks, self.sums.gain.shape
        if isinstance(self.sums, CallOutputs):
            self.sound.refuse_odd(first, samples)
            return self.sums(samples)
        count = max((len(samples) - on.blank) // on.block, 0)
        blocks = self.sums(samples, room.array("blocks", (count, *shape)))
        if not np.isfinite(blocks).all():
            self.sound.refuse_odd(first, samples)
        out = room.array("matched", (max(count - on.pulse + 1, 0), *shape))
        return filter_blocks(blocks, pulse=on.pulse, block=1, noise_std=1.0, out=out)

    def _frame(
        self,
        time: float,
        matched: Complex[np.ndarray, "l f c e"],
        samples: Float[np.ndarray, "t m"],
    ) -> Frame:
        """Detect the echoes of one call."""
        on, around = self.blocks, None
        start = on.blank / on.rate
        if isinstance(self.sums, CallOutputs):
            around = partial(self.sums, samples, around=True)
        found = find_calls(
            matched, self.end, start=start, interval=on.interval, pulse=on.pulse, around=around
        )
        if self.own_clock.any():
            found = detections_at(found, ~self.own_clock[found.caller])
        found = with_edge_floor(found, self.config)
        scan, _ = unlabelled_scan(time, found, self.config, self.own_clock)
        return Frame(time, matched, start, on.interval, found, scan)


def sums_of(
    folder: Path, sound: Sound, about: Description, array: RecordedArray
) -> tuple[ToneSums | CallOutputs, tuple[Call, ...]]:
    """Return what sums the samples at each tone, or filters them by each call, and the calls."""
    where, calls = str(folder / FILE), about.calls(folder)
    tones = np.array([call.frequency for call in calls])
    if all(isinstance(call, ToneBurst) for call in calls):
        blocks = blocks_of(sound.rate, about.call.duration, tones, where, about.call.deaf)
        return ToneSums(blocks, array.channel), calls
    for call in calls:
        low, high = extent_of(call, sound.rate)
        if not 0.0 < low <= high < sound.rate / 2.0:
            found = f"a call of {low:.0f} to {high:.0f} Hz, the edges of its spectrum included"
            if isinstance(call, Sweep):
                begin, end = sorted((call.start, call.end))
                found = f"a sweep of {begin:g} to {end:g} Hz, whose edges reach from {low:.0f} to"
                found += f" {high:.0f} Hz, as those of a short one with an abrupt beginning do"
            expected = f"all below half the sample rate of {sound.rate:g} Hz"
            fix = "correct the one that is wrong, or fade the call's ends in and out ('taper')"
            raise refusal(where, found, expected, fix)
    blank = about.call.deaf or about.call.duration
    return CallOutputs(
        calls, sound.rate, math.ceil(blank * sound.rate - 1e-6), array.channel
    ), calls


def hear_recording(
    folder: Path,
    about: Description,
    config: Config,
    frames: Callable[[int], range],
    look: Callable[[Frame], None],
    progress: Progress | None = None,
) -> list[str]:
    """Hear a recording, call by call; return why its echoes may be wrong, a line each.

    `frames`: given the number of calls, which of them are heard; `look`: given each.
    """
    with open_sound(folder, about) as sound:
        hearing = Hearing.of(folder, sound, about, config)
        numbers = frames(hearing.calls.sample.size)
        odd = [*copied_channels(sound, hearing.calls, hearing.blocks.blank, hearing.array.used)]
        for done, frame in enumerate(hearing.frames(numbers), start=1):
            look(frame)
            if progress:
                progress("hearing", done, len(numbers))
    return odd


def log_callers(about: Description) -> list[dict[str, Any]]:
    """Return the callers, as ``log.toml`` lists them."""
    return [
        {"name": one.name, "landmark": number if one.landmark is None else one.landmark}
        | ({"moves": True} if one.moves else {})
        for number, one in enumerate(about.callers, start=1)
    ]


def _settled(config: Config, about: Description, rate: float) -> Config:
    """Return settings with what the recording says of rate, call and speed of sound."""
    assumed = config.assumed.speed_of_sound or about.speed_of_sound
    return config.model_copy(
        update={
            "emitter": config.emitter.model_copy(update={"pulse": about.call.duration}),
            "receiver": config.receiver.model_copy(update={"sample_rate": rate}),
            "assumed": config.assumed.model_copy(update={"speed_of_sound": assumed}),
        }
    )
