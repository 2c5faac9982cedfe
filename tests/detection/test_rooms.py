"""Point sources as pyroomacoustics propagates them: bearings and delays against their bounds."""

import numpy as np
import pytest
from scipy.stats import chi2

from reference.rooms import ARRAYS, errors


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def test_bearings_and_delays_of_a_far_source_meet_their_bounds():
    bearing, delay, *_ = errors("circle", 20.0, 4, 15)
    assert len(bearing) == 60
    most = np.sqrt(chi2.ppf(1.0 - 1e-4, 60) / 60)
    assert rms(bearing) < 1.05 * most
    assert rms(delay) < 1.1 * most


def test_of_channels_in_another_order_nothing_is_where_it_is():
    swapped, *_ = errors("circle", 20.0, 4, 3, order=[1, 0, 2, 3, 4, 5, 6, 7])
    assert rms(swapped) > 3.0


@pytest.mark.slow
@pytest.mark.parametrize("snr_db", [10.0, 15.0, 20.0, 25.0, 30.0])
@pytest.mark.parametrize("name", ARRAYS)
def test_bearings_are_unbiased_and_within_a_fifth_of_their_bounds(name, snr_db):
    bearing, delay, bearing_stated, delay_stated = errors(name, snr_db, 25, 30)
    assert len(bearing) > 700
    assert rms(bearing) < 1.2
    assert rms(bearing_stated) < 1.2
    assert abs(bearing.mean()) < 4.0 * bearing.std() / np.sqrt(bearing.size)
    late = abs(delay.mean()) - 4.0 * delay.std() / np.sqrt(delay.size)
    assert late < (0.4 if name == "square" else 0.0)
    if name == "square":  # its fast scan takes a call to reach a whole face at once
        assert rms(delay) < 1.7
    elif snr_db >= 20.0:
        assert rms(delay) < 1.2
    else:  # the edges of a tone are jumps: near the threshold no bound of this kind is met
        assert rms(delay) < 1.6
        assert rms(delay_stated) < 1.2
