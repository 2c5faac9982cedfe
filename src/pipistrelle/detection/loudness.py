"""Loudness: at which lags of a face's tone a snapshot is taken."""

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.jit import Whole, kernel, no_alloc

_CHUNK = 256


@kernel
def energy_of(parts: Float[np.ndarray, " i"], elements: Whole) -> Float[np.ndarray, " t"]:
    """Sum squares over the elements of every output, real and imaginary parts neighbours."""
    energy = np.empty(parts.size // (2 * elements))
    square = np.empty(_CHUNK * elements)  # stays in the cache
    for start in range(0, energy.size, _CHUNK):
        done = energy[start : start + _CHUNK]
        part = parts[2 * elements * start :]
        for i in range(done.size * elements):
            square[i] = part[2 * i] * part[2 * i] + part[2 * i + 1] * part[2 * i + 1]
        for g in range(done.size):
            total = 0.0
            for e in range(elements):
                total += square[g * elements + e]
            done[g] = total
    return energy


@kernel
def candidates(
    energy: Float[np.ndarray, " t"], threshold: float, row: Whole
) -> Int[np.ndarray, " k"]:
    """Find the tests over the threshold that beat both their neighbours a row away.

    Every test is written and few are kept: a branch on each could not be predicted.
    """
    test, count, kept = np.empty(energy.size + 1, dtype=np.int64), 0, 0
    for t in range(energy.size):
        test[count] = t
        count += energy[t] > threshold
    for k in range(count):
        t = test[k]
        before = energy[t - row] if t >= row else -1.0
        after = energy[t + row] if t + row < energy.size else -1.0
        test[kept] = t
        kept += (energy[t] > before) & (energy[t] >= after)
    return test[:kept]


@no_alloc
def _is_loudest(
    energy: Float[np.ndarray, " t"], test: Whole, row: Whole, reach: Whole, floor: float
) -> bool:
    """Tell whether a lag is the loudest within a reach, or until the energy falls low enough.

    A row of tests is a lag's: its neighbour in time is a row away, its other tones next to it.
    """
    level, size = energy[test], energy.size
    for away in range(row, (reach + 1) * row, row):
        if test < away or energy[test - away] <= floor:
            break
        if energy[test - away] >= level:
            return False
    for away in range(row, (reach + 1) * row, row):
        if test + away >= size or energy[test + away] <= floor:
            break
        if energy[test + away] > level:
            return False
    return True


@no_alloc
def is_leakage(
    energy: Float[np.ndarray, " t"],
    test: Whole,
    row: Whole,
    tones: Whole,
    pulse: Whole,
    leakage: float,
) -> bool | np.bool_:
    """Tell whether the energy of a tone is explained by leakage from another tone nearby."""
    own, strongest = test % tones, 0.0
    for p in range(tones):
        if p != own:
            other = test - own + p
            for away in range(-pulse * row, (pulse + 1) * row, row):
                if 0 <= other + away < energy.size:
                    strongest = max(strongest, energy[other + away])
    return energy[test] <= leakage * strongest


@no_alloc
def _run_of(
    energy: Float[np.ndarray, " t"], test: Whole, row: Whole, floor: float
) -> tuple[Whole, Whole]:
    """Return the first lag, and the one after the last, of a test's run above a level."""
    first = last = test
    while first >= row and energy[first - row] > floor:
        first -= row
    while last + row < energy.size and energy[last + row] > floor:
        last += row
    return first // row, last // row + 1


@no_alloc
def snapshot(
    energy: Float[np.ndarray, " t"],
    test: Whole,
    row: Whole,
    tones: Whole,
    pulse: Whole,
    runs: bool,
    threshold: float,
    leakage: float,
) -> tuple[Whole, Whole]:
    """Return the first lag, and the one after the last, of a test's snapshot; equal if none.

    A run may hold other echoes beside what leaks into it: each of its peaks is asked, at its lag.
    """
    if runs:
        if _is_loudest(energy, test, row, energy.size, threshold):
            return _run_of(energy, test, row, threshold)
    elif _is_loudest(energy, test, row, pulse // 2, -1.0) and not is_leakage(
        energy, test, row, tones, pulse, leakage
    ):
        return test // row, test // row + 1
    return 0, 0
