"""None"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.special import j0

from pipistrelle.arrays.beamforming import (
    beam_power,
    beampattern,
    beamscan,
    bearing_bound,
    pattern_of,
    steering_vector,
)
from pipistrelle.arrays.layout import microphones_of, scattered, square_of_four
from pipistrelle.config import ReceiverConfig

law = settings(deadline=None, max_examples=60)
POSITION = square_of_four(ReceiverConfig()).position
ANGLES = st.floats(-1.5, 1.5)
TONES = st.sampled_from([30e3, 35e3])
HORIZON = np.radians(np.linspace(-90.0, 90.0, 3601))


def ears(frequency, position=POSITION):
    return {"position": position, "frequency": frequency, "speed_of_sound": 343.0}


def lobes(steered, frequency, position=POSITION):
    """Return power and angle of a beampattern's interior maxima other than the steered one."""
    power = beampattern(HORIZON, steered=steered, **ears(frequency, position))
    top = 1 + np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:]))
    aside = np.abs(HORIZON[top] - steered) > np.radians(0.5)
    return power[top[aside]], HORIZON[top[aside]]


@given(angle=ANGLES, frequency=TONES)
@law
def test_a_steering_vector_has_the_geometric_lead_of_each_element(angle, frequency):
    toward = np.array([np.cos(angle), np.sin(angle)])  # of the source
    lead = np.column_stack((np.zeros(POSITION.size), POSITION)) @ toward / 343.0
    wave = steering_vector(angle, **ears(frequency))
    np.testing.assert_allclose(wave, np.exp(2j * np.pi * frequency * lead), atol=1e-12)


def test_steering_keeps_the_shape_of_its_angles_and_adds_the_elements():
    assert steering_vector(np.zeros((3, 2)), **ears(35e3)).shape == (3, 2, 10)
    np.testing.assert_array_equal(steering_vector(0.0, **ears(35e3)), np.ones(10))


@given(steered=ANGLES, angle=ANGLES, frequency=TONES)
@law
def test_a_beampattern_is_one_where_steered_never_more_and_reciprocal(steered, angle, frequency):
    there = beampattern(np.array([steered, angle]), steered=steered, **ears(frequency))
    back = beampattern(np.array([steered]), steered=angle, **ears(frequency))
    assert there[0] == pytest.approx(1.0, abs=1e-12)
    assert -1e-15 <= there[1] <= 1.0 + 1e-12
    assert there[1] == pytest.approx(back[0], abs=1e-12)


@given(steered=ANGLES, angle=ANGLES, frequency=TONES)
@law
def test_a_beampattern_is_the_squared_dirichlet_kernel_of_the_phase_between_neighbours(
    steered, angle, frequency
):
    turn = 2.0 * np.pi * frequency * 0.0049 / 343.0 * (np.sin(angle) - np.sin(steered))
    exact = 1.0 if abs(np.sin(turn / 2)) < 1e-9 else (np.sin(5 * turn) / 10 / np.sin(turn / 2)) ** 2
    found = beampattern(np.array([angle]), steered=steered, **ears(frequency))
    assert found[0] == pytest.approx(exact, abs=1e-9)


def test_the_half_power_beamwidth_of_ten_half_wavelengths_is_10_2_degrees():
    def below(angle):
        return float(beampattern(np.array([angle]), steered=0.0, **ears(35e3))[0]) - 0.5

    width = 2.0 * np.degrees(brentq(below, 0.0, np.radians(10.0)))
    assert width == pytest.approx(10.2, abs=0.05)


@pytest.mark.parametrize("frequency", [30e3, 35e3])
def test_side_lobes_stay_13_db_down_and_no_grating_lobe_rises_for_any_steering_to_80(frequency):
    for steered in np.radians(np.arange(-80.0, 80.1, 2.5)):
        power, _ = lobes(steered, frequency)
        assert 10.0 * np.log10(power.max()) < -12.9


def test_elements_spaced_for_30_khz_raise_a_grating_lobe_at_35_khz():
    wide = POSITION * (35.0 / 30.0)
    assert lobes(np.radians(40.0), 35e3, wide)[0].max() < 0.1
    power, angle = lobes(np.radians(60.0), 35e3, wide)
    assert power.max() == pytest.approx(1.0, abs=1e-3)
    alias = np.arcsin(np.sin(np.radians(60.0)) - 2.0 * 30.0 / 35.0)
    assert angle[power.argmax()] == pytest.approx(alias, abs=np.radians(0.1))


def test_a_main_lobe_at_80_degrees_wraps_to_the_other_end():
    # Half a wavelength apart, -90 degrees looks like +90: 10 degrees beyond where it is steered.
    power = beampattern(np.radians([-90.0, 90.0]), steered=np.radians(80.0), **ears(35e3))
    assert power[0] == pytest.approx(power[1], abs=1e-9)
    assert power[0] > 0.9


@given(angle=ANGLES, frequency=TONES, seed=st.integers(0, 2**32 - 1))
@law
def test_a_beamscan_of_a_wave_is_the_beampattern_and_scales_with_its_power(angle, frequency, seed):
    z = complex(*np.random.default_rng(seed).standard_normal(2))
    scan = beamscan(z * steering_vector(angle, **ears(frequency)), HORIZON, **ears(frequency))
    pattern = beampattern(HORIZON, steered=angle, **ears(frequency))
    np.testing.assert_allclose(scan, 100.0 * abs(z) ** 2 * pattern, atol=1e-9 * abs(z) ** 2)


@pytest.mark.parametrize("frequency", [30e3, 35e3])
def test_a_beamscan_is_the_steered_response_power_of_pyroomacoustics(frequency):
    from pyroomacoustics.doa import SRP

    rng = np.random.default_rng(7)
    grid = np.radians(np.arange(-80.0, 80.1, 0.5))
    plane = np.vstack((np.zeros(POSITION.size), POSITION))
    peer = SRP(plane, 200e3, 40, c=343.0, num_src=1, azimuth=grid)
    bin_ = round(frequency * 40 / 200e3)
    for angle in np.radians([-80.0, -71.3, -33.0, 0.0, 12.4, 55.5, 79.0]):
        noise = 0.3 * rng.standard_normal(20).view(complex)
        heard = steering_vector(angle, **ears(frequency)) + noise
        heard = heard / np.abs(heard)  # its phase transform does so
        spectrum = np.zeros((10, 21, 1), dtype=complex)
        spectrum[:, bin_, 0] = heard
        peer.locate_sources(spectrum, freq_bins=np.array([bin_]))
        scan = beamscan(heard, grid, **ears(frequency))
        ratio = peer.grid.values / scan
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-6)
        assert peer.azimuth_recon[0] == pytest.approx(grid[scan.argmax()], abs=1e-9)


@pytest.mark.parametrize("snr", [1.0, 10.0, 1000.0])
@pytest.mark.parametrize("angle_deg", [-70.0, 0.0, 40.0])
def test_the_bearing_bound_is_the_inverse_of_fishers_information(snr, angle_deg):
    # Unknowns: bearing, amplitude and phase of one snapshot in unit complex noise.
    angle, step, amplitude = np.radians(angle_deg), 1e-6, np.sqrt(snr) * np.exp(0.7j)
    wave = {"frequency": 30e3, "speed_of_sound": 343.0, "position": POSITION}
    there, here = steering_vector(angle + step, **wave), steering_vector(angle - step, **wave)
    by_angle = amplitude * (there - here) / (2.0 * step)
    steered = steering_vector(angle, **wave)
    slope = np.column_stack((by_angle, steered, 1j * steered))
    information = 2.0 * (slope.conj().T @ slope).real
    bound = bearing_bound(snr, angle, elements=10, spacing=0.0049, wavelength=343.0 / 30e3)
    assert bound == pytest.approx(np.sqrt(np.linalg.inv(information)[0, 0]), rel=1e-7)


WAVE = {"frequency": 35e3, "speed_of_sound": 343.0}
LENGTH = 343.0 / 35e3


def rows(places, face=""):
    return scattered(microphones_of([(x, y, 0.0, 0.0, face) for x, y in places]))


HALF_WAVE = [(0.0, 0.5 * LENGTH * i) for i in range(10)]


def test_a_lines_beam_matches_the_beampattern_of_a_line():
    line, angle = rows(HALF_WAVE), np.radians(np.linspace(-80.0, 80.0, 41))
    known = beampattern(angle, steered=0.3, position=np.array(HALF_WAVE)[:, 1], **WAVE)
    assert np.allclose(beam_power(line, 0, 0.3, angle, **WAVE), known)


def test_many_microphones_on_a_circle_have_bessels_beam():
    turn, radius = 2.0 * np.pi * np.arange(64) / 64, 0.02
    ring = rows(radius * np.column_stack((np.cos(turn), np.sin(turn))))
    off = np.linspace(-1.0, 1.0, 41)
    argument = 2.0 * (2.0 * np.pi / LENGTH) * radius * np.sin(0.5 * off)
    assert np.allclose(beam_power(ring, 0, 0.7, 0.7 + off, **WAVE), j0(argument) ** 2, atol=1e-9)
    found = pattern_of(ring, 0, **WAVE)
    assert found.lobe_db == pytest.approx(20.0 * np.log10(0.4028), abs=0.05)
    assert found.alike == 0.0


def test_only_a_free_line_has_ambiguous_bearings():
    free, faced = (pattern_of(rows(HALF_WAVE, face), 0, **WAVE) for face in ("", "front"))
    assert free.alike > 0.9  # near its axis a bearing and its double are one lobe
    assert faced.alike == 0.0
    assert free.far_field == pytest.approx(2.0 * (4.5 * LENGTH) ** 2 / LENGTH)
    known = bearing_bound(100.0, 0.0, elements=10, spacing=0.5, wavelength=1.0)
    assert faced.std[0] == pytest.approx(known, rel=1e-3)


def test_a_face_with_full_wavelength_spacing_has_ambiguous_bearings():
    wide = pattern_of(rows([(0.0, LENGTH * i) for i in range(10)], "front"), 0, **WAVE)
    assert wide.alike > 0.9
    first, other = np.sin(wide.worst)
    assert abs(first - other) == pytest.approx(1.0, abs=0.02)


def test_width_is_where_half_the_power_is():
    line = rows(HALF_WAVE, "front")
    width = pattern_of(line, 0, **WAVE).width[0]
    (edge,) = beam_power(line, 0, 0.0, np.array([0.5 * width]), **WAVE)
    assert edge == pytest.approx(0.5, abs=0.03)
