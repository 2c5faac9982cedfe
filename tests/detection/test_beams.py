"""Calls that beams find: thresholds, bearings, delays, what loud ones leave and cannot tell."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom, chi2

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.acoustics.call import Sweep, ToneBurst, band_of, carrier_of, cross_talk, replica
from pipistrelle.acoustics.paths import callers_of
from pipistrelle.arithmetic.random_stream import complex_noise, stream_key
from pipistrelle.arrays.beamforming import bearing_bound, spread_towards
from pipistrelle.arrays.layout import Layout, Scattered, microphones_of, scattered, square_of_four
from pipistrelle.arrays.receiver import add_echo_blocks, noise_blocks
from pipistrelle.arrays.sampling import BLOCK, blocks_to_hear, sampling
from pipistrelle.config import Config, DetectionConfig, InputError
from pipistrelle.detection.beams import _loudness, edge_around, find_wide, wide_of
from pipistrelle.detection.direct import Lags
from pipistrelle.detection.front_end import find_calls, front_end
from pipistrelle.detection.matched import BandFilters
from pipistrelle.detection.snapshots import detect, detector
from pipistrelle.geometry import wrap
from reference.echoes import BEACON, CONFIG, LAGS, OWN, SETTLED, C, filtered, matched_of, sounds
from reference.rooms import ARRAYS
from reference.samples import in_bands, record_samples

TURN = np.arange(8) * np.pi / 4


def free(places, gain_db=0.0):
    """Return microphones that hang free, at rows of x, y [m]."""
    return scattered(microphones_of([(x, y, 0.0, gain_db, "") for x, y in places]))


CIRCLE = free(0.012 * np.column_stack((np.cos(TURN), np.sin(TURN))))
WIDE = free(np.random.default_rng(5).uniform(-0.2, 0.2, (16, 2)))
LINE = free([(0.0, 0.0049 * i) for i in range(-4, 5)])
CROSS = scattered(ARRAYS["cross"])
SLOW = pytest.mark.slow
RATES = [1e-2, pytest.param(1e-3, marks=SLOW), pytest.param(1e-4, marks=SLOW)]
"""Probabilities of false alarms."""


def around_in(matched, layout, config=CONFIG):
    return find_calls(matched, front_end(config, layout, SETTLED.tones), **LAGS)


# What is heard


@pytest.mark.parametrize("layout", [CIRCLE, WIDE, LINE], ids=["circle", "wide", "line"])
@pytest.mark.parametrize("shift", [1.0, 1.0045])
def test_block_sums_match_every_sample_at_every_microphone(layout, shift):
    sound = sounds(6.3217e-3, 0.7, 30.0, shift=shift)
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
    heard = np.abs(matched_of(sounds(8e-3, 0.0, 40.0), early)[:, 0, OWN])
    apart = np.diff(heard.argmax(axis=0))[0] * BLOCK
    assert abs(apart - late) <= BLOCK


def test_gains_scale_the_output_and_faces_receive_nothing_from_behind():
    loud = replace(CIRCLE, amplitude=np.full(8, 2.0))
    plain, doubled = (matched_of(sounds(8e-3, 0.4, 20.0), of) for of in (CIRCLE, loud))
    assert np.allclose(doubled, 2.0 * plain)
    baffled = replace(CIRCLE, normal=np.array([0.4 + np.pi]))
    assert not matched_of(sounds(8e-3, 0.4, 20.0), baffled).any()


# The false-alarm rate


def exceeded(layout, chance, key, tests):
    """Return how many lags of noise alone, each of its own draw, are as loud as by chance."""
    config = Config(detection=DetectionConfig(false_alarm=chance))
    circle = wide_of(config, layout, 0, SETTLED.calls[0], 200_000)  # lags a second apart
    noise = complex_noise((tests, 1, layout.shape[1]), 1.0, stream_key(9, key, "noise alone"))
    position = np.zeros((2 * tests - 1, 1, layout.shape[1]), dtype=complex)
    position[::2] = noise
    return find_wide(position[:, 0].T, circle, 0.0)[1].size


@pytest.mark.parametrize("layout", [CIRCLE, CROSS, LINE], ids=["circle", "cross", "line"])
@pytest.mark.parametrize("chance", RATES)
def test_pure_noise_exceeds_the_threshold_at_most_as_often_as_asked(layout, chance):
    tests, parts = round(200.0 / chance), math.ceil(0.01 / chance)
    count = sum(exceeded(layout, chance, key, tests // parts) for key in range(parts))
    assert binom.ppf(1e-6, tests, 0.3 * chance) <= count <= binom.ppf(1.0 - 1e-6, tests, chance)


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
    found = around_in(matched_of(sounds(delay, bearing, 40.0), layout), layout)
    assert found.delay.size == 1
    assert abs(wrap(found.bearing - bearing))[0] < 2e-3
    assert abs(found.delay - delay)[0] < 1e-5 + 2.0 / SETTLED.rate


def test_a_wide_array_hears_a_call_that_reaches_its_microphones_at_unlike_times():
    found = around_in(matched_of(sounds(7e-3, 2.0, 20.0), WIDE, key=3), WIDE)
    assert found.delay.size == 1
    assert abs(wrap(found.bearing[0] - 2.0)) < 5.0 * found.bearing_std[0] < 0.01
    assert abs(found.delay[0] - 7e-3) < 5.0 * found.delay_std[0]


def trials(layout, snr_db, count, seed=0):
    """Return errors of bearing and delay, and the deviations that the rows state, of many calls."""
    rng, rows = np.random.default_rng(seed), []
    end = front_end(CONFIG, layout, SETTLED.tones)
    for k in range(count):
        bearing, delay = rng.uniform(-np.pi, np.pi), 6e-3 + rng.uniform(0.0, 5e-4)
        key = stream_key(seed, k, "full circle")
        found = find_calls(matched_of(sounds(delay, bearing, snr_db), layout, key, 50), end, **LAGS)
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


@SLOW
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
    found = around_in(matched_of(sounds(7e-3, 0.5, 25.0), LINE, key=1), LINE)
    mirrored = np.pi - 2.0 * 0.5
    assert found.bearing_std[0] == pytest.approx(mirrored / math.sqrt(2.0), rel=0.02)


def test_microphones_spaced_by_a_wavelength_have_deviations_covering_other_lobes():
    corners = np.array([(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)]) * C / 35e3
    unsure, sure = (
        around_in(matched_of(sounds(7e-3, 0.0, 25.0), of, key=1), of)
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
    sound = sounds(7e-3, 0.9, 25.0)
    got = around_in(matched_of(sound, lines), lines)
    layout = replace(square_of_four(CONFIG.receiver), normal=normal)
    sums = np.zeros((60, 2, 2, 10), dtype=complex)
    add_echo_blocks(sums, sound, layout, SETTLED)
    want = detect(filtered(sums), detector(CONFIG, layout, SETTLED.tones), **LAGS)
    assert sorted(got.face) == sorted(want.face) == [0, 1]
    order = np.argsort(want.face)
    assert got.bearing == pytest.approx(want.bearing[order], abs=2e-3)
    assert got.delay == pytest.approx(want.delay[order], abs=3e-5)
    assert got.bearing_std == pytest.approx(want.bearing_std[order], rel=0.05)


def test_an_off_centre_line_gives_delays_at_the_vehicles_centre():
    rows = [(0.4, (i - 4.5) * 0.0049, 0.0, 0.0, "bow") for i in range(10)]
    bow = scattered(microphones_of([*rows, (-0.4, 0.0, 0.0, 0.0, ""), (-0.4, 0.02, 0.0, 0.0, "")]))
    found = around_in(matched_of(sounds(7e-3, 0.5, 30.0), bow, key=2), bow)
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
        sound = sounds(delay, rng.uniform(-3.0, 3.0), 25.0, caller=BEACON)
        found = around_in(matched_of(sound, CIRCLE, key=k, blocks=80), CIRCLE)
        direct = found.direct
        assert direct.detection[BEACON] >= 0 > direct.detection[OWN]
        errors.append((direct.delay[BEACON] - delay, direct.delay_std[BEACON]))
    error, std = np.array(errors).T
    assert np.sqrt(np.mean(error**2)) < 0.15 * BLOCK
    assert np.mean((error / std) ** 2) < 4.0


def test_a_frame_lasts_until_the_farthest_microphone_has_heard():
    sound = sounds(0.1, 0.0, 20.0)
    far = free([(-3.43, 0.0), (0.0, 0.0)])
    more = blocks_to_hear(sound, SETTLED, far) - blocks_to_hear(sound, SETTLED)
    assert more == pytest.approx(0.01 / BLOCK, abs=1)
    assert isinstance(far, Scattered)


# Calls that are not tones

FACE = Layout(normal=np.zeros(1), position=square_of_four(Config().receiver).position)
PAIR = scattered(microphones_of([(0.0, y, 0.0, 0.0, "") for y in (-0.15, 0.15)]))
SMALL = {"face": FACE, "circle": CIRCLE}
LAYOUTS = SMALL | {"cross": CROSS, "pair": PAIR}
SWEEPS = {
    "linear": {},
    "hyperbolic": {"sweep": "hyperbolic"},
    "tapered": {"taper": 0.5},
    "rising": {"band": (35e3, 60e3)},
    "narrow": {"band": (50e3, 40e3)},
    "wide": {"band": (80e3, 20e3), "taper": 0.2},
}
CHANCE = 1e-6


@cache
def setting(name="linear", rate=200e3, false_alarm=1e-6, speed=0.0):
    """Return settings, sampling and filters of a vehicle alone that sweeps."""
    config = Config.model_validate({
        "emitter": {"call": "sweep"} | SWEEPS[name],
        "receiver": {"sample_rate": rate},
        "detection": {"false_alarm": false_alarm},
        "scenario": {"speed": speed},
    })  # fmt: skip
    settled = sampling(config, callers_of(config, np.zeros(2))[:1])
    return config, settled, BandFilters(settled.calls, rate)


def sweeps(delay, bearing, snr_db, settled, shift=1.0):
    """Return arrivals whose SNR, at one microphone and after the filter, is given."""
    delay, bearing, snr_db = np.broadcast_arrays(*map(np.atleast_1d, (delay, bearing, snr_db)))
    energy = band_of(settled.calls[0], settled.rate).energy
    return Arrivals(
        delay=delay.astype(float),
        level_db=snr_db - 10.0 * np.log10(energy),
        bearing=bearing.astype(float),
        frequency=np.full(delay.size, settled.tones[0] * shift),
        caller=np.zeros(delay.size, dtype=np.int8),
        landmark=np.arange(1, delay.size + 1),
    )


def heard(arrivals, layout, name="linear", rng=None, milliseconds=8.0, **more):
    """Return the matched outputs of arrivals, the lags and the front end."""
    config, settled, filters = setting(name, **more)
    blocks = round(milliseconds * 1e-3 / settled.interval)
    matched = in_bands(filters, record_samples(blocks, arrivals, layout, settled, rng))
    start, interval = settled.pulse * settled.interval, filters.step / settled.rate
    return matched, Lags(start, interval, filters.pulse), config


@cache
def finder(layout, name="linear", **more):
    """Return the front end of a layout for a sweep."""
    config, settled, _ = setting(name, **more)
    return front_end(config, LAYOUTS[layout], settled.tones, calls=settled.calls)


def swept_in(arrivals, layout, name="linear", rng=None, milliseconds=8.0, **more):
    matched, lags, _ = heard(arrivals, LAYOUTS[layout], name, rng, milliseconds, **more)
    return find_calls(matched, finder(layout, name, **more), **lags._asdict())


# One sweep


@pytest.mark.parametrize("name", SWEEPS)
@pytest.mark.parametrize("layout", SMALL)
@pytest.mark.parametrize("bearing", [0.0, 0.4, -1.2])
def test_a_sweep_without_noise_is_found_where_and_when_it_is(name, layout, bearing):
    _, settled, _ = setting(name)
    delay = 5.12345e-3
    found = swept_in(sweeps(delay, bearing, 40.0, settled), layout, name)
    assert found.delay.size == 1, "nor are its lobes calls"
    assert abs(wrap(found.bearing - bearing))[0] < 2e-3
    assert abs(found.delay - delay)[0] < 3e-7
    gain_db = 40.0 + 10.0 * math.log10(LAYOUTS[layout].shape[1])
    assert 10.0 * np.log10(found.power)[0] == pytest.approx(gain_db, abs=0.15)


@pytest.mark.parametrize("turned", [0.0, 2.0, 2.6])
def test_of_lobes_that_are_nearly_as_loud_the_same_is_taken_whenever_the_call_comes(turned):
    """Of two microphones 39 waves apart, of which a wall or a cable turns one's phase."""
    _, settled, filters = setting("narrow")
    sines = []
    for delay in 5e-3 + np.arange(16) / 16 * filters.step / settled.rate:
        matched, lags, _ = heard(sweeps(delay, -0.325, 40.0, settled), PAIR, "narrow")
        matched[..., 1] *= np.exp(1j * turned)
        found = find_calls(matched, finder("pair", "narrow"), **lags._asdict())
        sines.append(np.sin(found.bearing[found.power.argmax()]))
    wave = 343.0 / 45e3 / 0.3
    assert np.mean(sines) == pytest.approx(math.sin(-0.325), abs=0.55 * wave)
    assert np.ptp(sines) < 0.1 * wave


@pytest.mark.parametrize("rate", [150e3, 192e3, 384e3, 1e6])
def test_a_sweep_is_found_at_any_sufficient_sample_rate(rate):
    _, settled, _ = setting(rate=rate)
    found = swept_in(sweeps(5.12345e-3, 0.4, 30.0, settled), "face", rate=rate)
    assert found.delay.size == 1
    assert abs(found.delay - 5.12345e-3)[0] < 3e-7
    assert abs(found.bearing - 0.4)[0] < 2e-3


def test_beams_are_steered_by_delays_and_not_by_one_carriers_phase():
    """Over the face a wave from the side takes 0.12 ms, three times what the output lasts."""
    _, settled, filters = setting()
    matched, *_ = heard(sweeps(5e-3, 1.2, 40.0, settled), FACE)
    away = np.ptp(np.abs(matched[:, 0, 0]).argmax(axis=0)) * filters.step / settled.rate
    assert away == pytest.approx(0.0441 * math.sin(1.2) / 343.0, abs=3e-5)
    at_once = np.sum(np.abs(matched[:, 0, 0]), axis=1).max() ** 2 / 10.0
    assert 10.0 * np.log10(at_once) < 50.0 - 6.0, "one lag has a quarter of it at most"
    assert 10.0 * np.log10(swept_in(sweeps(5e-3, 1.2, 40.0, settled), "face").power)[0] > 49.8


def errors(layout, name, snr_db, draws, bearing=0.5):
    """Return errors of bearing and delay in many noises, and what rows state of them."""
    _, settled, _ = setting(name)
    rng, rows = np.random.default_rng(11), []
    for _ in range(draws):
        delay = rng.uniform(4e-3, 4.1e-3)
        arrival = sweeps(delay, bearing, snr_db, settled)
        found = swept_in(arrival, layout, name, rng, milliseconds=5.0)
        d = int(np.argmin(np.abs(found.delay - delay)))
        off = wrap(found.bearing[d] - bearing), found.delay[d] - delay
        rows.append((*off, found.bearing_std[d], found.delay_std[d]))
    return np.array(rows).T


def bounds(layout, name, snr_db, bearing=0.5):
    """Return the Cramer-Rao bounds, from derivatives of the samples themselves."""
    _, settled, _ = setting(name)
    call, array, rate = settled.calls[0], LAYOUTS[layout], 2e6
    if layout == "face":
        place = np.column_stack((0.0 * array.position, array.position))
    else:
        place = array.position

    def samples(angle, delay):
        time = np.arange(round(4e-3 * rate)) / rate - 5e-4
        early = place @ [math.cos(angle), math.sin(angle)] / 343.0
        return np.concatenate([call.waveform(time - delay + a, call.frequency) for a in early])

    here = samples(bearing, 0.0)
    slopes = [
        (samples(bearing + 1e-6, 0.0) - samples(bearing - 1e-6, 0.0)) / 2e-6,
        (samples(bearing, 1e-9) - samples(bearing, -1e-9)) / 2e-9,
        1j * here,
    ]
    inside = np.abs(samples(bearing, 2e-8) - here) < 0.5  # but for the jumps at its ends
    slopes = np.array([slope * inside for slope in slopes])
    power = 10.0 ** (snr_db / 10.0) * len(place) / np.sum(np.abs(here) ** 2)
    fisher = 2.0 * power * (slopes.conj() @ slopes.T).real
    return np.sqrt(np.diag(np.linalg.inv(fisher)))[:2]


@pytest.mark.parametrize("layout", SMALL)
@pytest.mark.parametrize("name", [*SWEEPS][1:3] + [pytest.param(n, marks=SLOW) for n in SWEEPS])
def test_bearings_and_delays_meet_their_bounds_and_rows_state_them(layout, name):
    draws = 60
    found = errors(layout, name, 20.0, draws)
    low, high = np.sqrt(chi2.ppf([CHANCE / 2, 1 - CHANCE / 2], draws) / draws)
    for k, bound in enumerate(bounds(layout, name, 20.0)):
        share = math.sqrt(np.mean(found[k] ** 2)) / bound
        assert 0.93 * low < share < 1.07 * high
        assert np.median(found[2 + k]) == pytest.approx(bound, rel=0.1)


def test_the_delay_deviation_covers_the_doppler_shift_of_own_motion():
    _, settled, _ = setting()
    arrival = sweeps(5e-3, 0.0, 50.0, settled, shift=1.0 + 2.0 * 0.75 / 343.0)
    still, moving = (swept_in(arrival, "face", speed=speed) for speed in (0.0, 0.75))
    late = moving.delay[0] - 5e-3
    assert late == pytest.approx(3.92e-3 * 2.0 * 0.75 / 343.0, rel=0.05)
    assert abs(late) < 2.0 * moving.delay_std[0]
    assert still.delay_std[0] < 0.05 * moving.delay_std[0]


# Noise, and other calls


def passed(layout, chance, name, threshold=None):
    """Return how many lags of noise alone, too far apart to be alike, are loud, and of how many."""
    config, settled, filters = setting(name, false_alarm=chance)
    wide = wide_of(config, LAYOUTS[layout], 0, settled.calls[0], filters.step)
    rng, least, count, tests = np.random.default_rng(3), threshold or wide.threshold, 0, 0
    channel = np.arange(LAYOUTS[layout].shape[1])[np.newaxis]
    while tests < 60.0 / chance:
        noise = 0.5 * rng.standard_normal((100_000, channel.size), dtype=np.float32)
        outputs = np.ascontiguousarray(filters(noise, channel)[:, 0, 0].T)
        loudness = _loudness(outputs, wide, least)[3 * filters.cut : -3 * filters.cut : 8]
        count, tests = count + np.count_nonzero(loudness > least), tests + loudness.size
    return count, tests


@pytest.mark.parametrize("layout", ["circle", "cross", "face"])
@pytest.mark.parametrize("name", ["linear", pytest.param("wide", marks=SLOW)])
@pytest.mark.parametrize("chance", RATES)
def test_pure_noise_passes_for_a_sweep_at_most_as_often_as_asked(name, layout, chance):
    count, tests = passed(layout, chance, name)
    assert binom.ppf(CHANCE, tests, 0.3 * chance) <= count <= binom.ppf(1 - CHANCE, tests, chance)
    # A threshold for one direction alone, which a scan of many passes, is found out.
    count, tests = passed(layout, chance, name, -math.log(chance))
    assert count > binom.ppf(1 - CHANCE, tests, chance)


def test_noise_correlates_between_lags_as_the_calls_autocorrelation():
    _, settled, filters = setting()
    rng, count = np.random.default_rng(5), 400_000
    nothing = sweeps([], [], [], settled)
    matched = in_bands(filters, record_samples(count // 40, nothing, FACE, settled, rng))[:, 0, 0]
    sent = replica(settled.calls[0], settled.rate)
    own = np.correlate(sent, sent, mode="full")[sent.size - 1 :] / np.sum(np.abs(sent) ** 2)
    assert np.mean(np.abs(matched) ** 2) == pytest.approx(1.0, abs=0.01)
    for lag in (1, 2, 3, 5, 8):
        alike = np.mean(matched[lag:] * matched[:-lag].conj())
        turns = carrier_of(band_of(settled.calls[0], settled.rate), filters.interval) * lag
        turned = own[lag * filters.step] * np.exp(-2j * np.pi * turns * filters.interval)
        assert abs(alike - turned) < 0.02


@pytest.mark.parametrize("name", ["linear", "tapered"])
def test_two_echoes_separated_by_a_few_lags_are_two_detections(name):
    _, settled, _ = setting(name)
    apart = 1.5e-4
    pair = sweeps([4.0e-3, 4.0e-3 + apart], [0.3, 0.3], [30.0, 29.0], settled)
    found = swept_in(pair, "circle", name)
    assert np.sort(found.delay) == pytest.approx([4.0e-3, 4.0e-3 + apart], abs=3e-6)


@pytest.mark.parametrize("name", ["linear", "hyperbolic", "narrow"])
@pytest.mark.parametrize("louder", [-6.0, 0.0, 3.0])
def test_an_echo_just_after_a_direct_call_does_not_shift_its_beginning(name, louder):
    rng, off, (_, settled, _) = np.random.default_rng(7), [], setting(name)
    wide = finder("circle", name).finders[0].detector
    for late in np.linspace(0.6, 4.0, 40) / wide.band.spread:
        delay = rng.uniform(4e-3, 5e-3)
        pair = sweeps([delay, delay + late], [0.3, 0.4], [35.0, 35.0 + louder], settled)
        matched, lags, _ = heard(pair, CIRCLE, name, rng)
        near = round((delay + 0.5 * late - lags.start) / lags.interval)
        lag, std = edge_around(matched[:, 0, 0].T, wide, near, 0.3)
        off.append((lag - (delay - lags.start) / lags.interval) / std)
    assert np.abs(off).max() < 5.0
    assert np.sqrt(np.mean(np.square(off))) < 1.5


def test_a_tone_and_a_sweep_are_heard_side_by_side_and_leave_little_in_each_other():
    config = Config.model_validate({"emitter": {"call": "sweep"}})
    callers = callers_of(config, np.zeros(2))
    settled = sampling(config, callers)
    filters = BandFilters(settled.calls, settled.rate)
    end = front_end(config, FACE, settled.tones, calls=settled.calls)
    both = Arrivals(
        delay=np.array([6e-3, 8e-3]),
        level_db=np.array([0.0, 40.0]),  # the beacon's own call is as loud as that
        bearing=np.array([0.3, -0.4]),
        frequency=settled.tones.copy(),
        caller=np.array([0, 1], dtype=np.int8),
        landmark=np.array([1, 2]),
    )
    samples = record_samples(60, both, FACE, settled, np.random.default_rng(1))
    lags = Lags(settled.pulse * settled.interval, filters.step / settled.rate, filters.pulse)
    found = find_calls(in_bands(filters, samples), end, **lags._asdict())
    assert found.caller.tolist().count(1) == 1
    beacon = int(np.flatnonzero(found.caller == 1)[0])
    assert found.direct.detection.tolist() == [-1, beacon]
    assert found.direct.delay[1] == pytest.approx(8e-3, abs=2e-5)
    assert found.bearing[beacon] == pytest.approx(-0.4, abs=2e-3)
    own = found.caller == 0
    assert own.sum() <= 1, "what leaks is none"


def test_cross_talk_is_the_output_of_a_filter_for_another_call():
    up, down, tone = Sweep(30e3, 60e3, 2.8e-3), Sweep(60e3, 30e3, 2.8e-3), ToneBurst(45e3, 2.8e-3)
    share = cross_talk([up, down, tone], 200e3)
    np.testing.assert_allclose(np.diag(share), 1.0)
    np.testing.assert_allclose(share, share.T, rtol=1e-9)
    assert share[0, 2] == pytest.approx(1.0 / (30e3 * 2.8e-3), rel=0.5)
    assert share[0, 1] < 0.04


@pytest.mark.parametrize("layout", SMALL)
@pytest.mark.parametrize("rate", [44.1e3, 96e3, 192e3, 1e6])
def test_tones_off_the_raster_are_found_at_any_rate(layout, rate):
    config = Config.model_validate({
        "emitter": {"frequency": 19_234.5}, "beacon": {"frequency": 12_100.0},
        "receiver": {"sample_rate": rate},
    })  # fmt: skip
    settled = sampling(config, callers_of(config, np.zeros(2)))
    end = front_end(config, LAYOUTS[layout], settled.tones, calls=settled.calls)
    both = Arrivals(
        delay=np.array([6.01e-3, 13e-3]),
        level_db=np.array([-15.0, 0.0]),
        bearing=np.array([0.3, -0.4]),
        frequency=settled.tones.copy(),
        caller=np.array([0, 1], dtype=np.int8),
        landmark=np.array([1, 2]),
    )
    blocks, layout = round(20e-3 / settled.interval), LAYOUTS[layout]
    sums = noise_blocks(blocks, layout, settled, 1)
    add_echo_blocks(sums, both, layout, settled)
    start, interval = settled.pulse * settled.interval, settled.interval
    lags = {"start": start, "interval": interval, "pulse": settled.pulse}
    found = find_calls(filtered(sums, settled), end, **lags)
    order = np.argsort(found.delay)
    assert found.caller[order].tolist() == [0, 1]
    error = found.delay[order] - both.delay
    assert (np.abs(error) < 5.0 * found.delay_std[order] + 0.5 / rate + 2e-6).all()
    off = wrap(found.bearing[order] - both.bearing)
    assert (np.abs(off) < 5.0 * found.bearing_std[order]).all()
    assert found.direct.delay[1] == pytest.approx(13e-3, abs=6e-5)
