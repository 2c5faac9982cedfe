from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import Config, FilterConfig
from pipistrelle.detection.front_end import FrameMeasurements, average_faces
from pipistrelle.detection.noise import (
    BEARING_FLOOR,
    RANGE_FLOOR,
    ConstantNoise,
    noise_of,
    without_hidden,
)
from pipistrelle.detection.scans import COLUMNS, with_columns
from pipistrelle.detection.snapshots import Detections
from pipistrelle.experiments.runs.heard_world import scans_of
from reference.missions import scan_with

NAN = np.nan


def test_constant_noise_fills_only_missing_deviations():
    scan = scan_with(
        [3, 8, 9], [0.1, 0.2, 0.3], [2.0, NAN, 4.0],
        bearing_std=np.array([NAN, 0.02, NAN]), range_std=np.array([0.5, NAN, NAN]),
        excess_path_std=np.array([NAN, NAN, 0.1]),
    )  # fmt: skip
    noisy = ConstantNoise(range_std=0.2, bearing_std=0.15, excess_path_std=0.3)(scan)
    assert noisy.bearing_std.tolist() == [0.15, 0.02, 0.15]
    assert noisy.range_std.tolist() == [0.5, 0.2, 0.2]
    assert noisy.excess_path_std.tolist() == [0.3, 0.3, 0.1]


def test_noise_changes_nothing_but_the_standard_deviations():
    scan = scan_with([3, 8], [0.1, 0.2], [2.0, NAN], bearing_std=NAN, range_std=NAN, level_db=7.0)
    noisy = ConstantNoise(range_std=0.2, bearing_std=0.15, excess_path_std=0.3)(scan)
    for name in set(COLUMNS) - {"bearing_std", "range_std", "excess_path_std"}:
        np.testing.assert_array_equal(getattr(noisy, name), getattr(scan, name))
    assert np.isnan(scan.bearing_std).all(), "the scan itself stays as it was"


@pytest.mark.parametrize("stds", [(0.2, 0.15, 0.4), (1.0, 0.01, 0.03)])
def test_the_noise_of_the_settings_is_theirs(stds):
    told = dict(zip(("range_std", "bearing_std", "excess_path_std"), stds, strict=True))
    noise = noise_of(FilterConfig(**told))
    assert noise == ConstantNoise(**told, instead=True)
    assert noise_of(FilterConfig(**told, noise="measured")) == ConstantNoise(**told)
    assert hash(noise) == hash(noise_of(FilterConfig(**told)))


def test_constant_noise_hides_measured_but_keeps_stated_deviations():
    heard = scan_with([3, 8], [0.1, 0.2], [2.0, NAN], bearing_std=0.02, range_std=0.1)
    stated = with_columns(heard, range=np.array([2.0, 9.0]), range_std=np.array([0.1, 1.8]))
    noise = ConstantNoise(range_std=0.2, bearing_std=0.15, excess_path_std=0.3, instead=True)
    given = noise(noise.hidden(heard, stated))
    assert given.bearing_std.tolist() == [0.15, 0.15]
    assert given.range_std.tolist() == [0.2, 1.8]
    assert given.range.tolist() == [2.0, 9.0]
    assert replace(noise, instead=False).hidden(heard, stated) is stated


def test_the_excess_path_std_is_twice_the_range_std():
    noise = noise_of(FilterConfig())
    assert noise.excess_path_std == 2.0 * noise.range_std


# What the signal tells

TOLD = np.array([[0.003, 0.01, 0.02, 0.0], [0.004, NAN, NAN, 0.0]])
HEARD = average_faces(
    0.5,
    Detections(
        face=np.zeros(4, int), caller=np.array([0, 1, 2, 0]), angle=np.zeros(4),
        bearing=np.array([0.1, 0.14, 0.3, -1.0]), delay=np.array([0.01, 0.02, 0.03, 0.04]),
        power=np.full(4, 20.0), bearing_std=TOLD[0], delay_std=TOLD[1] / 171.5,
    ),
    np.array([3, 3, 8, 9]), averaging="plain", speed_of_sound=343.0,
)  # fmt: skip
ROWS = HEARD.rows


def test_deviations_combine_the_signals_with_the_callers_floor():
    own, other = BEARING_FLOOR
    expected = np.hypot(TOLD[0], [own, other, other, own])
    np.testing.assert_allclose(ROWS.bearing_std, expected, rtol=1e-12)
    expected = [np.hypot(0.004, RANGE_FLOOR), NAN, NAN, RANGE_FLOOR]
    np.testing.assert_allclose(ROWS.range_std, expected, rtol=1e-12)
    assert own < other, "another's echoes come at all times, and overlap more"


def settled(noise):
    return Config(filter=FilterConfig(noise=noise, range_std=0.2, bearing_std=0.15))


def heard_with(**columns):
    return [FrameMeasurements(rows=with_columns(ROWS, **columns), clutter=2)]


@pytest.mark.parametrize("strategy", ["active", "fused", "passive"])
def test_constant_noise_ignores_the_detectors_deviations_to_the_bit(strategy):
    sure = scans_of([HEARD], strategy, settled("constant"))
    unsure = heard_with(bearing_std=NAN, range_std=NAN, excess_path_std=NAN)
    for one, other in zip(sure, scans_of(unsure, strategy, settled("constant")), strict=True):
        for name in COLUMNS:
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
        assert set(one.bearing_std.tolist()) == {0.15}


def test_measured_noise_merges_deviations_and_fills_gaps_with_constants():
    unsure = np.array([False, False, False, True])
    heard = heard_with(
        bearing_std=np.where(unsure, NAN, ROWS.bearing_std),
        range_std=np.where(unsure, NAN, ROWS.range_std),
    )
    (scan,) = scans_of(heard, "fused", settled("measured"))
    own, other = np.hypot(TOLD[0, :2], BEARING_FLOOR)
    both = 1.0 / np.hypot(1.0 / own, 1.0 / other)
    assert scan.landmark.tolist() == [3, 8, 9]
    expected = [both, np.hypot(0.02, BEARING_FLOOR[1]), 0.15]
    np.testing.assert_allclose(scan.bearing_std, expected, rtol=1e-12)
    np.testing.assert_allclose(scan.range_std, [np.hypot(0.004, RANGE_FLOOR), 0.2, 0.2], rtol=1e-12)


def test_measured_noise_merges_rows_by_their_inverse_variances_and_constant_noise_plainly():
    mean = np.average(ROWS.bearing[:2], weights=1.0 / np.square(ROWS.bearing_std[:2]))
    (scan,) = scans_of([HEARD], "fused", settled("measured"))
    assert scan.bearing[0] == pytest.approx(mean, rel=1e-12)
    assert abs(mean - 0.1) < 0.2 * abs(mean - 0.14), "the vehicle's own call is the surer one"
    (scan,) = scans_of([HEARD], "fused", settled("constant"))
    assert scan.bearing[0] == pytest.approx(0.12, rel=1e-12)


@pytest.mark.parametrize("timing", [False, True])
@pytest.mark.parametrize("noise", ["constant", "measured"])
def test_settings_hide_only_their_columns_from_an_estimator(noise, timing):
    rows = replace(
        with_columns(
            ROWS, bearing_slope=0.5, excess_path=np.array([NAN, 4.0, NAN, NAN]), excess_path_std=0.1
        ),
        callers=np.array([-1, 51, 52]),
    )
    calibrate = ("speed_of_sound",) if timing else ("speed_scale",)
    known = without_hidden(rows, FilterConfig(noise=noise, calibrate=calibrate), timing=timing)
    hidden = {"bearing_std", "range_std", "excess_path_std"} if noise == "constant" else set()
    hidden |= set() if timing else {"bearing_slope"}
    hidden |= set() if timing else {"excess_path", "excess_path_std"}
    for name in COLUMNS:
        expected = np.full(4, NAN) if name in hidden else getattr(rows, name)
        np.testing.assert_array_equal(getattr(known, name), expected)
    assert known.callers.tolist() == ([-1, 51, 52] if timing else [])
