"""Snapshots, tones, peaks and times of arrival, alone and against a slow second version."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import find_peaks
from scipy.stats import binom, gamma

from pipistrelle.acoustics.arrivals import Arrivals, arrivals_of_emission, through_piston
from pipistrelle.acoustics.paths import Caller, callers_of
from pipistrelle.arithmetic.random_stream import complex_noise, stream_key
from pipistrelle.arrays.beamforming import beamscan
from pipistrelle.arrays.layout import Layout
from pipistrelle.arrays.receiver import add_echo_blocks, noise_blocks
from pipistrelle.arrays.sampling import blocks_to_hear, sampling
from pipistrelle.config import BLOCK, Config, DetectionConfig
from pipistrelle.detection.snapshots import Detections, _scan_power, detect, detector
from pipistrelle.geometry import wrap
from reference.echoes import (
    BEACON,
    CALLERS,
    CONFIG,
    FINDER,
    LAGS,
    OWN,
    SAMPLES,
    SETTLED,
    SQUARE,
    START,
    filtered,
    found_in,
    matched_of,
    sounds,
)
from reference.samples import filter_samples, record_samples

law = settings(deadline=None, max_examples=40)
CHANCE, SIGMAS = 1e-6, 4.9


def finder_of(layout=SQUARE, **changes):
    return detector(Config(detection=DetectionConfig(**changes)), layout, SETTLED.tones)


def echoes(*rows):
    """Return arrivals of rows (delay, bearing [deg], source, SNR of one element [dB], shift)."""
    delay, bearing, source, snr_db, shift = map(np.array, zip(*rows, strict=True))
    return sounds(delay, np.radians(bearing), snr_db, source, shift)


def snapshots(found, tone):
    """Return how many snapshots hold the tone's detections: each face's, half a call apart."""
    count = 0
    for face in np.unique(found.face):
        delay = np.sort(found.delay[(found.face == face) & (found.caller == tone)])
        count += bool(delay.size) + np.count_nonzero(np.diff(delay) > 0.35 * SETTLED.pulse * BLOCK)
    return count


def mission_frame(seed=7, frame=60, config=CONFIG):
    """Return arrivals and noise of one emission somewhere among 50 landmarks."""
    rng = np.random.default_rng(seed)
    turn = 2.0 * np.pi * frame / 124.0
    pose = np.array([7.4 * np.sin(turn), -7.4 * np.cos(turn), turn])
    radius, direction = 25.0 * np.sqrt(rng.uniform(size=50)), rng.uniform(-np.pi, np.pi, 51)
    places = np.append(radius, 15.0) * np.array([np.cos(direction), np.sin(direction)])
    velocity = 0.75 * np.array([np.cos(turn), np.sin(turn)])
    emission = arrivals_of_emission(
        pose, velocity, places[:, :50].T, callers_of(config, places[:, 50]), config
    )
    heard = through_piston(
        emission, radius=config.emitter.radius, frequency=35e3, speed_of_sound=343.0
    )
    return heard, blocks_to_hear(emission, SETTLED), stream_key(seed, frame, "mission frame")


def arrival_lag(beam, lag, pulse):
    """Search the call's start near a lag by brute force."""
    reach = max(pulse // 7, 1)
    near = np.arange(max(lag - reach, 0), min(lag + reach + 1, beam.size))
    centre = near[np.abs(beam[near]).argmax()]
    part, best, lag = np.linspace(0.0, 1.0, 10001), -1.0, float(lag)
    for left in range(max(centre - 1, 0), min(centre, beam.size - 2) + 1):
        matched = np.abs((1.0 - part) * beam[left] + part * beam[left + 1]) ** 2
        fit = matched / ((1.0 - part) ** 2 + pulse - 1 + part**2)
        if fit.max() > best:
            best, lag = fit.max(), left + part[fit.argmax()]
    return lag


def run_around(b, above):
    """Return where the contiguous run that holds a lag begins, and where it has ended."""
    quiet = np.flatnonzero(~above)
    before, after = quiet[quiet < b], quiet[quiet > b]
    return before.max(initial=-1) + 1, after.min(initial=above.size)


def slow_detect(matched, config, *, start, interval, pulse):
    """Detect as the room's docstring says, one definition after the other."""
    settings_, rows = config.detection, []
    tones = np.array([config.emitter.frequency, config.beacon.frequency])
    threshold = gamma(10).isf(settings_.false_alarm)
    energy = np.sum(np.abs(matched) ** 2, axis=-1)

    def leaks(b, f, p):
        around = energy[max(b - pulse, 0) : b + pulse + 1, f, 1 - p]
        return energy[b, f, p] <= 10.0 ** (settings_.leakage_db / 10.0) * around.max()

    for b, f, p in np.argwhere(energy > threshold):
        if settings_.snapshots == "runs":
            first, end = run_around(b, energy[:, f, p] > threshold)
        else:
            first, end = max(b - pulse // 2, 0), b + pulse // 2 + 1
        if energy[b, f, p] < energy[first:end, f, p].max():
            continue
        if settings_.snapshots == "maxima":
            first, end = b, b + 1
        wave = 2.0 * np.pi * tones[p] * 0.0049 / 343.0
        u = np.linspace(-1.0, 1.0, FINDER.scan.shape[1]) * wave * np.sin(np.radians(80.0))
        position = np.arange(10) * 0.0049
        ears = {"position": position, "frequency": tones[p], "speed_of_sound": 343.0}
        power = sum(beamscan(x, np.arcsin(u / wave), **ears) for x in matched[first:end, f, p])
        for i in find_peaks(power, height=power.max() * 10.0 ** (settings_.peak_db / 10.0))[0]:
            offset = u[i - 1 : i + 2] - u[i]
            bend, slope, top = np.polyfit(offset, power[i - 1 : i + 2], 2)
            peak = u[i] - slope / (2.0 * bend)
            angle = np.arcsin(np.clip(peak / wave, -1.0, 1.0))
            if abs(angle) > np.radians(settings_.angle_limit_deg):
                continue
            beam = matched[:, f, p] @ np.exp(-1j * np.arange(10) * peak)
            top -= slope**2 / (4.0 * bend)
            if settings_.snapshots == "runs":
                b = first + np.abs(beam[first:end]).argmax()
                top = np.abs(beam[b]) ** 2
            if not leaks(b, f, p):
                delay = start + interval * arrival_lag(beam, b, pulse)
                rows.append((f, p, angle, delay, top / 10.0))
    return rows


def assert_same(found, rows, interval):
    assert found.face.size == len(rows)
    face, tone, angle, delay, power = map(np.array, zip(*rows, strict=True))
    assert found.face.tolist() == face.tolist()
    assert found.caller.tolist() == tone.tolist()
    np.testing.assert_allclose(found.angle, angle, atol=1e-9)
    np.testing.assert_allclose(found.power, power, rtol=1e-9)
    np.testing.assert_allclose(found.delay, delay, atol=2e-4 * interval)
    np.testing.assert_allclose(found.bearing, wrap(angle + SQUARE.normal[face]), atol=1e-9)


@pytest.mark.parametrize("frame", [10, 60])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"false_alarm": 1e-2, "leakage_db": -60.0, "peak_db": -3},
        {"snapshots": "runs"},
        {"snapshots": "runs", "peak_db": 0.0, "false_alarm": 1e-2},
    ],
)
def test_detections_match_a_slow_second_version(frame, changes):
    config = Config(detection=DetectionConfig(**changes))
    heard, blocks, key = mission_frame(frame=frame)
    matched = matched_of(heard, key=key, blocks=blocks)
    found = detect(matched, detector(config, SQUARE, SETTLED.tones), **LAGS)
    assert found.face.size > 10
    assert_same(found, slow_detect(matched, config, **LAGS), BLOCK)


@pytest.mark.parametrize("pulse", [1, 2, 3])
def test_detections_of_very_short_calls_match_a_slow_second_version(pulse):
    noise = complex_noise((400, 4, 2, 10), 1.0, stream_key(7, pulse, "short calls"))
    config = Config(detection=DetectionConfig(false_alarm=0.02, leakage_db=-60.0))
    timing = {"start": START, "interval": BLOCK, "pulse": pulse}
    found = detect(noise, detector(config, SQUARE, SETTLED.tones), **timing)
    assert found.face.size > 50
    assert_same(found, slow_detect(noise, config, **timing), BLOCK)


def test_detections_at_the_full_rate_match_a_slow_second_version():
    heard = echoes((5.01e-3, 20, OWN, 9, 1.0), (6.8e-3, -30, BEACON, 6, 1.0))
    samples = record_samples(44, heard, SQUARE, SETTLED, np.random.default_rng(7))
    matched = filter_samples(samples, calls=SETTLED.calls, rate=200e3, noise_std=1)
    timing = {"start": START, "interval": 5e-6, "pulse": SAMPLES}
    found = detect(matched, FINDER, **timing)
    assert set(zip(found.face.tolist(), found.caller.tolist(), strict=True)) >= {(0, 0), (0, 1)}
    assert_same(found, slow_detect(matched, CONFIG, **timing), 5e-6)


@given(key=st.integers(0, 2**64 - 1), tone=st.sampled_from([OWN, BEACON]))
@law
def test_the_scan_by_lag_sums_is_the_conventional_beamscan_to_rounding(key, tone):
    matched, power = complex_noise((5, 4, 2, 10), 1.0, key), np.empty(FINDER.scan.shape[1])
    _scan_power(matched, (1, 4), 3, tone, FINDER.table[tone], power)
    ears = {"position": SQUARE.position, "frequency": SETTLED.tones[tone], "speed_of_sound": 343.0}
    angle = np.arcsin(FINDER.scan[tone] / FINDER.wave[tone])
    exact = np.sum([beamscan(row, angle, **ears) for row in matched[1:4, 3, tone]], axis=0)
    np.testing.assert_allclose(power, exact, atol=1e-12 * exact.max())


def test_the_threshold_is_the_quantile_of_ten_outputs_energy_in_noise():
    assert FINDER.threshold == pytest.approx(32.7, abs=0.05)  # the physics' printed digits
    for alarm in (1e-2, 1e-6, 1e-9):
        assert gamma(10).sf(finder_of(false_alarm=alarm).threshold) == pytest.approx(alarm)


def test_pure_noise_passes_each_test_as_often_as_asked():
    # Many faces and a single lag: every face and tone is one independent test.
    faces, batches, alarm = 2000, 50, 1e-3
    wide = Layout(normal=np.zeros(faces), position=SQUARE.position)
    finder, passed, shown = finder_of(wide, false_alarm=alarm), 0, 0
    for batch in range(batches):
        sums = noise_blocks(SETTLED.pulse, wide, SETTLED, stream_key(7, batch, "false alarms"))
        matched = filtered(sums)
        passed += np.count_nonzero(np.sum(np.abs(matched) ** 2, axis=-1) > finder.threshold)
        found = found_in(matched, finder)
        shown += len(set(zip(found.face.tolist(), found.caller.tolist(), strict=True)))
    low, high = binom.interval(1.0 - CHANCE, batches * faces * 2, alarm)
    assert low <= passed <= high
    assert not low <= 2 * passed <= high  # the sample would show a rate twice as high
    assert 0.97 * passed <= shown <= passed  # few snapshots of noise have all peaks past the cut


def test_pure_noise_is_detected_in_hardly_any_frame():
    # Each lag, face and tone is a test; a passed one shows a handful of peaks.
    frames, blocks = 200, 700
    tests = frames * (blocks - SETTLED.pulse + 1) * 8
    silence = echoes((0.0, 0, OWN, -400, 1.0))
    seen = 0
    for frame in range(frames):
        found = found_in(matched_of(silence, key=stream_key(7, frame, "silence"), blocks=blocks))
        seen += snapshots(found, OWN) + snapshots(found, BEACON)
    assert seen <= binom.isf(CHANCE, tests, 1e-6)


@given(
    late=st.floats(0.0, 30.0), angle=st.floats(-70.0, 70.0), source=st.sampled_from([OWN, BEACON])
)
@law
def test_without_noise_an_echo_is_placed_where_it_starts(late, angle, source):
    # The call is heard from the first sample after its arrival on, to within a sample: one that
    # ends on a sample holds it or not, by rounding. The parabola's bias is within 2 % of a beam's
    # step of 0.05 in u.
    delay = START + late * BLOCK
    found = found_in(matched_of(echoes((delay, angle, source, 30, 1.0))))
    main = np.flatnonzero((found.face == 0) & (found.caller == source))
    assert main.size == 1
    first = np.ceil(delay * SETTLED.rate) / SETTLED.rate
    assert found.delay[main[0]] == pytest.approx(first, abs=1.0 / SETTLED.rate)
    sine = np.sin(found.angle[main[0]]) - np.sin(np.radians(angle))
    assert abs(sine) * FINDER.wave[source] < 0.02 * 0.05


@pytest.mark.parametrize("speed", [-0.75, 0.75])
def test_the_vehicles_doppler_shift_costs_three_decibels_and_a_centimetre_at_most(speed):
    # Dead ahead at full speed: the matched filter's triangle is blunter than the one fitted.
    shift = 2.0 * speed / 343.0
    still = found_in(matched_of(echoes((6e-3, 0, OWN, 30, 1.0))))
    moved = found_in(matched_of(echoes((6e-3, 0, OWN, 30, 1.0 + shift))))
    loss_db = 10.0 * np.log10(still.power.max() / moved.power.max())
    assert loss_db == pytest.approx(-20.0 * np.log10(np.sinc(shift * 35e3 * 2.8e-3)), abs=0.1)
    late = [
        found_in(matched_of(echoes((delay, 0, OWN, 30, 1.0 + shift)))).delay[0] - delay
        for delay in 6e-3 + np.linspace(0.0, BLOCK, 40, endpoint=False)
    ]
    assert 100.0 * 343.0 / 2.0 * np.abs(late).max() < 1.2


def test_a_turn_by_a_quarter_moves_an_echo_to_the_next_face():
    for face in range(4):
        bearing = 23.0 + np.degrees(SQUARE.normal[face])
        found = found_in(matched_of(echoes((6e-3, bearing, BEACON, 20, 1.0))))
        row = found.face == face
        assert found.angle[row][0] == pytest.approx(np.radians(23.0), abs=1e-3)
        assert wrap(found.bearing[row][0] - np.radians(bearing)) == pytest.approx(0.0, abs=1e-3)
        assert set(found.face) == {face, (face + 1) % 4}  # the next one hears it at -67 degrees


def test_echoes_separated_by_half_a_call_are_two_snapshots():
    for gap, count in ((8, 2), (6, 1)):  # blocks; half a call is 7
        second = 4e-3 + gap * BLOCK + 0.25 / 35e3  # in quadrature: the energies add
        heard = echoes((4e-3, 0, OWN, 20, 1.0), (second, 0, OWN, 20, 1.0))
        found = found_in(matched_of(heard))
        assert np.count_nonzero((found.face == 0) & (found.caller == OWN)) == count


def test_two_directions_at_one_time_are_two_peaks_down_to_eight_decibels():
    for weaker, count in ((-6.0, 2), (-10.0, 1)):
        heard = echoes((6e-3, -25, OWN, 30, 1.0), (6e-3, 20, OWN, 30 + weaker, 1.0))
        found = found_in(matched_of(heard))
        assert np.count_nonzero(found.face == 0) == count


def test_side_lobes_of_a_clear_echo_make_no_detection_and_a_deeper_limit_lets_them_in():
    count = {}
    for peak_db in (-8.0, -14.0):
        finder = finder_of(peak_db=peak_db)
        seen = [
            np.count_nonzero(
                found_in(matched_of(echoes((6e-3, 5, OWN, 30, 1.0)), key=key), finder).face == 0
            )
            for key in range(100)
        ]
        count[peak_db] = np.mean(seen)
    assert count[-8.0] == 1.0
    assert count[-14.0] > 2.0


@pytest.mark.parametrize("angle", [-88.0, -78.0, 78.0, 85.0])
def test_echoes_along_a_face_are_left_to_its_neighbour(angle):
    found = found_in(matched_of(echoes((6e-3, angle, OWN, 30, 1.0))))
    assert 0 not in found.face
    assert wrap(found.bearing - np.radians(angle)) == pytest.approx(0.0, abs=1e-3)
    assert np.all(np.abs(found.angle) <= np.radians(75.0))


LOUD = [25.0, 40.0, 50.0, 60.0, 80.0]  # SNR of one element [dB]; the direct call's 30 to 60


def calls_alone(tone, snr_db, leakage_db, count=60):
    """Count snapshots of the other tone that one call alone makes, over phases and delays."""
    finder, seen = finder_of(leakage_db=leakage_db), 0
    rng = np.random.default_rng(7)
    for key in range(count):
        delay = START + rng.uniform(0.0, 30.0) * BLOCK
        shift = 1.0 + rng.uniform(-1.0, 1.0) * 0.75 / 343.0
        heard = echoes((delay, rng.uniform(-180.0, 180.0), tone, snr_db, shift))
        seen += snapshots(found_in(matched_of(heard, key=key), finder), 1 - tone)
    return seen


@pytest.mark.parametrize("tone", [OWN, BEACON])
@pytest.mark.parametrize("snr_db", LOUD)
def test_a_single_strong_call_makes_no_detection_in_the_other_tone(tone, snr_db):
    assert calls_alone(tone, snr_db, -28.0) == 0


@pytest.mark.parametrize("tone", [OWN, BEACON])
def test_a_strong_call_without_the_guard_leaks_at_each_edge(tone):
    assert calls_alone(tone, 60.0, -60.0) > 60 * 2  # two faces hear it


@pytest.mark.slow
def test_leakage_lifts_noise_over_the_threshold_only_where_the_guard_begins():
    # 43 dB of energy less 28 is the threshold, and less 33, its leak, the noise's own 10 dB.
    seen = {snr: calls_alone(BEACON, snr, -28.0, 3000) / 3000 for snr in (25.0, 33.0, 37.0, 45.0)}
    assert 0.05 < seen[33.0] < 0.2
    assert max(seen[25.0], seen[37.0], seen[45.0]) < 0.005


def test_a_weak_echo_near_a_loud_call_of_another_tone_is_discarded():
    for snr_db, heard in ((25.0, True), (15.0, False)):  # 45 dB under the call less 28: 17
        both = echoes((6e-3, 10, BEACON, 45, 1.0), (7e-3, -20, OWN, snr_db, 1.0))
        found = found_in(matched_of(both))
        assert np.any((found.caller == OWN) & (found.face == 0)) == heard


def test_matched_filters_give_an_echo_the_gain_of_its_samples():
    heard = replace(echoes((START + 5 * BLOCK, 0, OWN, 0, 1.0)), level_db=np.array([3.0]))
    energy = np.sum(np.abs(matched_of(heard)[:, 0, OWN]) ** 2, axis=-1)
    assert energy.argmax() == 5
    assert energy.max() == pytest.approx(10.0 * SAMPLES * 10.0**0.3, rel=1e-9)
    off = replace(heard, delay=heard.delay + 0.5 * BLOCK)  # between two lags: 0.32 dB less
    energy_off = np.sum(np.abs(matched_of(off)[:, 0, OWN]) ** 2, axis=-1)
    assert energy_off.max() == pytest.approx((1.0 - 0.5 / 14.0) ** 2 * energy.max(), rel=1e-9)


def test_a_record_shorter_than_the_call_holds_nothing():
    found = found_in(matched_of(echoes((6e-3, 0, OWN, 30, 1.0)), blocks=SETTLED.pulse - 1))
    columns = [getattr(found, f.name) for f in fields(Detections) if f.name != "direct"]
    assert all(column.size == 0 for column in columns)
    assert found.direct.detection.tolist() == [-1, -1]
    assert np.isnan([found.direct.delay, found.direct.delay_std]).all()


def test_a_crowd_of_detections_finds_room():
    rng = np.random.default_rng(7)
    crowd = [(START + 9 * k * BLOCK, rng.uniform(-180, 180), k % 2, 12.0, 1.0) for k in range(300)]
    found = found_in(matched_of(echoes(*crowd), blocks=2800, key=1))
    assert found.face.size > 256  # twice the room's first size


TRIO = sampling(
    CONFIG, (*CALLERS, Caller(name="whistle", frequency=25e3, level_db=40.0, place=np.ones(2)))
)


def found_of_trio(leakage_db, *rows):
    """Return detections, with three tones, of rows (delay, bearing [deg], caller, SNR [dB])."""
    delay, bearing, caller, snr_db = map(np.array, zip(*rows, strict=True))
    heard = Arrivals(
        delay=delay.astype(float),
        level_db=snr_db - 10.0 * np.log10(SAMPLES),
        bearing=np.radians(bearing),
        frequency=TRIO.tones[caller],
        caller=caller.astype(np.int8),
        landmark=np.arange(1, len(rows) + 1),
    )
    sums = np.zeros((60, 4, 3, 10), dtype=complex)
    add_echo_blocks(sums, heard, SQUARE, TRIO)
    matched = filtered(sums, TRIO)
    config = Config(detection=DetectionConfig(leakage_db=leakage_db))
    return found_in(matched, detector(config, SQUARE, TRIO.tones))


@pytest.mark.parametrize("caller", [0, 1, 2])
def test_a_strong_call_of_three_tones_is_detected_only_in_its_tone(caller):
    call = (6.03e-3, 20, caller, 50.0)
    assert set(found_of_trio(-28.0, call).caller.tolist()) == {caller}
    assert set(found_of_trio(-60.0, call).caller.tolist()) == {0, 1, 2}


def test_the_guard_is_against_the_strongest_of_three_tones():
    for loud in (1, 2):
        for snr_db, heard in ((25.0, True), (15.0, False)):  # 45 dB under the call less 28: 17
            rows = [(7e-3, -20, 0, snr_db), (6e-3, 10, loud, 45.0), (6e-3, 10, 3 - loud, 20.0)]
            found = found_of_trio(-28.0, *rows)
            assert np.any((found.caller == 0) & (found.face == 0)) == heard


def test_each_of_three_calls_is_found_only_in_its_tone():
    rows = [(6e-3, 20, 0, 20.0), (6.1e-3, -30, 1, 20.0), (6.2e-3, 0, 2, 20.0)]
    found = found_of_trio(-28.0, *rows)
    front = found.face == 0
    for _, bearing, caller, _ in rows:
        (angle,) = found.angle[front & (found.caller == caller)]
        assert angle == pytest.approx(np.radians(bearing), abs=2e-3)


# A run above the threshold as one snapshot


def test_echoes_of_one_direction_that_overlap_are_two_maxima_and_one_run():
    apart = 0.8 * SETTLED.pulse * BLOCK
    pair = echoes((0.02, 0.0, OWN, 20.0, 1.0), (0.02 + apart, 0.0, OWN, 17.0, 1.0))
    matched = matched_of(pair, blocks=160)
    assert found_in(matched).face.tolist() == [0, 0]
    one = found_in(matched, finder_of(snapshots="runs"))
    assert one.face.tolist() == [0]
    assert one.delay == pytest.approx([0.02], abs=2e-4)  # the louder one's


def test_two_echoes_of_one_run_from_two_directions_each_keep_their_time_of_arrival():
    apart = 0.8 * SETTLED.pulse * BLOCK
    pair = echoes((0.02, -10.0, OWN, 20.0, 1.0), (0.02 + apart, 20.0, OWN, 17.0, 1.0))
    found = found_in(matched_of(pair, blocks=160), finder_of(snapshots="runs"))
    front = found.face == 0
    order = np.argsort(found.bearing[front])
    np.testing.assert_allclose(np.degrees(found.bearing[front][order]), [-10.0, 20.0], atol=0.5)
    np.testing.assert_allclose(found.delay[front][order], [0.02, 0.02 + apart], atol=2e-4)
    strongest = found_in(matched_of(pair, blocks=160), finder_of(snapshots="runs", peak_db=0.0))
    assert np.degrees(strongest.bearing[strongest.face == 0]) == pytest.approx([-10.0], abs=0.5)


def test_leakage_into_a_run_is_excluded_and_the_adjacent_echo_kept():
    rows = [(0.02, 20.0, BEACON, 52.0, 1.0), (0.0245, -30.0, OWN, 30.0, 1.0)]
    matched = matched_of(echoes(*rows), blocks=160)
    energy = np.sum(np.abs(matched) ** 2, axis=3)[:, 0, OWN]
    runs = np.count_nonzero(np.diff((energy > FINDER.threshold).astype(int)) == 1)
    assert runs == 1
    found = found_in(matched, finder_of(snapshots="runs"))
    own = (found.face == 0) & (found.caller == OWN)
    assert np.degrees(found.bearing[own]) == pytest.approx([-30.0], abs=1.0)


def test_echoes_far_from_each_other_are_the_same_by_runs_and_by_maxima():
    far = echoes((0.008, 0.0, OWN, 20.0, 1.0), (0.02, 20.0, OWN, 20.0, 1.0))
    matched = matched_of(far, blocks=160)
    one, other = found_in(matched), found_in(matched, finder_of(snapshots="runs"))
    assert one.face.tolist() == other.face.tolist()
    np.testing.assert_allclose(one.bearing, other.bearing, atol=2e-3)
    np.testing.assert_allclose(one.delay, other.delay, atol=1e-5)
