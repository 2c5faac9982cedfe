import numpy as np
import pytest

from pipistrelle.evaluation.consistency import anees_bounds
from pipistrelle.report.overview import by_strategy, consistency, exclusions, table_ii
from report.invented import invent, only


def test_exclusions_count_worlds_and_trials_and_stand_beside_the_papers():
    study = invent(6)
    study.outcomes["ekf", "fused"].diverged[0, 2:5] = True
    study.outcomes["ekf", "active"].diverged[0, 0] = True
    study.outcomes["fastslam", "passive"].failed[3, 0] = True
    ekf, fastslam = exclusions(study)
    assert (ekf["excluded"], ekf["worlds"], ekf["paper"], ekf["limit"]) == (1, 6, 8, 50.0)
    assert ekf["diverged"] == {"active": 1, "fused": 3, "passive": 0}
    assert ekf["trials"] == {"active": 72, "fused": 72, "passive": 6}
    assert (fastslam["excluded"], fastslam["failed"], fastslam["paper"]) == (1, 1, 15)


def test_table_ii_has_the_means_of_the_worlds_that_count():
    study = invent(6)
    study.outcomes["ekf", "passive"].diverged[2, 0] = True
    rows = table_ii(study)
    count = np.delete(study.outcomes["ekf", "fused"].scores["landmarks_full"][:, 11], 2)
    assert rows[0]["full"] == pytest.approx([count.mean(), count.std(ddof=1)])
    assert [row["n"] for row in rows] == [5] * 4 + [6] * 4
    assert rows[4]["full_mean"][0] == pytest.approx(rows[4]["full"][0] + 0.1)
    assert table_ii(only(study, [("ekf", "fused")]))[7]["full"] is None


def test_consistency_is_told_in_shares_of_time():
    study = invent(20)
    low, high = anees_bounds(20)
    nees = study.outcomes["ekf", "passive"].nees
    nees[:, :, :75] = 3.0
    nees[:, :, 75:300] = high + 1.0
    nees[:, :, 300:] = low - 1.0
    (row,) = [r for r in consistency(study) if (r["filter"], r["strategy"]) == ("ekf", "passive")]
    assert (row["inside"], row["above"]) == pytest.approx((75 / 375, 225 / 375))
    assert row["bounds"] == pytest.approx([low, high])
    squares = [0.0, np.log((high + 1) / 3) ** 2, np.log((low - 1) / 3) ** 2]
    assert row["departure"] == pytest.approx(np.dot(squares, [75, 225, 75]) / 375)
    assert row["beamwidth"] is None


def test_strategies_are_averages_over_beamwidths():
    rows = consistency(invent(5))
    assert len(rows) == 50
    mine = [r["anees"] for r in rows if (r["filter"], r["strategy"]) == ("fastslam", "active")]
    found = {(r["filter"], r["strategy"]): r for r in by_strategy(rows)}
    assert found["fastslam", "active"]["anees"] == pytest.approx(np.mean(mine))
    assert len(found) == 6
