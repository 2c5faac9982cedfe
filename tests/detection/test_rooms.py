"""A recording that pyroomacoustics made, heard: bearings and delays against their bounds."""

import numpy as np
import pytest
from scipy.stats import chi2

from reference.rooms import ARRAYS, errors


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def test_bearings_and_delays_of_a_far_source_meet_their_bounds(tmp_path):
    bearing, delay, *_ = errors(tmp_path / "tape", "circle", 20.0, 15, 4)
    assert len(bearing) == 60
    most = np.sqrt(chi2.ppf(1.0 - 1e-4, 60) / 60)
    assert rms(bearing) < 1.05 * most
    assert rms(delay) < 1.1 * most


def test_swapped_channels_give_wrong_positions(tmp_path):
    order = [1, 0, 2, 3, 4, 5, 6, 7]
    swapped, *_ = errors(tmp_path / "tape", "circle", 20.0, 12, 1, order=order)
    assert rms(swapped) > 3.0


@pytest.mark.slow
@pytest.mark.parametrize("snr_db", [10.0, 15.0, 20.0, 25.0, 30.0])
@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("call", ["tone", "sweep"])
def test_rows_are_unbiased_and_within_a_fifth_of_their_bounds(tmp_path, name, snr_db, call):
    of_each = errors(tmp_path / "tape", name, snr_db, 60, 10, call=call)
    bearing, delay, bearing_stated, delay_stated = of_each
    assert len(bearing) == 600
    assert rms(bearing) < (1.2 if call == "tone" else 1.1)
    assert rms(bearing_stated) < (1.2 if call == "tone" else 1.1)
    for off in (bearing, delay):
        assert abs(off.mean()) < 4.0 * off.std() / np.sqrt(off.size)
    if call == "sweep":
        assert rms(delay) < 1.1
    elif name == "square":  # its fast scan takes a call to reach a whole face at once
        assert rms(delay) < (1.6 if snr_db <= 20.0 else 2.1)
    elif snr_db >= 20.0:
        assert rms(delay) < 1.2
    else:  # the edges of a tone are jumps: near the threshold no bound of this kind is met
        assert rms(delay) < 1.6
        assert rms(delay_stated) < 1.2
