"""How near excess paths of isolated echoes come to the least error that any estimator has."""

import math
from functools import cache

import numpy as np
import pytest

from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import BLOCK
from pipistrelle.detection.front_end import average_faces
from pipistrelle.detection.noise import EXCESS_PATH_FLOOR
from pipistrelle.detection.scans import UNLABELLED
from reference.delays import cramer_rao, least_mean_square
from reference.echoes import BEACON, PULSE, SETTLED, SQUARE, C, found_in, matched_of, sounds

ELEMENTS = SQUARE.position.size
DIRECT, ECHO = 51, 4
FIRST, APART, BLOCKS = 32, 34, 75
"""Blocks until the direct call, from it to the echo, and of the recording."""
OVER_DB = 25.0
"""How much louder the direct call is than the echo."""
FEW, MANY = 1500, 20000
LEVELS = [8.0, 10.0, 13.0, 16.0, 20.0, 25.0, 30.0]
NEAR = 1.10
SIGMAS, SPREAD = 3.5, 2.2
"""Of the mean of so many squares, each of them with that deviation: a normal one has 1.4."""


def excess_path_off(snr_db, key, heels=None):
    """How much too long an excess path is thought, and its told deviation [m]; NaN of none.

    A second echo may be so many blocks behind the first.
    """
    rng = np.random.default_rng([int(snr_db), key])
    direct = (FIRST + rng.random()) * BLOCK
    echo = direct + (APART + rng.random()) * BLOCK
    times = [direct, echo] if heels is None else [direct, echo, echo + heels * BLOCK]
    key = stream_key(7, key, f"excess_paths {snr_db}")
    levels = snr_db + OVER_DB * (np.arange(len(times)) == 0)
    arrivals = sounds(times, rng.uniform(-0.15, 0.15, len(times)), levels, BEACON)
    found = found_in(matched_of(arrivals, key=key, blocks=BLOCKS))
    here = (found.face == 0) & (np.abs(found.delay - echo) < 0.5 * PULSE * BLOCK)
    label = np.where(here, ECHO, np.where(found.delay < direct + BLOCK, DIRECT, UNLABELLED))
    frame = average_faces(0.5, found, label, averaging="plain", speed_of_sound=C)
    row = np.flatnonzero(frame.rows.landmark == ECHO)
    if row.size == 0:
        return np.nan, np.nan
    e, std = frame.rows.excess_path[row[0]], frame.rows.excess_path_std[row[0]]
    return e - C * (echo - direct), math.sqrt(std**2 - EXCESS_PATH_FLOOR**2)


@cache
def alone(snr_db, count, heels=None):
    """Errors of excess paths and their told deviations [m], and how many echoes had none."""
    rows = np.array([excess_path_off(snr_db, key, heels) for key in range(count)])
    heard = np.isfinite(rows[:, 0])
    return *rows[heard].T, count - int(heard.sum())


def bound(snr_db, of):
    """The rms of an excess path [m] that a bound of the delays' variances leaves.

    A call is heard from the next sample on: each is late by up to one, and nothing tells.
    """
    power = ELEMENTS * 10.0 ** (0.1 * np.array([snr_db, snr_db + OVER_DB]))
    sampled = SETTLED.block**-2.0 / 6.0
    return C * BLOCK * np.sqrt(sum(of(p, PULSE) for p in power) + sampled)


def ratio(off, snr_db, of=least_mean_square):
    """Root mean square of errors in units of a bound, and what it may be by so few draws."""
    return np.sqrt(np.mean(off**2)) / bound(snr_db, of)


def is_near(off, snr_db):
    """Whether errors are within a tenth of the least, as far as so many of them tell."""
    chance = 0.5 * SIGMAS * SPREAD / np.sqrt(off.size)
    return 1.0 - chance < ratio(off, snr_db) < NEAR + chance


# The bounds


def test_the_cramer_rao_bound_follows_from_the_slopes_of_the_call():
    power, step = 300.0, 1e-6
    for q in (0.1, 0.5, 0.8):
        before, there, after = call_at(q - step), call_at(q), call_at(q + step)
        slope = (after - before) / (2.0 * step)
        across = slope - there * (there @ slope) / (there @ there)  # what a level does not explain
        information = 2.0 * power / PULSE * (across @ across)
        assert cramer_rao(power, PULSE, q) == pytest.approx(1.0 / information, rel=1e-6)


def call_at(q):
    """Weights of the blocks of a call that begins a share into one."""
    return np.array([1.0 - q, *np.ones(PULSE - 1), q])


def test_the_least_mean_square_is_the_cramer_rao_bound_of_loud_calls_and_more_of_faint_ones():
    shares = [
        least_mean_square(p, PULSE) / cramer_rao(p, PULSE)
        for p in ELEMENTS * 10.0 ** (0.1 * np.array([8.0, 13.0, 20.0, 35.0]))
    ]
    assert shares[3] == pytest.approx(1.0, abs=0.05)
    assert shares[0] > 1.5, "1.3 as an rms: nobody comes within a tenth of Cramer and Rao there"
    assert shares[0] > shares[1] > shares[2] > shares[3]


def test_the_least_mean_square_of_an_inaudible_call_is_uniform():
    assert least_mean_square(1e-9, PULSE) == pytest.approx(8.0**2 / 12.0, rel=0.01)


# Excess paths


@pytest.mark.parametrize("snr_db", [8.0, 13.0, 20.0, 30.0])
def test_an_excess_path_is_within_a_tenth_of_the_least_error(snr_db):
    off, _, missed = alone(snr_db, FEW)
    assert missed < 0.01 * FEW
    assert is_near(off, snr_db)


@pytest.mark.slow
@pytest.mark.parametrize("snr_db", LEVELS)
def test_every_excess_path_is_within_a_tenth_of_the_least_error(snr_db):
    off, std, missed = alone(snr_db, MANY)
    regular = ratio(off, snr_db, cramer_rao)
    rms, told = (1e3 * np.sqrt(np.mean(x**2)) for x in (off, std))
    print(
        f"{snr_db:g} dB: {rms:.1f} mm, {ratio(off, snr_db):.2f} times the least, {regular:.2f} "
        f"times Cramer-Rao; told {told:.1f} mm; {missed} missed"
    )
    assert missed < 0.01 * MANY
    assert is_near(off, snr_db)
    assert regular > 1.0


@pytest.mark.parametrize("snr_db", [8.0, 20.0, 30.0])
def test_an_excess_path_from_a_whole_block_on_is_not_within_a_tenth(snr_db):
    off, *_ = alone(snr_db, FEW)
    assert is_near(off, snr_db)
    rng, block = np.random.default_rng(1), C * BLOCK
    begun = rng.uniform(0.0, block, off.size)  # where in a block
    rounded = block * np.round((begun + off) / block) - begun
    assert not is_near(rounded, snr_db)


@pytest.mark.parametrize("snr_db", [8.0, 20.0, 30.0])
def test_an_excess_path_of_an_echo_with_another_at_its_heels_is_not_within_a_tenth(snr_db):
    off, *_ = alone(snr_db, 200, heels=3.0)
    assert not is_near(off, snr_db)
