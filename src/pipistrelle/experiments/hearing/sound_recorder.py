"""Sound recordings of simulated missions: the microphones' samples, written frame by frame."""

import math
import shutil
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.acoustics.call import RecordedCall, settings_of
from pipistrelle.acoustics.paths import VEHICLE, Caller, moves
from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.arrays.layout import array_text, layout_of, microphones_in
from pipistrelle.arrays.receiver import InBands, real_samples
from pipistrelle.arrays.sampling import blocks_to_hear, sampling
from pipistrelle.config import SQUARE, Config, InputError
from pipistrelle.detection.sounds.calls import FILE as CALLS
from pipistrelle.detection.sounds.sound_file import ARRAY_FILE as ARRAY
from pipistrelle.detection.sounds.sound_file import FILE as DESCRIPTION
from pipistrelle.experiments.hearing.scenario import Scenario, caller_labels
from pipistrelle.files import OwnFiles, PiecesFile, make_folder, remove_empty, shipped_text
from pipistrelle.text_tables import table_text

SOUND_FILE = "recording.wav"
HEADROOM = 4.0
"""Largest amplitude that the file can hold, in units of the loudest call's at 1 m."""


@dataclass(kw_only=True)
class SoundRecorder:
    """Writer of the microphones' samples into a WAV file, frame by frame."""

    own: OwnFiles
    config: Config
    frames: range
    """Indices of the recorded frames, from 0 on."""
    bits: int = 32
    """32: floats; 16: integers."""
    clipped: int = 0
    """Number of samples that exceeded the largest amplitude of the file."""
    late: int = 0
    """Number of frames with arrivals after the next call, which are not recorded."""
    _file: PiecesFile | None = None
    _made: list[Path] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Compute the array's layout, the period and the first sample of each frame."""
        setup = self.config.scenario
        self.layout = layout_of(self.config)
        self.channels = math.prod(self.layout.shape)
        self.period = setup.steps_per_frame * setup.step
        rate = self.config.receiver.sample_rate
        numbers = np.arange(len(self.frames) + 1)
        self.first = np.rint(numbers * self.period * rate).astype(np.int64)
        """First sample of each frame, and one after the last of all."""

    @property
    def size(self) -> int:
        """Size of all recorded samples in bytes."""
        return int(self.first[-1]) * self.channels * self.bits // 8

    def check_room(self) -> None:
        """Raise if the disk has too little free space for the recording."""
        places = (self.own.folder, *self.own.folder.absolute().parents)
        there = next(place for place in places if place.exists())
        free = shutil.disk_usage(there).free
        if self.size > free:
            why = f"found {free / 1e9:.1f} GB free at {there}, expected {self.size / 1e9:.1f} GB"
            raise InputError(f"--save-sound: {why}; keep fewer frames (--frames A:B) or 16 bits")

    def begin(self, scenario: Scenario) -> None:
        """Create the sound file with its header; raise if the settings give no real samples."""
        settled = sampling(self.config, scenario.callers)
        for caller, tone in zip(scenario.callers, settled.tones, strict=True):
            if tone >= settled.rate / 2.0:
                why = f"found {tone:g} Hz, which real samples at {settled.rate:g} Hz do not hold"
                where = f"{caller.key or caller.name}.frequency"
                raise InputError(f"{where}: {why}; expected less than half of that")
        self.sampling = settled
        loudest = max(10.0 ** (max(one.level_db for one in scenario.callers) / 20.0), 1.0)
        self.scale = HEADROOM * max(loudest, settled.noise_std)
        self.leak = 10.0 ** (scenario.callers[VEHICLE].level_db / 20.0)
        self._made = make_folder(self.own.folder)
        self._file = PiecesFile(self.own.folder / SOUND_FILE)
        self._file.write(wav_header(self.size, self.channels, settled.rate, self.bits))

    def keep(self, number: int, arrivals: Arrivals, sums: np.ndarray | InBands) -> None:
        """Write the samples of a frame if its number, from 1 on, is in the recorded range."""
        index = number - 1
        if index not in self.frames or self._file is None:
            return
        place, settled = index - self.frames.start, self.sampling
        length = int(self.first[place + 1] - self.first[place])
        heard = blocks_to_hear(arrivals, settled, self.layout)
        self.late += heard > length // settled.block - settled.pulse
        rng = np.random.default_rng(stream_key(self.config.seed, 0, "other frequencies", number))
        samples = real_samples(
            sums, arrivals, self.layout, settled, length, rng, leak=self.leak
        ) / np.float32(self.scale)
        if self.bits == 16:
            self.clipped += int(np.count_nonzero(np.abs(samples) > 1.0))
            samples = np.rint(samples.clip(-1.0, 1.0) * 32767.0)
        self._file.write(samples.astype("<f4" if self.bits == 32 else "<i2").tobytes())

    def finish(self) -> PiecesFile:
        """Close the sound file and return it."""
        assert self._file is not None
        self._file.close()
        return self._file

    def discard(self) -> None:
        """Delete the sound file, unless it has been moved to its final place."""
        if self._file is not None:
            self._file.discard()
            remove_empty(self._made)

    def notes(self) -> list[str]:
        """Return warnings about clipped samples and about arrivals after the next call."""
        notes = []
        if self.clipped:
            notes.append(
                f"--save-sound: {self.clipped} samples were clipped at 16 bits; keep 32 bits"
            )
        if self.late:
            notes.append(
                f"--save-sound: in {self.late} frames something was heard after the vehicle's next "
                "call, which the recording does not hold"
            )
        return notes

    def files(self, scenario: Scenario, log: dict[str, Any]) -> dict[str, str | bytes | PiecesFile]:
        """Return the recording's files except odometry and truth; `log` describes the log."""
        import tomli_w

        calls = {
            _call_file(one): wav_header(4 * one.sound.samples.size, 1, one.sound.rate, 32)
            + one.sound.samples.astype("<f4").tobytes()
            for one in scenario.callers
            if isinstance(one.sound, RecordedCall)
        }
        time = (np.arange(len(self.frames)) + self.frames.start + 1) * self.period
        return calls | {
            SOUND_FILE: self.finish(),
            ARRAY: array_text(microphones_in(self.config)),
            CALLS: table_text({"sample": self.first[:-1], "time": time}),
            "README.md": shipped_text("experiments/hearing/sound_readme.md"),
            DESCRIPTION: tomli_w.dumps(self._description(scenario) | {"log": log}),
        }

    def _description(self, scenario: Scenario) -> dict[str, Any]:
        """Return the content of ``recording.toml`` as a table, without its section ``log``."""
        config, labels = self.config, caller_labels(scenario).tolist()
        own, *others = scenario.callers
        medium = config.medium.model_dump(exclude_none=True)
        medium |= {"speed_of_sound": config.medium.sound_speed}  # also if it is derived
        return {
            "format": 1,
            "sound": [SOUND_FILE],
            "sample_rate": self.sampling.rate,
            "samples": int(self.first[-1]),
            "start": (self.frames.start + 1) * self.period,
            "scale": self.scale * (1.0 if self.bits == 32 else 32768.0 / 32767.0),
            "speed_of_sound": config.assumed_sound_speed,
            "one_centre": config.receiver.array == SQUARE,
            "medium": {"name": config.scenario.medium, **medium},
            "call": {
                "frequency": own.frequency,
                "duration": config.emitter.call_duration,
                "level_db": own.level_db,
            }
            | _told(own),
            "callers": [
                {
                    "name": one.name,
                    "frequency": one.frequency,
                    "level_db": one.level_db,
                    "landmark": label,
                    "moves": moves(one),
                    "own_clock": one.calls is not None,
                }
                | _told(one)
                for one, label in zip(others, labels[1:], strict=True)
            ],
        }


def _call_file(caller: Caller) -> str:
    """Return the name of the sound file for a caller's recorded call."""
    return f"call_{caller.name}.wav"


def _told(caller: Caller) -> dict[str, Any]:
    """Return the settings of a caller's call or, for a recorded call, its file name."""
    recorded = isinstance(caller.sound, RecordedCall)
    return {"call": _call_file(caller)} if recorded else settings_of(caller.sound)


def wav_header(size: int, channels: int, rate: float, bits: int) -> bytes:
    """Return the header of a WAV file, or of an RF64 file if 32 bits cannot hold the size.

    `size` is the bytes of the samples; `rate` [Hz] is rounded; `bits` is 32 for floats, 16 for
    integers.

    Sources: Microsoft, Multiple Channel Audio Data and WAVE Files (2007); EBU Tech 3306 (RF64).
    """
    frame, count = channels * bits // 8, size // (channels * bits // 8)
    kind = 3 if bits == 32 else 1
    guid = struct.pack("<H", kind) + bytes.fromhex("000000001000800000aa00389b71")
    fmt = struct.pack("<HHIIHH", 0xFFFE, channels, round(rate), round(rate) * frame, frame, bits)
    fmt += struct.pack("<HHI", 22, bits, 0) + guid
    fact = struct.pack("<I", min(count, 2**32 - 1))
    parts = ((b"fmt ", fmt), (b"fact", fact))
    chunks = b"".join(name + struct.pack("<I", len(data)) + data for name, data in parts)
    if size <= 2**32 - 2**16:  # sizes of 32 bits hold the header as well
        head = b"RIFF" + struct.pack("<I", 4 + len(chunks) + 8 + size) + b"WAVE"
        return head + chunks + b"data" + struct.pack("<I", size)
    whole = 4 + 36 + len(chunks) + 8 + size
    sizes = b"ds64" + struct.pack("<IQQQI", 28, whole, size, count, 0)
    head = b"RF64" + struct.pack("<I", 2**32 - 1) + b"WAVE" + sizes
    return head + chunks + b"data" + struct.pack("<I", 2**32 - 1)
