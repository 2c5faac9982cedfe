"""What an array can tell of a bearing: widths, lobes and doubles against closed forms."""

import numpy as np
import pytest
from scipy.special import j0

from pipistrelle.arrays.beamforming import beam_power, beampattern, bearing_bound, pattern_of
from pipistrelle.arrays.layout import microphones_of, scattered

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
