"""A scan's rows as an association uses them: which may be used, how surely, and what they begin."""

import numpy as np
import pytest

from pipistrelle.detection.scans import UNLABELLED, make_scan
from pipistrelle.estimation.beliefs import is_among
from pipistrelle.estimation.data_association.pairs import OWN_CALL
from pipistrelle.estimation.data_association.rows import (
    ASSUMED,
    BESIDE,
    RARE_SHARE,
    RAREST,
    SURE_SHARE,
    compared,
    label_matched,
    rows_of_scan,
)

LIMITS = 0.05, 0.35, 0.25
CHANCES = 25.0, 0.06, 1.3, 0.8, 0.06


def test_certainty_and_clutter_of_rows_match_the_formulae():
    rng = np.random.default_rng(5)
    caller, own = rng.integers(0, 2, 200), rng.choice([0.001, 0.01, 0.06, 0.15, np.nan], 200)
    way = np.where(rng.random(200) < 0.2, np.nan, 3.0)
    std = rng.choice([0.1, 0.3, 0.4, 0.9, np.nan], 200)
    columns = {"range": way, "range_std": std, "excess_path": way, "excess_path_std": std}
    scan = make_scan(
        0.0, np.full(200, -1), np.zeros(200), caller=caller, bearing_std=own, **columns
    )
    rows = rows_of_scan(scan, LIMITS, (0.15, 0.9))
    sure = (own <= LIMITS[0]) | (own == 0.15)
    within = (std <= LIMITS[1]) | (std == 0.9)
    assert np.array_equal(rows.usable, sure & (np.isnan(way) | within))
    assert np.array_equal(rows.with_way, sure & ~np.isnan(way) & within)
    assert np.array_equal(rows.sure, (std <= LIMITS[2]) | (std == 0.9))
    share = np.fmin(SURE_SHARE * LIMITS[0] / own, 1.0)
    assert np.array_equal(rows.surety, np.where(own == 0.15, ASSUMED, share))
    rare = np.fmin(np.square(own / (RARE_SHARE * LIMITS[0])), 1.0)
    np.testing.assert_allclose(rows.clutter, np.where(own == 0.15, 1.0, np.fmax(rare, RAREST)))


@pytest.mark.parametrize(("apart", "begun"), [(0.9, [1]), (1.1, [0, 1])])
def test_a_row_next_to_a_louder_row_begins_no_landmark(apart, begun):
    way = np.array([3.0, 3.0 + apart * BESIDE / 2.0])
    stds = {"bearing_std": 0.01, "range_std": 0.02}
    level = np.array([30.0, 40.0])
    scan = make_scan(0.0, np.full(2, -1), np.zeros(2), range=way, level_db=level, **stds)
    rows, joint = rows_of_scan(scan, LIMITS, ()), (np.empty(0, int), np.zeros(3), np.eye(3))
    caller, none = (0, -1, OWN_CALL), np.empty(0, int)
    label = np.full(2, UNLABELLED)
    used, costs, close = compared(tuple(rows), joint, none, caller, CHANCES)
    assert used.tolist() == [0, 1]
    assert costs.shape == (2, 0)
    assert not close.any()
    matched = used, np.full(2, -1), close
    found, count = label_matched(label, tuple(rows), joint, none, matched, caller, CHANCES)
    assert sorted(found.tolist()) == begun
    assert count == (0, 2)


def test_is_among_agrees_with_numpy():
    rng = np.random.default_rng(9)
    labels, others = rng.integers(-1, 9, 50), rng.integers(-1, 9, 4)
    assert np.array_equal(is_among(labels, others), np.isin(labels, others))
