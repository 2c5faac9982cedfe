from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import InputError
from pipistrelle.detection.noise import ConstantNoise
from pipistrelle.detection.scans import COLUMNS, OWN, labelled, make_scan, rows_of, with_columns


def test_rows_of_a_scan_keep_all_their_columns_and_the_time():
    scan = make_scan(0.5, **{name: np.arange(4) + 10 * i for i, name in enumerate(COLUMNS)})
    some = rows_of(scan, np.array([True, False, True, False]))
    assert some.time == 0.5
    for i, name in enumerate(COLUMNS):
        assert getattr(some, name).tolist() == [10 * i, 10 * i + 2]
    assert rows_of(scan, np.zeros(4, dtype=bool)).landmark.size == 0


def test_a_column_that_no_scan_has_and_columns_of_several_lengths_are_refused():
    label, bearing = np.array([3, 4]), np.array([0.1, 0.2])
    with pytest.raises(InputError, match="scan: no such column bearing_sd; expected one of"):
        make_scan(0.5, label, bearing, bearing_sd=0.1)
    for wrong in ({"bearing": bearing[:1]}, {"bearing": bearing, "range": np.ones(3)}):
        with pytest.raises(InputError, match=r"expected \(2,\), that of landmark"):
            make_scan(0.5, label, **wrong)
    for wrong, kind in (({"landmark": [3.5, 4.0]}, "whole numbers"), ({"range": "4"}, "numbers")):
        with pytest.raises(InputError, match=f"expected {kind}"):
            make_scan(0.5, **({"landmark": label, "bearing": bearing} | wrong))
    for ragged in ({"landmark": [[1], [2, 3]]}, {"bearing": [[1.0], [2.0, 3.0]]}):
        with pytest.raises(InputError, match="rows of unlike lengths for"):
            make_scan(0.5, **({"landmark": label, "bearing": bearing} | ragged))
    assert make_scan(0.5, [3, 4], [0, 1]).bearing.dtype == np.float64


def test_unset_columns_of_a_scan_are_nan():
    scan = make_scan(0.5, np.array([3, 4]), np.array([0.1, 0.2]), range=2.0)
    assert scan.range.tolist() == [2.0, 2.0]
    assert scan.caller.tolist() == [OWN, OWN]
    for name in set(COLUMNS) - {"landmark", "caller", "bearing", "range"}:
        assert np.isnan(getattr(scan, name)).all(), name


def test_columns_are_replaced_and_checked_in_a_copy():
    scan = make_scan(0.5, np.array([3, 4]), np.array([0.1, 0.2]), range=2.0)
    other = with_columns(scan, bearing=-scan.bearing, caller=1)
    assert (other.bearing.tolist(), other.caller.tolist()) == ([-0.1, -0.2], [1, 1])
    assert (scan.bearing.tolist(), scan.caller.tolist()) == ([0.1, 0.2], [OWN, OWN])
    assert (other.time, other.range.tolist()) == (0.5, [2.0, 2.0])
    whole = make_scan(0.5, **{name: np.arange(4) + 10 * i for i, name in enumerate(COLUMNS)})
    for i, replaced in enumerate(COLUMNS):
        changed = with_columns(whole, **{replaced: 99})
        for j, name in enumerate(COLUMNS):
            expected = np.full(4, 99) if i == j else np.arange(4) + 10 * j
            assert getattr(changed, name).tolist() == expected.tolist()
    with pytest.raises(InputError, match="scan: no such column ranges"):
        with_columns(scan, ranges=1.0)


def test_the_memory_order_of_the_numbers_makes_no_difference():
    scan = make_scan(0.5, np.array([3, 4, 3]), np.array([0.1, 0.2, 0.3]), bearing_std=0.1)
    other = replace(scan, numbers=np.asfortranarray(scan.numbers))
    noise = ConstantNoise(range_std=0.2, bearing_std=0.15, excess_path_std=0.3)
    for change in (noise, lambda scan: labelled(scan, np.array([1, 2, 1]))):
        np.testing.assert_array_equal(change(other).numbers, change(scan).numbers)
