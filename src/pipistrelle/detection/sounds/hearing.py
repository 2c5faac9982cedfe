"""Sound in: a recording is heard call by call, by the front end of the simulation, into a log."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex

from pipistrelle.config import Config
from pipistrelle.detection.echoes import unlabelled_scan, with_edge_floor
from pipistrelle.detection.front_end import FrontEnd, find_calls, front_end
from pipistrelle.detection.matched import Workspace, filter_blocks
from pipistrelle.detection.scans import Scan
from pipistrelle.detection.snapshots import Detections, detections_at
from pipistrelle.detection.sounds.calls import Calls, calls_of
from pipistrelle.detection.sounds.description import Description
from pipistrelle.detection.sounds.noise_level import set_noise
from pipistrelle.detection.sounds.recorded_array import FILE as ARRAY
from pipistrelle.detection.sounds.recorded_array import RecordedArray, recorded_array
from pipistrelle.detection.sounds.sound_file import Sound, open_sound
from pipistrelle.detection.sounds.tone_sums import Blocks, ToneSums, blocks_of

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
    sums: ToneSums
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
        tones = np.array([about.call.frequency, *(one.frequency for one in about.callers)])
        where = str(folder / "recording.toml")
        blocks = blocks_of(sound.rate, about.call.duration, tones, where, about.call.deaf)
        calls = calls_of(folder, about, sound, blocks)
        sums = ToneSums(blocks, array.channel)
        set_noise(sums, sound, calls, folder)
        settled = _settled(config, about)
        return cls(
            folder=folder,
            about=about,
            sound=sound,
            array=array,
            blocks=blocks,
            calls=calls,
            sums=sums,
            config=settled,
            end=front_end(settled, array.layout, tones, str(folder / ARRAY)),
            own_clock=np.array([False, *(one.own_clock for one in about.callers)]),
        )

    def frames(self, numbers: Sequence[int]) -> Iterator[Frame]:
        """Hear what came after some of the calls, numbered from 0 on."""
        on, calls = self.blocks, self.calls
        room = Workspace()
        for k in numbers:
            first = int(calls.sample[k])
            samples = self.sound.read(first, int(calls.length[k]))
            count = max((len(samples) - on.blank) // on.block, 0)
            blocks = self.sums(samples, room.array("blocks", (count, *self.sums.gain.shape)))
            if not np.isfinite(blocks).all():
                self.sound.refuse_odd(first, samples)
            lags = (max(count - on.pulse + 1, 0), *self.sums.gain.shape)
            matched = filter_blocks(
                blocks, pulse=on.pulse, block=1, noise_std=1.0, out=room.array("matched", lags)
            )
            yield self._frame(float(calls.time[k]), matched)

    def _frame(self, time: float, matched: Complex[np.ndarray, "l f c e"]) -> Frame:
        """Detect the echoes of one call."""
        on = self.blocks
        start = on.blank / on.rate
        found = find_calls(matched, self.end, start=start, interval=on.interval, pulse=on.pulse)
        if self.own_clock.any():
            found = detections_at(found, ~self.own_clock[found.caller])
        found = with_edge_floor(found, self.config)
        scan, _ = unlabelled_scan(time, found, self.config, self.own_clock)
        return Frame(time, matched, start, on.interval, found, scan)


def hear_recording(
    folder: Path,
    about: Description,
    config: Config,
    frames: Callable[[int], range],
    look: Callable[[Frame], None],
    progress: Progress | None = None,
) -> None:
    """Hear a recording, call by call.

    `frames`: given the number of calls, which of them are heard; `look`: given each.
    """
    with open_sound(folder, about) as sound:
        hearing = Hearing.of(folder, sound, about, config)
        numbers = frames(hearing.calls.sample.size)
        for done, frame in enumerate(hearing.frames(numbers), start=1):
            look(frame)
            if progress:
                progress("hearing", done, len(numbers))


def log_callers(about: Description) -> list[dict[str, Any]]:
    """Return the callers, as ``log.toml`` lists them."""
    return [
        {"name": one.name, "landmark": number if one.landmark is None else one.landmark}
        | ({"moves": True} if one.moves else {})
        for number, one in enumerate(about.callers, start=1)
    ]


def _settled(config: Config, about: Description) -> Config:
    """Return settings with what the recording says of the call and the speed of sound."""
    assumed = config.assumed.speed_of_sound or about.speed_of_sound
    return config.model_copy(
        update={
            "emitter": config.emitter.model_copy(update={"pulse": about.call.duration}),
            "assumed": config.assumed.model_copy(update={"speed_of_sound": assumed}),
        }
    )
