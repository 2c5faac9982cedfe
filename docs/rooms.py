"""Print the tables of `arrays.md` anew: `.venv/bin/python docs/rooms.py`; `docs/rooms.py sweeps`
prints that of `calls.md`.

Errors of bearings and delays from afar, without walls, in units of their bounds. And: a call from
anywhere in a room of 9 by 8 m reaches a circle of eight microphones, and its walls throw it back
three times at most. pyroomacoustics says what is recorded, and `pipistrelle.hear` what is heard.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

PLACES, SNR_DB, ORDER = 400, 20.0, 3
NEAREST, MARGIN, SECONDS = 1.5, 0.3, 0.08
"""Least distance of the source from array and walls [m]; how long is recorded [s]."""
WALLS = {"none": None, "soft (take 80 %)": 0.8, "take 40 %": 0.4, "hard (take 10 %)": 0.1}
GATE_S, GATE = 7e-4, 0.1
"""A row this near to an image of the source, in time [s] and bearing [rad], is of it."""


def anywhere(rng):
    """Draw bearing and distance of a source in the room."""
    from reference.rooms import CENTRE, ROOM

    while True:
        x, y = rng.uniform(MARGIN, ROOM - MARGIN) - CENTRE
        if np.hypot(x, y) > NEAREST:
            return np.arctan2(y, x), np.hypot(x, y)


def told(absorption):
    """Return rows after a call, the share of no image, and errors of the first row, squared."""
    from pipistrelle.geometry import wrap
    from reference.rooms import ARRAYS, RATE, C, heard, noise_for, record, rows_of, scattered

    layout, rng = scattered(ARRAYS["circle"]), np.random.default_rng(5)
    places, images, frames = [anywhere(rng) for _ in range(PLACES)], [], []

    def sounds():
        for place in places:
            quiet, _ = heard(layout, *place)
            more = {"absorption": absorption, "order": ORDER, "seconds": SECONDS}
            samples, mirrored = heard(layout, *place, **more)
            images.append(mirrored.T)
            yield samples / noise_for(quiet, SNR_DB)

    with TemporaryDirectory() as folder:
        tape = record(Path(folder) / "tape", "circle", sounds(), 1.0, rng)
        rows, call = rows_of(tape, PLACES)
    for k, (x, y) in enumerate(images):
        (bearing, distance), one = places[k], rows.filter(call == k)
        delay, heard_at = 2.0 * one["range"].to_numpy() / C + 0.5 / RATE, one["bearing"].to_numpy()
        late = np.abs(delay[:, None] - np.hypot(x, y) / C) < GATE_S
        near = np.abs(wrap(heard_at[:, None] - np.arctan2(y, x))) < GATE
        none = np.count_nonzero(~(late & near).any(axis=1))
        first = np.argmin(delay)
        off, after = wrap(heard_at[first] - bearing), delay[first] - distance / C
        std = one["bearing_std"][int(first)]
        frames.append((delay.size, none, off**2, (off / std) ** 2, after**2))
    return np.mean(frames, axis=0)


def in_bounds():
    """Print how large errors are beside their bounds, by array and level."""
    from reference.rooms import ARRAYS, errors

    print("| array | dB | bearing, in bounds | as stated | delay, in bounds | as stated |")
    print("|---|--:|--:|--:|--:|--:|")
    for name in ARRAYS:
        for snr_db in (10.0, 20.0, 30.0):
            with TemporaryDirectory() as folder:
                off = errors(Path(folder) / "tape", name, snr_db, 60, 10)
            found = np.sqrt(np.mean(off**2, axis=1))
            across, late, across_stated, late_stated = (f"{one:.2f}" for one in found)
            print(f"| {name} | {snr_db:g} | {across} | {across_stated} | {late} | {late_stated} |")
    print()


def sweeps():
    """Print errors of bearing and range of a sweep, in units of their bounds."""
    from reference.rooms import errors

    levels = (10.0, 15.0, 20.0, 25.0, 30.0)
    print("| array | " + " | ".join(f"{one:g} dB" for one in levels) + " |")
    print("|---|" + "--:|" * len(levels))
    for name in ("square", "circle", "cross"):
        cells = []
        for snr_db in levels:
            with TemporaryDirectory() as folder:
                off = errors(Path(folder) / "tape", name, snr_db, 60, 5, call="sweep")
            across, late, *_ = np.sqrt(np.mean(off**2, axis=1))
            cells.append(f"{across:.2f}, {late:.2f}")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def among_walls():
    """Print a row for each kind of walls."""
    print("| walls | rows | of no image | first row's bearing, rms | in deviations | delay, rms |")
    print("|---|---|---|---|---|---|")
    for name, absorption in WALLS.items():
        rows, none, off, share, after = told(absorption)
        first = f"{np.degrees(off**0.5):.2f}° | {share**0.5:.1f} | {1e6 * after**0.5:.0f} µs"
        print(f"| {name} | {rows:.1f} | {none / rows:.0%} | {first} |")


if __name__ == "__main__":
    if sys.argv[1:] == ["sweeps"]:
        sys.exit(sweeps())
    in_bounds()
    among_walls()
