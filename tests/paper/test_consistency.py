"""What the paper prints about consistency (Sec. V)."""

import pytest

from pipistrelle.estimation.catalogue import PAPERS, entry
from pipistrelle.evaluation.consistency import anees_bounds

HALF_DIGIT = 0.005


@pytest.mark.parametrize(("runs", "bounds"), [(107, (2.55, 3.48)), (100, (2.54, 3.50))])
def test_bounds_of_the_anees_match_section_v_b(runs, bounds):
    assert anees_bounds(runs) == pytest.approx(bounds, abs=HALF_DIGIT)
    assert anees_bounds(runs, confidence=0.9) != pytest.approx(bounds, abs=HALF_DIGIT)


def test_divergence_limits_match_section_v_a():
    assert [entry(name).nees_limit for name in PAPERS] == [50.0, 2750.0]
