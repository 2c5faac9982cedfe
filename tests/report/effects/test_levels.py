"""Where a study stands: errors as multiples of the bound."""

import numpy as np
import pytest

from pipistrelle.report.claims.contrasts import select
from pipistrelle.report.effects.levels import times_by_strategy, times_the_bound
from report.invented import changed, invent, narrowed, only


def test_multiples_of_the_bound_are_of_root_mean_squares_over_unlike_worlds():
    """Errors of 1 m and 7 m over bounds of 1 m both: 5 by squares, 4 by means."""
    study = narrowed(only(invent(2), [("ekf", "active")]), [5])
    way = "ekf", "active"
    study = changed(study, way, "position_rmse_m", lambda _: np.array([[1.0], [7.0]]))
    study = changed(study, way, "position_bound_m", lambda _: np.array([[1.0], [1.0]]))
    cell = (*way, 0)
    assert times_the_bound(select(study, "none"), cell) == pytest.approx(5.0)
    assert times_by_strategy(select(study, "none"), "ekf") == {"active": "5.00"}
    study = changed(study, way, "position_bound_m", lambda _: np.array([[0.6], [0.8]]))
    assert times_the_bound(select(study, "none"), cell) == pytest.approx(50.0**0.5)


def test_without_a_bound_there_are_no_multiples_of_it():
    study = changed(invent(2), ("ekf", "active"), "position_bound_m", lambda b: np.nan * b)
    assert times_the_bound(select(study, "none"), ("ekf", "active", 0)) is None
    assert "active" not in times_by_strategy(select(study, "none"), "ekf")
