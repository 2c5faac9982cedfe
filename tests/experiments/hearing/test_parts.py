"""Parts of one's own, handed to `listen`: an array, a call, a medium, the shape of a body."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pipistrelle.acoustics.arrivals import Arrivals, arrivals_of_emissions
from pipistrelle.acoustics.call import ToneBurst
from pipistrelle.acoustics.emitter import SHAPES, Bodies, Shape
from pipistrelle.acoustics.paths import VEHICLE, callers_of
from pipistrelle.acoustics.propagation import Medium, medium_of
from pipistrelle.arrays.layout import Layout, layout_of
from pipistrelle.arrays.receiver import add_echo_blocks, noise_blocks
from pipistrelle.arrays.sampling import sampling
from pipistrelle.config import (
    BLOCK,
    AssumedConfig,
    BeaconConfig,
    Config,
    EmitterConfig,
    InputError,
    ReceiverConfig,
    ScenarioConfig,
)
from pipistrelle.detection.front_end import find_calls, front_end
from pipistrelle.detection.matched import BandFilters, filter_blocks
from pipistrelle.detection.snapshots import detect, detector
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.experiments.hearing.world_folder import read_world
from pipistrelle.geometry import wrap
from reference.samples import filter_samples, in_bands, record_samples

CONFIG = Config(scenario=ScenarioConfig(steps=40))
DENSE = Config(
    scenario=ScenarioConfig(steps=12),
    beacon=BeaconConfig(frequency=15e3),  # a sweep's band about it is its own
)
GOLOMB = np.array([0.0, 1.0, 4.0, 9.0, 15.0, 22.0, 32.0, 34.0])
"""Places of eight elements no two of which are as far apart as any other two [spacings]."""
RULER = replace(layout_of(CONFIG), position=0.0049 * (GOLOMB - 17.0))
WATER = Medium(speed_of_sound=1480.0, absorption_db_per_m=lambda frequency: frequency * 1e-7)


@dataclass(frozen=True)
class Sweep:
    """A tone that rises evenly through a band of 10 kHz about its frequency."""

    frequency: float
    duration: float
    band: float = 10e3

    def waveform(self, time, frequency):
        own = time * frequency / self.frequency  # as the Doppler shift compresses it
        rise = self.band / self.duration
        return np.exp(2j * np.pi * ((self.frequency - 0.5 * self.band) * own + 0.5 * rise * own**2))


def echoes(delay, snr_db, angle=0.0, elements=10):
    """Return echoes of the vehicle's call, of such a ratio at one element after the filter."""
    delay = np.array(delay)
    return Arrivals(
        delay=delay,
        level_db=np.full(delay.size, snr_db - 10.0 * np.log10(560)),
        bearing=np.full(delay.size, angle),
        frequency=np.full(delay.size, 35e3),
        caller=np.zeros(delay.size, dtype=np.int8),
        landmark=1 + np.arange(delay.size),
    )


def bearings(layout, angle, draws, snr_db=15.0):
    """Return the bearings, and what is said of their deviation, of one echo in many noises."""
    settled = sampling(CONFIG, callers_of(CONFIG, np.zeros(2))[:1])
    finder, heard = detector(CONFIG, layout, settled.tones), []
    for draw in range(draws):
        signal = noise_blocks(120, layout, settled, draw)
        add_echo_blocks(signal, echoes([0.010], snr_db, angle), layout, settled)
        matched = filter_blocks(signal, pulse=settled.pulse, block=settled.block, noise_std=1.0)
        found = detect(matched, finder, start=settled.pulse * BLOCK, interval=BLOCK, pulse=14)
        front = np.flatnonzero(found.face == 0)
        best = front[np.argmax(found.power[front])]
        heard.append((found.bearing[best], found.bearing_std[best], found.delay[best]))
    return np.array(heard).T


def own_echoes(world, heard):
    """Yield range, bearing, pose and true places of the vehicle's echoes in each frame."""
    for frame in heard:
        rows = frame.rows
        own = np.flatnonzero((rows.caller == VEHICLE) & (rows.landmark <= 50))
        pose = world.path[np.searchsorted(world.time, rows.time)]
        yield rows.range[own], rows.bearing[own], pose, world.landmarks[rows.landmark[own] - 1]


def range_errors(world, heard):
    """Return the errors of all ranges of the vehicle's echoes [m]."""
    return np.concatenate([
        distance - np.hypot(*(places - pose[:2]).T)
        for distance, _, pose, places in own_echoes(world, heard)
    ])  # fmt: skip


@pytest.mark.parametrize("angle", [-0.7, 0.0, 0.3])
def test_elements_at_any_places_find_a_bearing_as_surely_as_their_spread_allows(angle):
    found, said, delay = bearings(RULER, angle, 200)
    place = RULER.position - RULER.position.mean()
    slope = 2.0 * np.pi * 35e3 / 343.0 * np.cos(angle)
    bound = 1.0 / np.sqrt(2.0 * 10.0**1.5 * np.sum(place**2)) / slope
    error = wrap(found - angle)
    near = 4.9 / np.sqrt(2 * error.size)
    assert np.std(error) == pytest.approx(bound, rel=near + 0.05)
    assert np.median(said) == pytest.approx(bound, rel=0.1)
    assert abs(error.mean()) < 4.9 * bound / np.sqrt(error.size)
    assert delay == pytest.approx(0.010, abs=3e-4)


def test_a_wider_array_of_fewer_elements_hears_bearings_more_surely_in_a_mission():
    world = world_of(CONFIG)
    off = []
    for layout in (None, RULER):
        (heard,) = listen(world, CONFIG, (0.0088,), layout=layout)
        errors = np.concatenate([
            wrap(bearing - np.arctan2(*(places - pose[:2]).T[::-1]) + pose[2])
            for _, bearing, pose, places in own_echoes(world, heard)
        ])  # fmt: skip
        assert errors.size > 20
        off.append(np.median(np.abs(errors)))
    assert off[1] < 0.7 * off[0]


@pytest.mark.parametrize("position", [[0.0], [0.0, 0.0, 0.01], [0.01, 0.0]])
def test_elements_that_do_not_rise_are_refused(position):
    layout = replace(RULER, position=np.array(position))
    with pytest.raises(InputError, match="expected two or more, rising"):
        listen(world_of(CONFIG), CONFIG, (0.0088,), layout=layout)


def test_phases_match_the_recorded_signal():
    settled = sampling(CONFIG, callers_of(CONFIG, np.zeros(2))[:1])
    signal = record_samples(80, echoes([0.005], 30.0, 0.4), RULER, settled, None)
    n = 1000 - settled.pulse * settled.block + 100
    turned = np.exp(1j * RULER.phases(0.4, 35e3, settled.speed_of_sound))
    np.testing.assert_allclose(signal[n, 0] / signal[n, 0, 0], turned / turned[0], atol=1e-12)


def dense_matched(call, delay, snr_db=25.0, seed=None):
    """Return the matched filter's output of echoes of a call on one face, and its lags."""
    settled = sampling(DENSE, callers_of(DENSE, np.zeros(2))[:1], call=call)
    layout = Layout(normal=np.zeros(1), position=layout_of(DENSE).position)
    rng = None if seed is None else np.random.default_rng(seed)
    signal = record_samples(150, echoes(delay, snr_db), layout, settled, rng)
    lags = {"start": settled.pulse * BLOCK, "interval": 1.0 / settled.rate, "pulse": 560}
    if not settled.banded:
        matched = filter_samples(signal, calls=settled.calls, rate=settled.rate, noise_std=1.0)
        return matched, lags, front_end(DENSE, layout, settled.tones)
    filters = BandFilters(settled.calls, settled.rate)
    lags |= {"interval": filters.step / settled.rate, "pulse": 560 // filters.step}
    end = front_end(DENSE, layout, settled.tones, calls=settled.calls)
    return in_bands(filters, signal), lags, end


@pytest.mark.parametrize(("call", "width"), [(ToneBurst, 2.8e-3), (Sweep, 1.0e-4)])
def test_the_answer_to_a_call_peaks_at_its_delay_as_narrowly_as_its_band_is_wide(call, width):
    matched, lags, _ = dense_matched(call, [0.010])
    power, interval = np.abs(matched[:, 0, 0, 0]), lags["interval"]
    assert lags["start"] + power.argmax() * interval == pytest.approx(0.010, abs=1.01 * interval)
    assert power.max() ** 2 == pytest.approx(10.0**2.5, rel=2e-2)
    wide = np.flatnonzero(power > 0.5 * power.max())
    assert np.ptp(wide) * interval == pytest.approx(1.1 * width, abs=0.15 * width + interval)


def test_a_sweep_parts_echoes_that_a_tone_takes_for_one():
    pair, counts = [0.0100, 0.0110], []
    for call in (ToneBurst, Sweep):
        matched, lags, finder = dense_matched(call, pair, seed=7)
        found = find_calls(matched, finder, **lags)
        strong = np.sort(found.delay[found.power > 0.5 * found.power.max()])
        counts.append(strong.size)
    assert counts == [1, 2]
    np.testing.assert_allclose(strong, pair, atol=1e-5)


def test_a_sweep_is_heard_in_a_mission_where_echoes_overlap_less():
    """It takes the Doppler shift of 153 Hz for a delay: 7 mm, its well-known coupling."""
    world, off = world_of(DENSE), []
    for call in (ToneBurst, Sweep):
        (heard,) = listen(world, DENSE, (0.0025,), call=call)
        off.append(np.abs(range_errors(world, heard)))
    assert min(error.size for error in off) >= 8
    assert np.quantile(off[1], 0.9) < 0.02 < 0.5 * np.quantile(off[0], 0.9)


def test_another_medium_brings_echoes_at_its_delay_and_level():
    pose, still, post = np.zeros((1, 3)), np.zeros((1, 2)), np.array([[6.0, 0.0]])
    callers = callers_of(CONFIG, np.array([0.0, 8.0]))
    heard, _ = arrivals_of_emissions(pose, still, post, callers, CONFIG, medium=WATER)
    np.testing.assert_allclose(heard.delay[0], 12.0 / 1480.0, rtol=1e-14)
    level = callers[0].level_db - 40.0 * np.log10(6.0) - 12.0 * 35e3 * 1e-7
    np.testing.assert_allclose(heard.level_db[0], level, rtol=1e-12)
    direct = np.flatnonzero((heard.caller == 1) & (heard.landmark == 2))
    np.testing.assert_allclose(heard.delay[direct], 8.0 / 1480.0, rtol=1e-14)


def test_a_mission_in_another_medium_ranges_where_the_front_end_assumes_its_speed():
    config = CONFIG.model_copy(update={"assumed": AssumedConfig(speed_of_sound=1480.0)})
    world = world_of(config)
    (heard,) = listen(world, config, (0.0025,), medium=WATER)
    errors = range_errors(world, heard)
    assert errors.size > 20
    assert np.median(np.abs(errors)) < 0.25, "a tenth of a call, 2 m long"


def test_a_data_sheet_in_the_settings_gives_the_echo_of_the_sonar_equation():
    source, strength, density, length = 170.0, -20.0, 55.0, 1e-3  # dB re 1 uPa and its like [s]
    rate, tone, still = 500e3, 150e3, np.zeros((1, 2))
    config = Config(
        scenario=ScenarioConfig(medium="water"),
        emitter=EmitterConfig(frequency=tone, call_duration=length, level_db=source + strength),
        receiver=ReceiverConfig(
            sample_rate=rate, noise_level_db=density + 10.0 * np.log10(rate), spacing=0.005
        ),
    )
    way = 1490.0 * 67 * BLOCK  # its delay is nearly a whole number of blocks
    post, callers = np.array([[0.5 * way, 0.0]]), callers_of(config, np.zeros(2))[:1]
    heard, _ = arrivals_of_emissions(np.zeros((1, 3)), still, post, callers, config)
    settled, layout = sampling(config, callers), layout_of(config)
    signal = np.zeros((80, 4, 1, 10), dtype=complex)
    add_echo_blocks(signal, heard, layout, settled)
    grid = {"pulse": settled.pulse, "block": settled.block, "noise_std": settled.noise_std}
    above = 20.0 * np.log10(np.abs(filter_blocks(signal, **grid)[:, 0]).max())
    absorbed = way * medium_of(config.water).absorption_db_per_m(tone)
    expected = source + strength - 40.0 * np.log10(0.5 * way) - absorbed - density - 30.0
    assert above == pytest.approx(expected, abs=0.05)


def test_a_mission_in_water_ranges_by_the_sound_in_water_and_not_by_that_in_air():
    setup = ScenarioConfig(medium="water", steps=40)
    wet = Config(scenario=setup, emitter=EmitterConfig(call_duration=6e-4))
    deceived = wet.model_copy(update={"assumed": AssumedConfig(speed_of_sound=343.0)})
    world, off = world_of(wet), []
    for config in (wet, deceived):
        (heard,) = listen(world, config, (0.0088,))
        errors = range_errors(world, heard)
        assert errors.size > 20
        off.append(np.median(np.abs(errors)))
    assert off[0] < 0.1, "a fifth of a call, 0.45 m long"
    assert off[1] > 3.0


@pytest.fixture
def plate(monkeypatch):
    """Register a shape that throws alike to all sides, louder by the cube of its radius."""
    alike = Shape(intensity=lambda angle, kr: np.ones(np.broadcast(angle, kr).shape), growth=3.0)
    monkeypatch.setitem(SHAPES, "plate", alike)


def test_a_shape_of_ones_own_is_heard_by_its_law_and_kept_in_a_worlds_folder(plate, tmp_path):
    pose, still = np.zeros((1, 3)), np.zeros((1, 2))
    posts, callers = np.array([[6.0, 0.0], [0.0, 5.0]]), callers_of(CONFIG, np.array([2.0, 8.0]))
    shapes = np.array(["plate", "cylinder"])
    bodies = Bodies(radius=np.array([0.25, np.nan]), shape=shapes)
    small = replace(bodies, radius=np.array([0.025, np.nan]))
    levels = [
        arrivals_of_emissions(pose, still, posts, callers, CONFIG, body)[0].level_db
        for body in (bodies, small)
    ]
    nearer = 40.0 * np.log10((6.0 - 0.025) / (6.0 - 0.25)) + 0.45 * 1.1329
    assert levels[0][0] - levels[1][0] == pytest.approx(30.0 + nearer, abs=1e-3)
    (tmp_path / "world.toml").write_text("format = 1\n")
    rows = "landmark,x,y,radius,shape\n1,6,0,0.25,plate\n2,0,5,,cylinder\n"
    (tmp_path / "landmarks.csv").write_text(rows)
    read = read_world(tmp_path)
    assert read.bodies.shape.tolist() == ["plate", "cylinder"]


def test_an_unknown_shape_is_refused():
    bodies = Bodies(radius=np.array([0.1]), shape=np.array(["cube"]))
    one = np.array([[6.0, 0.0]])
    callers = callers_of(CONFIG, np.array([2.0, 8.0]))
    with pytest.raises(InputError, match="found 'cube', expected 'cylinder' or 'sphere'"):
        arrivals_of_emissions(np.zeros((1, 3)), np.zeros((1, 2)), one, callers, CONFIG, bodies)
