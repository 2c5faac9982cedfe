"""A caller that turns at once is found again on the map, and one that did not is left alone."""

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.data_association.pairs import pair_costs
from pipistrelle.estimation.data_association.turns import turned
from pipistrelle.estimation.measurement import excess_path_slopes

CHANCES = (25.0, 0.06, 1.2, 0.8)
PLACES = np.random.default_rng(2).uniform(-10.0, 10.0, (20, 2))
EXPECTED = np.array([9.0, 6.0])
AT = 3 + 2 * len(PLACES)


def tried(caller, heard=20):
    """Return where a caller at a place is taken for, that is expected elsewhere."""
    mean = np.concatenate([np.zeros(3), PLACES.ravel(), EXPECTED])
    covariance = np.diag([1e-4] * (mean.size - 2) + [0.01, 0.01])
    labels = np.arange(len(PLACES) + 1)
    joint = JointGaussian(landmark=labels, mean=mean, covariance=covariance)
    seen = PLACES[:heard]
    bearing = np.arctan2(seen[:, 1], seen[:, 0])
    way = np.array([excess_path_slopes(0.0, 0.0, *place, *caller)[0] for place in seen])
    std = np.ones(heard)
    rows = bearing, 0.02 * std, way, 0.03 * std, 20.0 * std

    def costs(tried):
        return pair_costs(rows, tried, covariance, np.arange(3, AT, 2), AT, CHANCES)

    return turned(joint, AT, float(np.arctan2(caller[1], caller[0])), costs).mean[AT:]


@pytest.mark.parametrize("caller", [(7.0, 4.5), (9.8, 3.2), (6.4, 4.2)])
def test_one_that_has_turned_is_where_its_rows_fit(caller):
    assert np.hypot(*(tried(np.array(caller)) - caller)) < 0.5
    assert np.hypot(*(EXPECTED - caller)) > 2.0


def test_one_that_is_where_it_was_expected_or_is_heard_little_of_is_left_there():
    assert tried(EXPECTED + 0.1).tolist() == EXPECTED.tolist()
    assert tried(np.array([7.0, 4.5]), heard=4).tolist() == EXPECTED.tolist()
