"""A caller that turns at once is found again on the map, and one that did not is left alone."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pipistrelle.config import AssociationConfig, Config
from pipistrelle.detection.scans import UNLABELLED, make_scan
from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.data_association.caller_search import turned
from pipistrelle.estimation.data_association.existence import nobody, with_new
from pipistrelle.estimation.data_association.pairs import pair_costs
from pipistrelle.estimation.data_association.rows import CallerPlace, CallerState, Memory
from pipistrelle.estimation.data_association.sequential import association_of
from pipistrelle.estimation.observations.excess_path import excess_path_slopes

CHANCES = (25.0, 0.06, 1.2, 0.8, 0.06)
PLACES = np.random.default_rng(2).uniform(-10.0, 10.0, (20, 2))
EXPECTED = np.array([9.0, 6.0])
AT = 3 + 2 * len(PLACES)
MEAN = np.concatenate([np.zeros(3), PLACES.ravel(), EXPECTED])
LABELS = np.arange(1, len(PLACES) + 2)


def tried(caller, heard=20):
    """Return where a caller at a place is taken for, that is expected elsewhere."""
    covariance = np.diag([1e-4] * AT + [0.01, 0.01])
    joint = JointGaussian(landmark=LABELS, mean=MEAN, covariance=covariance)
    seen = PLACES[:heard]
    bearing = np.arctan2(seen[:, 1], seen[:, 0])
    way = np.array([excess_path_slopes(0.0, 0.0, *place, *caller)[0] for place in seen])
    std = np.ones(heard)
    rows = bearing, 0.02 * std, way, 0.03 * std, 20.0 * std

    def costs(tried):
        return pair_costs(rows, tried, covariance, np.arange(3, AT, 2), AT, CHANCES)

    return turned(joint, AT, float(np.arctan2(caller[1], caller[0])), costs).mean[AT:]


@pytest.mark.parametrize("caller", [(7.0, 4.5), (9.8, 3.2), (6.4, 4.2)])
def test_a_caller_that_turned_is_placed_where_its_rows_fit(caller):
    assert np.hypot(*(tried(np.array(caller)) - caller)) < 0.5
    assert np.hypot(*(EXPECTED - caller)) > 2.0


def test_a_caller_at_its_expected_position_or_with_few_rows_stays_there():
    assert tried(EXPECTED + 0.1).tolist() == EXPECTED.tolist()
    assert tried(np.array([7.0, 4.5]), heard=4).tolist() == EXPECTED.tolist()


@pytest.mark.parametrize(
    ("moves", "hears_itself", "heard_before", "begun"),
    [(True,) * 3 + (0,), (False, True, True, 20), (True, False, True, 20), (True, True, False, 20)],
)
def test_rows_of_a_misplaced_caller_begin_no_landmark(moves, hears_itself, heard_before, begun):
    """Of one that stands they are new, and who only listens has nothing else to go by."""
    size, rng = len(PLACES), np.random.default_rng(5)
    joint = JointGaussian(landmark=LABELS, mean=MEAN, covariance=1e-4 * np.eye(MEAN.size))
    known = with_new(nobody(2), LABELS[:-1].tolist(), 0, 2)
    known.confirmed[:], known.source[:] = True, 60.0 if heard_before else np.nan
    caller = CallerState(label=size + 1, place=CallerPlace(*EXPECTED), told=True)
    memory = Memory(scan=5, labels=size + 1, known=known, callers={1: caller})
    bearing = np.append(np.arange(-3.0, 3.0, 0.3), np.arctan2(EXPECTED[1], EXPECTED[0]))
    heard = make_scan(
        5.0,
        np.full(size + 2, UNLABELLED),
        np.append(bearing, np.arctan2(*PLACES[0, ::-1])),
        range=np.append(np.full(size + 1, np.nan), np.hypot(*PLACES[0])),
        caller=np.append(np.ones(size + 1, int), 0 if hears_itself else 1),
        excess_path=np.append(rng.uniform(40.0, 60.0, size), [0.0, np.nan]),
        bearing_std=0.01,
        range_std=0.02,
        excess_path_std=0.02,
        level_db=np.full(size + 2, 40.0),
    )
    scan = replace(heard, direct=np.array([-1, size]), moving_callers=np.ones(int(moves), int))
    stage = association_of(Config(association=AssociationConfig(method="marginal")))
    after, assignment = stage.associate(memory, SimpleNamespace(joint=lambda: joint), scan)
    assert after.labels - memory.labels == begun
    assert assignment.label[size] == size + 1, "the direct call is the caller's"
    assert assignment.label[-1] == (1 if hears_itself else UNLABELLED)
