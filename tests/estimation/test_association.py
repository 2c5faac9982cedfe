from itertools import permutations

import numpy as np
import pytest

from pipistrelle.config import InputError
from pipistrelle.detection.merging import labelled
from pipistrelle.detection.scans import UNLABELLED, make_scan
from pipistrelle.estimation.association import known_labels
from reference.missions import scan_of, scan_with

NAN = np.nan


def test_what_was_told_is_taken_as_it_is_and_costs_no_copy():
    scan = scan_of((3, 5.0, 0.3), (8, NAN, 1.0))
    assert labelled(scan, known_labels(None, scan)) is scan


def test_a_row_that_nobody_labelled_never_reaches_a_filter():
    scan = scan_of((3, 5.0, 0.3), (UNLABELLED, NAN, 1.0), (UNLABELLED, 2.0, 2.0))
    assert labelled(scan, known_labels(None, scan)).landmark.tolist() == [3]


def test_rows_of_one_label_become_one_whatever_their_order():
    rows = [(7, 4.0, 0.2), (7, NAN, 0.5), (7, NAN, -0.1), (2, 3.0, 1.0)]
    for order in permutations(rows):
        label, distance, bearing = zip(*order, strict=True)
        one = labelled(scan_with(np.full(4, UNLABELLED), bearing, distance), np.array(label))
        assert sorted(one.landmark.tolist()) == [2, 7]
        at = one.landmark.tolist().index(7)
        assert one.bearing[at] == pytest.approx(0.2, abs=1e-12)
        assert one.range[at] == 4.0


def test_rows_without_a_bearing_stand_at_the_end_whatever_their_order():
    rows = [(4, 0.3, 3.0, 1), (4, NAN, 3.0, 2), (5, 0.9, 2.0, 1)]
    for order in permutations(rows):
        label, bearing, excess_path, caller = map(np.array, zip(*order, strict=True))
        scan = make_scan(0.0, label, bearing, caller=caller, excess_path=excess_path)
        one = labelled(scan, scan.landmark)
        assert np.isnan(one.bearing).tolist() == [False, False, True]
        assert (one.landmark[2], one.caller[2]) == (4, 2)
        assert labelled(one, one.landmark) is one


def test_the_mean_of_directions_is_taken_across_the_cut_behind():
    scan = scan_with([5, 5], [np.pi - 0.1, -np.pi + 0.3], [NAN, NAN])
    (bearing,) = labelled(scan, scan.landmark).bearing
    assert bearing == pytest.approx(-np.pi + 0.1, abs=1e-12)


def test_rows_that_say_how_sure_they_are_merge_as_independent_estimates_do():
    rng, stds = np.random.default_rng(5), np.array([0.01, 0.03, 0.02])
    drawn = rng.normal(0.0, stds, (4000, 3))
    scans = [make_scan(0.0, np.full(3, 4), row, bearing_std=stds) for row in drawn]
    merged = [labelled(scan, scan.landmark) for scan in scans]
    error = np.array([scan.bearing[0] for scan in merged])
    claimed = merged[0].bearing_std[0]
    assert claimed == pytest.approx(np.sum(stds**-2.0) ** -0.5, rel=1e-12)
    assert np.std(error) == pytest.approx(claimed, rel=4.9 / np.sqrt(2 * error.size))


def test_one_row_that_says_nothing_of_its_noise_makes_the_mean_plain_and_unsaid():
    scan = make_scan(0.0, np.full(2, 4), np.array([0.1, 0.3]), bearing_std=np.array([0.01, NAN]))
    merged = labelled(scan, scan.landmark)
    assert merged.bearing[0] == pytest.approx(0.2, abs=1e-12)
    assert np.isnan(merged.bearing_std[0])


@pytest.mark.parametrize(
    "label", [[1], [1, 2, 3, 4], [1.0, 2.0, 3.0], [1, NAN, 2], [1, 2, -2], [[1], [2], [3]], "abc"]
)
def test_what_cannot_be_labels_is_refused_before_a_kernel_sees_it(label):
    scan = scan_of((UNLABELLED, 5.0, 0.3), (UNLABELLED, NAN, 1.0), (UNLABELLED, NAN, 2.0))
    with pytest.raises(
        InputError, match=r"association at 0\.0 s: found labels .* expected 3 whole"
    ):
        labelled(scan, label)
    assert labelled(scan, [4, UNLABELLED, 4]).landmark.tolist() == [4]


def test_ranges_come_with_their_own_noise_from_the_first_row_that_has_them_and_excess_paths_stay():
    scan = make_scan(
        0.0, np.full(4, 4), np.full(4, 0.1), bearing_std=0.01, caller=np.array([3, 0, 1, 2]),
        range=np.array([NAN, 5.0, 9.0, NAN]), range_std=np.array([0.9, 0.2, 0.3, 0.4]),
        excess_path=np.array([NAN, NAN, 7.0, 6.0]), excess_path_std=np.array([0.8, 0.7, 0.5, 0.6]),
    )  # fmt: skip
    merged = labelled(scan, scan.landmark)
    assert merged.landmark.tolist() == [4, 4]
    assert (merged.range[0], merged.range_std[0], merged.bearing[0]) == (5.0, 0.2, 0.1)
    assert np.isnan([merged.range[1], merged.bearing[1]]).all()
    assert (merged.excess_path.tolist(), merged.excess_path_std.tolist()) == (
        [7.0, 6.0],
        [0.5, 0.6],
    )
    assert merged.caller.tolist() == [1, 2]
    assert labelled(merged, merged.landmark) is merged


def test_merged_rows_are_of_the_call_of_the_first_of_them():
    scan = make_scan(0.0, np.array([4, 6, 4, 6]), np.zeros(4), caller=np.array([2, 1, 0, 3]))
    merged = labelled(scan, scan.landmark)
    assert (merged.landmark.tolist(), merged.caller.tolist()) == ([4, 6], [2, 1])


def test_the_level_of_merged_rows_is_the_highest_that_is_known():
    for level in ([20.0, NAN], [NAN, 20.0], [20.0, 3.0], [3.0, 20.0]):
        scan = scan_with([4, 4], [0.1, 0.1], level_db=np.array(level))
        assert labelled(scan, scan.landmark).level_db.tolist() == [20.0]


def test_a_scan_of_nothing_stays_one():
    empty = scan_of()
    assert labelled(empty, known_labels(None, empty)).landmark.size == 0
    nobody = scan_of((UNLABELLED, 2.0, 0.1))
    assert labelled(nobody, known_labels(None, nobody)).landmark.size == 0
