"""Where a study stands: errors as multiples of the bound."""

import numpy as np

from pipistrelle.report.claims.contrasts import select
from pipistrelle.report.effects.levels import times_the_bound
from report.invented import changed, invent, narrowed, only


def test_multiples_of_the_bound_are_of_root_mean_squares_over_unlike_worlds():
    """Errors of 1 m and 7 m over bounds of 1 m both: 5 by squares, 4 by means."""
    study = narrowed(only(invent(2), [("ekf", "active")]), [5])
    way = "ekf", "active"
    study = changed(study, way, "position_rmse_m", lambda _: np.array([[1.0], [7.0]]))
    study = changed(study, way, "position_bound_m", lambda _: np.array([[1.0], [1.0]]))
    assert times_the_bound(select(study, "none"), "ekf") == ("active 5.00", False)
    study = changed(study, way, "position_bound_m", lambda _: np.array([[0.6], [0.8]]))
    assert times_the_bound(select(study, "none"), "ekf")[0] == "active 7.07"
