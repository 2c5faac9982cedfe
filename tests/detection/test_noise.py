import numpy as np
import pytest

from pipistrelle.config import FilterConfig
from pipistrelle.detection.noise import ConstantNoise, noise_of
from pipistrelle.detection.scans import COLUMNS
from reference.missions import scan_with

NAN = np.nan


def test_rows_that_say_nothing_get_the_constant_and_those_that_do_keep_what_they_say():
    scan = scan_with(
        [3, 8, 9], [0.1, 0.2, 0.3], [2.0, NAN, 4.0],
        bearing_std=np.array([NAN, 0.02, NAN]), range_std=np.array([0.5, NAN, NAN]),
    )  # fmt: skip
    noisy = ConstantNoise(range_std=0.2, bearing_std=0.15)(scan)
    assert noisy.bearing_std.tolist() == [0.15, 0.02, 0.15]
    assert noisy.range_std.tolist() == [0.5, 0.2, 0.2]


def test_noise_changes_nothing_but_the_standard_deviations():
    scan = scan_with([3, 8], [0.1, 0.2], [2.0, NAN], bearing_std=NAN, range_std=NAN, level_db=7.0)
    noisy = ConstantNoise(range_std=0.2, bearing_std=0.15)(scan)
    for name in set(COLUMNS) - {"bearing_std", "range_std"}:
        np.testing.assert_array_equal(getattr(noisy, name), getattr(scan, name))
    assert np.isnan(scan.bearing_std).all(), "the scan itself stays as it was"


@pytest.mark.parametrize(("range_std", "bearing_std"), [(0.2, 0.15), (1.0, 0.01)])
def test_the_noise_of_the_settings_is_theirs(range_std, bearing_std):
    noise = noise_of(FilterConfig(range_std=range_std, bearing_std=bearing_std))
    assert noise == ConstantNoise(range_std=range_std, bearing_std=bearing_std)
    assert hash(noise) == hash(noise_of(FilterConfig(range_std=range_std, bearing_std=bearing_std)))
