"""Calls that microphones anywhere hear: thresholds, bearings, delays and what they cannot tell."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom, chi2

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.acoustics.paths import callers_of
from pipistrelle.arithmetic.random_stream import complex_noise, stream_key
from pipistrelle.arrays.beamforming import bearing_bound, spread_towards
from pipistrelle.arrays.layout import Scattered, microphones_of, scattered, square_of_four
from pipistrelle.arrays.receiver import add_echo_blocks, noise_blocks, record_samples
from pipistrelle.arrays.sampling import BLOCK, blocks_to_hear, sampling
from pipistrelle.config import Config, DetectionConfig, InputError
from pipistrelle.detection.direct import Lags
from pipistrelle.detection.front_end import find_calls, front_end
from pipistrelle.detection.full_circle import circle_of, find_around
from pipistrelle.detection.matched import filter_blocks, filter_samples
from pipistrelle.detection.snapshots import detect, detector
from pipistrelle.geometry import wrap

CONFIG = Config()
SETTLED = sampling(CONFIG, callers_of(CONFIG, np.zeros(2)))
SAMPLES, PULSE = SETTLED.pulse * SETTLED.block, SETTLED.pulse
START, C, OWN, BEACON = PULSE * BLOCK, CONFIG.air.sound_speed, 0, 1
LAGS = {"start": START, "interval": BLOCK, "pulse": PULSE}
TURN = np.arange(8) * np.pi / 4


def free(places, gain_db=0.0):
    """Return microphones that hang free, at rows of x, y [m]."""
    return scattered(microphones_of([(x, y, 0.0, gain_db, "") for x, y in places]))


CIRCLE = free(0.012 * np.column_stack((np.cos(TURN), np.sin(TURN))))
WIDE = free(np.random.default_rng(5).uniform(-0.2, 0.2, (16, 2)))
LINE = free([(0.0, 0.0049 * i) for i in range(-4, 5)])


def one(delay, bearing, snr_db, caller=OWN, shift=1.0):
    """Return one arrival whose SNR, at one microphone and after the filter, is given."""
    return Arrivals(
        delay=np.array([delay]),
        level_db=np.array([snr_db - 10.0 * np.log10(SAMPLES)]),
        bearing=np.array([bearing]),
        frequency=SETTLED.tones[[caller]] * shift,
        caller=np.array([caller], dtype=np.int8),
        landmark=np.array([1]),
    )


def matched_of(arrivals, layout, key=None, blocks=60):
    if key is None:
        sums = np.zeros((blocks, 1, 2, layout.shape[1]), dtype=complex)
    else:
        sums = noise_blocks(blocks, layout, SETTLED, key)
    add_echo_blocks(sums, arrivals, layout, SETTLED)
    return filter_blocks(sums, pulse=PULSE, block=SETTLED.block, noise_std=1.0)


def found_in(matched, layout, config=CONFIG):
    return find_calls(matched, front_end(config, layout, SETTLED.tones), **LAGS)


# What is heard


@pytest.mark.parametrize("layout", [CIRCLE, WIDE, LINE], ids=["circle", "wide", "line"])
@pytest.mark.parametrize("shift", [1.0, 1.0045])
def test_block_sums_match_every_sample_at_every_microphone(layout, shift):
    sound = one(6.3217e-3, 0.7, 30.0, shift=shift)
    sums = np.zeros((40, 1, 2, layout.shape[1]), dtype=complex)
    add_echo_blocks(sums, sound, layout, SETTLED)
    samples = record_samples(40, sound, layout, SETTLED, None)
    time = np.arange(len(samples)) / SETTLED.rate
    for p, tone in enumerate(SETTLED.tones):
        turned = samples * np.exp(-2j * np.pi * tone * time)[:, None, None]
        slow = turned.reshape(40, SETTLED.block, 1, -1).sum(axis=1)
        assert np.allclose(sums[:, :, p], slow, atol=1e-9 * np.abs(slow).max())


def test_each_microphone_hears_a_wave_when_it_passes():
    early, late = free([(1.0, 0.0), (-1.0, 0.0)]), 2.0 / C
    heard = np.abs(matched_of(one(8e-3, 0.0, 40.0), early)[:, 0, OWN])
    apart = np.diff(heard.argmax(axis=0))[0] * BLOCK
    assert abs(apart - late) <= BLOCK


def test_gains_scale_the_output_and_faces_receive_nothing_from_behind():
    loud = replace(CIRCLE, amplitude=np.full(8, 2.0))
    plain, doubled = (matched_of(one(8e-3, 0.4, 20.0), of) for of in (CIRCLE, loud))
    assert np.allclose(doubled, 2.0 * plain)
    baffled = replace(CIRCLE, normal=np.array([0.4 + np.pi]))
    assert not matched_of(one(8e-3, 0.4, 20.0), baffled).any()


# The false-alarm rate


def exceeded(layout, chance, key, tests):
    """Return how many lags of noise alone, each of its own draw, are as loud as by chance."""
    config = Config(detection=DetectionConfig(false_alarm=chance))
    circle = circle_of(config, layout, 0, SETTLED.tones[:1])
    noise = complex_noise((tests, 1, layout.shape[1]), 1.0, stream_key(9, key, "noise alone"))
    position = np.zeros((2 * tests - 1, 1, layout.shape[1]), dtype=complex)
    position[::2] = noise
    still = circle._replace(position=circle.position)
    caller, _ = find_around(position, still, Lags(0.0, 1.0, 1))
    return caller.size


@pytest.mark.parametrize("layout", [CIRCLE, LINE], ids=["circle", "line"])
def test_pure_noise_exceeds_the_threshold_at_most_as_often_as_asked(layout):
    tests, chance = 20_000, 1e-2
    count = exceeded(layout, chance, 0, tests)
    assert count <= binom.ppf(1.0 - 1e-6, tests, chance)
    assert count >= binom.ppf(1e-6, tests, 0.3 * chance)


def test_the_looks_of_a_pair_are_its_phase_range():
    pair, equal = np.array([[0.0, 0.01], [0.0, -0.01]]), np.full(2, 0.5**0.5)
    around = np.linspace(-np.pi, np.pi, 10_000, endpoint=False)
    looks = 2.0 * np.pi * np.sqrt(spread_towards(around, pair, equal)).mean()
    assert looks == pytest.approx(4.0 * 0.01)


# Bearings and delays


@settings(deadline=None, max_examples=25)
@given(
    bearing=st.floats(-math.pi, math.pi, exclude_max=True),
    delay=st.floats(5e-3, 8e-3),
    seed=st.integers(0, 10**6),
)
def test_a_call_without_noise_is_found_where_and_when_it_is(bearing, delay, seed):
    places = np.random.default_rng(seed).uniform(-0.03, 0.03, (9, 2))
    layout = free(places)
    found = found_in(matched_of(one(delay, bearing, 40.0), layout), layout)
    assert found.delay.size == 1
    assert abs(wrap(found.bearing - bearing))[0] < 2e-3
    assert abs(found.delay - delay)[0] < 1e-5 + 2.0 / SETTLED.rate


def test_a_wide_array_hears_a_call_that_reaches_its_microphones_at_unlike_times():
    found = found_in(matched_of(one(7e-3, 2.0, 20.0), WIDE, key=3), WIDE)
    assert found.delay.size == 1
    assert abs(wrap(found.bearing[0] - 2.0)) < 5.0 * found.bearing_std[0] < 0.01
    assert abs(found.delay[0] - 7e-3) < 5.0 * found.delay_std[0]


def test_the_dense_engine_agrees_with_the_blocks():
    sound = one(6.81e-3, -1.1, 25.0)
    end = front_end(CONFIG, CIRCLE, SETTLED.tones)
    samples = record_samples(60, sound, CIRCLE, SETTLED, None)
    dense = filter_samples(samples, calls=SETTLED.calls, rate=SETTLED.rate, noise_std=1.0)
    lags = {"start": START, "interval": 1.0 / SETTLED.rate, "pulse": SAMPLES}
    fine, coarse = find_calls(dense, end, **lags), found_in(matched_of(sound, CIRCLE), CIRCLE)
    assert fine.bearing == pytest.approx(coarse.bearing, abs=1e-4)
    assert fine.delay == pytest.approx(coarse.delay, abs=1.0 / SETTLED.rate)


def trials(layout, snr_db, count, seed=0):
    """Return errors of bearing and delay, and the deviations that the rows state, of many calls."""
    rng, rows = np.random.default_rng(seed), []
    end = front_end(CONFIG, layout, SETTLED.tones)
    for k in range(count):
        bearing, delay = rng.uniform(-np.pi, np.pi), 6e-3 + rng.uniform(0.0, 5e-4)
        key = stream_key(seed, k, "full circle")
        found = find_calls(matched_of(one(delay, bearing, snr_db), layout, key, 50), end, **LAGS)
        if found.delay.size == 1:
            off = wrap(found.bearing[0] - bearing)
            late = found.delay[0] - delay - 0.5 / SETTLED.rate  # it begins with the next sample
            rows.append((off, late, found.bearing_std[0], found.delay_std[0]))
    return np.array(rows).T


def test_the_bound_of_a_free_line_matches_the_bound_of_a_face():
    power, wave = 9 * 100.0, 2.0 * np.pi * 35e3 / C
    kappa = wave**2 * spread_towards(np.array([0.3]), LINE.position, np.full(9, 1 / 3))[0]
    known = bearing_bound(100.0, 0.3, elements=9, spacing=0.0049, wavelength=C / 35e3)
    assert 1.0 / math.sqrt(2.0 * power * kappa) == pytest.approx(known)


def test_errors_match_the_rows_deviations():
    bearing, _, bearing_std, _ = trials(CIRCLE, 20.0, 100)
    assert len(bearing) >= 98
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], len(bearing))
    assert low < np.sum((bearing / bearing_std) ** 2) < high


@pytest.mark.slow
@pytest.mark.parametrize("snr_db", [12.0, 16.0, 20.0, 30.0])
@pytest.mark.parametrize("layout", [CIRCLE, WIDE], ids=["circle", "wide"])
def test_errors_match_the_rows_deviations_at_every_level(layout, snr_db):
    bearing, delay, bearing_std, delay_std = trials(layout, snr_db, 1500, seed=4)
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], len(bearing)) / len(bearing)
    assert 0.98 * low < np.mean((bearing / bearing_std) ** 2) < 1.1 * high
    assert np.mean((delay / delay_std) ** 2) < 1.3 * high
    assert abs(bearing.mean()) < 5.0 * bearing.std() / math.sqrt(bearing.size)


# What an array cannot tell


def test_a_free_lines_deviation_covers_its_front_back_ambiguity():
    found = found_in(matched_of(one(7e-3, 0.5, 25.0), LINE, key=1), LINE)
    mirrored = np.pi - 2.0 * 0.5
    assert found.bearing_std[0] == pytest.approx(mirrored / math.sqrt(2.0), rel=0.02)


def test_microphones_spaced_by_a_wavelength_have_deviations_covering_other_lobes():
    corners = np.array([(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)]) * C / 35e3
    unsure, sure = (
        found_in(matched_of(one(7e-3, 0.0, 25.0), of, key=1), of)
        for of in (free(corners), free(0.25 * corners))
    )
    assert unsure.bearing_std[0] > 0.5 > 10.0 * sure.bearing_std[0]


# Groups


def test_lines_on_faces_give_the_detections_of_their_layout():
    normal, along = np.array([0.0, 2.0]), (np.arange(10) - 4.5) * 0.0049
    rows = [
        (-a * np.sin(n), a * np.cos(n), 0.0, 0.0, f"face{i}")
        for i, n in enumerate(normal)
        for a in along
    ]
    lines = scattered(microphones_of(rows))
    assert np.allclose(lines.normal, normal)
    sound = one(7e-3, 0.9, 25.0)
    got = found_in(matched_of(sound, lines), lines)
    layout = replace(square_of_four(CONFIG.receiver), normal=normal)
    sums = np.zeros((60, 2, 2, 10), dtype=complex)
    add_echo_blocks(sums, sound, layout, SETTLED)
    matched = filter_blocks(sums, pulse=PULSE, block=SETTLED.block, noise_std=1.0)
    want = detect(matched, detector(CONFIG, layout, SETTLED.tones), **LAGS)
    assert sorted(got.face) == sorted(want.face) == [0, 1]
    order = np.argsort(want.face)
    assert got.bearing == pytest.approx(want.bearing[order], abs=2e-3)
    assert got.delay == pytest.approx(want.delay[order], abs=3e-5)
    assert got.bearing_std == pytest.approx(want.bearing_std[order], rel=0.05)


def test_an_off_centre_line_gives_delays_at_the_vehicles_centre():
    rows = [(0.4, (i - 4.5) * 0.0049, 0.0, 0.0, "bow") for i in range(10)]
    bow = scattered(microphones_of([*rows, (-0.4, 0.0, 0.0, 0.0, ""), (-0.4, 0.02, 0.0, 0.0, "")]))
    found = found_in(matched_of(one(7e-3, 0.5, 30.0), bow, key=2), bow)
    line = bow.name.index("bow")
    assert bow.normal[line] == pytest.approx(0.0)
    assert found.delay[found.face == line] == pytest.approx(7e-3, abs=3e-5)
    assert found.bearing[found.face == line] == pytest.approx(0.5, abs=0.01)


def test_a_face_looks_away_from_the_middle_whatever_the_order_of_its_channels():
    for sign in (1.0, -1.0):
        rows = [(-0.1, sign * y, 0.0, 0.0, "stern") for y in (-0.01, 0.0, 0.01)]
        others = [(0.3, y, 0.0, 0.0, "") for y in (-0.01, 0.01)]
        layout = scattered(microphones_of([*rows, *others]))
        assert abs(layout.normal[layout.name.index("stern")]) == pytest.approx(np.pi)


@pytest.mark.parametrize(
    ("setting", "value"), [("snapshots", "runs"), ("overlaps", "resolve")], ids=str
)
def test_settings_only_for_lines_are_refused(setting, value):
    config = Config(detection=DetectionConfig(**{setting: value}))
    with pytest.raises(InputError, match=f"detection.{setting}: found '{value}'"):
        front_end(config, CIRCLE, SETTLED.tones)


def test_microphones_spaced_by_hundreds_of_wavelengths_are_refused_as_millimetres():
    with pytest.raises(InputError, match=r"5 m, 510 waves, from the next.*millimetres"):
        front_end(CONFIG, free([(0.0, 0.0), (5.0, 0.0)]), SETTLED.tones)


def test_a_single_microphone_is_refused_for_lack_of_direction():
    face = [(0.0, 0.005 * i, 0.0, 0.0, "bow") for i in range(3)]
    for name, words in {"": "that hangs free", "stern": "on face stern"}.items():
        with pytest.raises(InputError, match=f"one microphone {words}"):
            scattered(microphones_of([*face, (-0.1, 0.0, 0.0, 0.0, name)]))


# Direct calls


def test_the_direct_call_begins_when_it_begins():
    rng, errors = np.random.default_rng(2), []
    for k in range(30):
        delay = math.ceil((10e-3 + rng.uniform(0.0, 4e-4)) * SETTLED.rate) / SETTLED.rate
        sound = one(delay, rng.uniform(-3.0, 3.0), 25.0, caller=BEACON)
        found = found_in(matched_of(sound, CIRCLE, key=k, blocks=80), CIRCLE)
        direct = found.direct
        assert direct.detection[BEACON] >= 0 > direct.detection[OWN]
        errors.append((direct.delay[BEACON] - delay, direct.delay_std[BEACON]))
    error, std = np.array(errors).T
    assert np.sqrt(np.mean(error**2)) < 0.15 * BLOCK
    assert np.mean((error / std) ** 2) < 4.0


def test_a_frame_lasts_until_the_farthest_microphone_has_heard():
    sound = one(0.1, 0.0, 20.0)
    far = free([(-3.43, 0.0), (0.0, 0.0)])
    more = blocks_to_hear(sound, SETTLED, far) - blocks_to_hear(sound, SETTLED)
    assert more == pytest.approx(0.01 / BLOCK, abs=1)
    assert isinstance(far, Scattered)
