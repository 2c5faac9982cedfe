"""Landmarks on the map twice: single ones, and groups that a closed loop shows anew."""

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.data_association.existence import doubles, drifted

OLD = np.array([[4.0, 1.0], [6.0, -2.0], [9.0, 3.0], [3.0, -4.0]])


def closed_loop(shift, drift_std, old=OLD, twice=4, std=0.03):
    """Return a map whose last landmarks are its first ones, moved by one common drift."""
    landmarks = np.vstack([old, old[:twice] + shift])
    size = len(landmarks)
    covariance = np.zeros((3 + 2 * size, 3 + 2 * size))
    covariance[3:, 3:] = std**2 * np.eye(2 * size)
    for axis in (0, 1):
        late = [axis, *range(3 + 2 * len(old) + axis, 3 + 2 * size, 2)]
        covariance[np.ix_(late, late)] += drift_std**2
    mean = np.concatenate([np.zeros(3), landmarks.ravel()])
    return JointGaussian(landmark=np.arange(size), mean=mean, covariance=covariance)


def asked_of(joint, apart=None, asked=None):
    size = joint.landmark.size
    apart = np.eye(size, dtype=bool) if apart is None else apart
    asked = np.arange(size) if asked is None else asked
    return doubles(joint, 3 + 2 * np.arange(size), apart, asked)


@pytest.mark.parametrize("asked", [[4], [7], [0], [5, 6]])
def test_a_closed_loop_is_found_as_a_group_from_any_member(asked):
    joint = closed_loop(np.array([2.5, -1.5]), drift_std=2.0)
    assert sorted(asked_of(joint, asked=np.array(asked))) == [(0, 4), (1, 5), (2, 6), (3, 7)]


def test_a_single_pair_after_a_long_drift_is_no_evidence():
    assert asked_of(closed_loop(np.array([2.5, -1.5]), drift_std=2.0, twice=1)) == []


def test_a_loop_is_closed_after_more_drift_than_stated():
    joint, born = closed_loop(np.array([2.5, -1.5]), drift_std=0.4), np.repeat([0, 50], 4)
    places = joint, 3 + 2 * np.arange(8), np.eye(8, dtype=bool), np.arange(8)
    assert asked_of(joint) == drifted(*places, (born, born + 60)) == []
    assert sorted(drifted(*places, (born, born + 40))) == [(0, 4), (1, 5), (2, 6), (3, 7)]


def test_one_pair_in_one_place_is_one_landmark():
    joint = closed_loop(np.array([0.1, 0.0]), drift_std=0.02, twice=1)
    assert asked_of(joint) == [(0, 4)]
    joint.covariance[3:, 3:] += 25.0 * np.tile(np.eye(2), (5, 5))
    assert asked_of(joint) == [(0, 4)], "an error of both tells nothing about their difference"


def test_landmarks_measured_in_one_scan_are_not_merged():
    joint = closed_loop(np.array([0.1, 0.0]), drift_std=0.02, twice=1)
    apart = np.eye(5, dtype=bool)
    apart[0, 4] = apart[4, 0] = True
    assert asked_of(joint, apart) == []


def test_new_landmarks_elsewhere_are_not_forced_onto_old_ones():
    rng, merged = np.random.default_rng(11), 0
    for _ in range(100):
        joint = closed_loop(np.zeros(2), drift_std=0.5)
        joint.mean[11:] = rng.uniform(-20.0, 20.0, 8)
        merged += bool(asked_of(joint))
    assert merged <= 3


def test_landmarks_that_three_labels_name_become_one():
    joint = closed_loop(np.array([0.05, 0.0]), 0.02, old=np.full((2, 2), 3.0), twice=1)
    pairs = asked_of(joint, asked=np.array([2]))
    assert len(pairs) == 2
    assert {0, 1, 2} - {gone for _, gone in pairs} == {0}
