"""Spoiled sound recordings, for `pipistrelle hear`, and for `slam` what it makes of them."""

import struct
from pathlib import Path

import numpy as np
from numpy.random import Generator

from fuzz.judging import Tried, contents, faults_of, lost
from fuzz.logs import Files, changed, lay
from fuzz.mutations import cut_off, emptied, flipped, one_of
from fuzz.running import command
from reference.sounds import foreign

ODD = (np.nan, np.inf, -np.inf, 1e38, 3e38, 1e30, 1e-40, 0.0, 5.0)
FIELDS = (0, 1, 2, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 40, 1024, 192_000)
MANNERS = (
    (),
    (),
    ("--check",),
    ("--frames", "0:2"),
    ("--frames", "1:"),
    ("--detection.false-alarm", "1e-2"),
)
HEADER = 100
"""Bytes of a sound file that hold its header, and a little more."""


def prepare(base: Path) -> dict[str, Files]:
    """Write the sound recordings; return the files of each."""
    made = {}
    for name in ("told", "leak", "period"):
        folder = foreign(
            base / name, rate=48_000, frequency=12e3, duration=1e-3, calls=(500, 5000, 9500)
        )
        if name != "told":
            (folder / "calls.csv").unlink()
        if name == "period":
            about = (folder / "recording.toml").read_text()
            more = "period = 0.09375\nfirst = 0.0104166666667\n[log]"
            (folder / "recording.toml").write_text(about.replace("[log]", more))
        made[name] = {file.name: file.read_bytes() for file in sorted(folder.iterdir())}
    return made


def header_odd(rng: Generator, data: bytes) -> tuple[str, bytes]:
    """Put an odd number into the header."""
    at, size = int(rng.integers(4, HEADER)), one_of(rng, ("<H", "<I", "<Q"))
    value = one_of(rng, FIELDS) % (1 << 8 * struct.calcsize(size))
    field = struct.pack(size, value)
    return f"byte {at} on is {value}", data[:at] + field + data[at + len(field) :]


def header_flipped(rng: Generator, data: bytes) -> tuple[str, bytes]:
    """Flip bits of the header."""
    told, head = flipped(rng, data[:HEADER])
    return f"header: {told}", head + data[HEADER:]


def samples_odd(rng: Generator, data: bytes) -> tuple[str, bytes]:
    """Put odd numbers among the samples: one, a few in a row, or all."""
    samples = np.frombuffer(data[HEADER:][: (len(data) - HEADER) // 4 * 4], dtype="<f4").copy()
    value, count = one_of(rng, ODD), one_of(rng, (1, 100, 16 * 2000, samples.size))
    at = int(rng.integers(max(samples.size - count, 0) + 1))
    samples[at : at + count] = value
    return f"{count} samples are {value}", data[:HEADER] + samples.tobytes()


WAYS = (header_odd, header_odd, header_flipped, samples_odd, samples_odd, cut_off, emptied)


def attempt(rng: Generator, place: Path, sound: dict[str, Files]) -> Tried:
    """Spoil a recording, have it heard, and what was heard solved."""
    name = one_of(rng, [*sound])
    files, words = dict(sound[name]), []
    for _ in range(int(rng.integers(1, 3))):
        tape = files.get("tape.wav")
        if rng.random() < 0.5 and isinstance(tape, bytes):
            what, data = one_of(rng, WAYS)(rng, tape)
            what, files = f"tape.wav: {what}", files | {"tape.wav": data}
        elif texts := {one: data for one, data in files.items() if one != "tape.wav"}:
            what, texts = changed(rng, texts)
            files = ({"tape.wav": tape} if tape is not None else {}) | texts
        else:
            break
        words.append(what)
    lay(files, place / "in")
    before = contents(place / "in")
    line = ("hear", "in", "--quiet", "-o", "out", *one_of(rng, MANNERS))
    ending = command(place, *line)
    faults = faults_of(ending, ["in", *sound["told"]])
    faults += lost(before, contents(place / "in"), "a file of the recording")
    if ending.how == "returned" and ending.found == 0 and "--check" not in line:
        manner = ("--association.method", "marginal", "--filter", "ekf", "--quiet", "-o", "solved")
        solved = command(place, "slam", "out", *manner)
        faults += faults_of(solved, ["out", "measurements.csv", "log.toml", "odometry.csv"])
        if solved.how == "returned" and solved.found == 2:
            faults.append(f"slam refuses what hear made: {solved.said[:200]}")
        return Tried(told=tuple(words), endings=(ending, solved), faults=tuple(faults))
    return Tried(told=tuple(words), endings=(ending,), faults=tuple(faults))
