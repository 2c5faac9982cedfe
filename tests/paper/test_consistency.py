"""What the paper prints about consistency (Sec. V)."""

import pytest

from pipistrelle.evaluation.consistency import EKF_LIMIT, FASTSLAM_LIMIT, anees_bounds

HALF_DIGIT = 0.005


@pytest.mark.parametrize(("runs", "bounds"), [(107, (2.55, 3.48)), (100, (2.54, 3.50))])
def test_the_bounds_of_the_anees_are_those_of_section_v_b(runs, bounds):
    assert anees_bounds(runs) == pytest.approx(bounds, abs=HALF_DIGIT)
    assert anees_bounds(runs, confidence=0.9) != pytest.approx(bounds, abs=HALF_DIGIT)


def test_the_divergence_limits_are_those_of_section_v_a():
    assert (EKF_LIMIT, FASTSLAM_LIMIT) == (50.0, 2750.0)
