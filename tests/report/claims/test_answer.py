"""The answer in words follows the numbers."""

import numpy as np

from pipistrelle.report.claims.answer import answer, findings
from pipistrelle.report.claims.contrasts import selections
from pipistrelle.report.claims.verdicts import judge_claims
from pipistrelle.report.studied import COMMON, POSITION, POSITION_BOUND
from report.invented import BEAMWIDTH, changed, invent, only


def told(study):
    by_rule = selections(study)
    return answer(by_rule, judge_claims(by_rule))


def rows(study):
    """The numbers behind the answer: without diverged worlds, and with everything."""
    found = findings(selections(study))
    return {
        (row["finding"], row["filter"]): (row["without_diverged_worlds"], row["with_everything"])
        for row in found
    }


MAP = "map RMSE of shared landmarks: fused beside active"


def with_map(study, change):
    for name in ("ekf", "fastslam"):
        active = study.trials[name, "active"].scores[COMMON]
        study = changed(study, (name, "fused"), COMMON, lambda _, now=active: now + change)
    return study


def jitter(size):
    return size * np.linspace(-1.0, 1.0, 60)[:, None]


def test_a_more_accurate_map_at_narrow_beams_is_said_so():
    gain = np.where(BEAMWIDTH < 30.0, -0.3, 0.0)
    study = with_map(invent(60), gain + jitter(0.1))
    headline, tally = told(study)
    assert headline == "Yes: a fuller map, and a more accurate one where the beam is narrow."
    assert tally.startswith("Of the paper's eight claims,")
    found = rows(study)
    assert found["landmarks placed, active → fused, at 11°", "EKF"] == ("20 → 30",) * 2
    assert found["landmarks placed, active → fused, at 180°", "EKF"] == ("36 → 38",) * 2
    assert found[MAP, "EKF"] == ("better at 5 of 12 beamwidths (11° to 27°)",) * 2
    for score in ("position RMSE", "position RMSE, aligned"):
        assert (f"{score}: fused beside active", "FastSLAM 2.0") in found


def test_the_other_answers():
    study = invent(60)
    cases = {
        "Yes: a fuller map, and a more accurate one at every beamwidth.": np.full(12, -0.3),
        "It builds a fuller map, and a less accurate one.": np.full(12, 0.3),
        "Yes: a fuller map, and a more accurate one at some beamwidths.": -0.3
        * (BEAMWIDTH > 100.0),
        "It depends: a fuller map, at some beamwidths more accurate, at others less.": 0.3
        * np.sign(BEAMWIDTH - 50.0),
        "It builds a fuller map; no difference in its accuracy is significant at any beamwidth.": (
            np.zeros(12)
        ),
    }
    for headline, change in cases.items():
        assert told(with_map(study, change + jitter(0.1)))[0] == headline


def test_runs_of_beamwidths_are_named_by_their_ends():
    change = np.where(np.isin(np.arange(12), [0, 1, 2, 5]), -0.3, 0.0)
    placed = rows(with_map(invent(60), change + jitter(0.1)))[MAP, "EKF"]
    assert placed[0] == "better at 4 of 12 beamwidths (11° to 18°, 33°)"


def test_a_map_that_is_not_fuller_is_not_called_so():
    study = changed(invent(60), ("ekf", "active"), "landmarks_full", lambda count: count + 30.0)
    begun = "It does not build a fuller map"
    cases = {
        f"{begun}, but a more accurate one at every beamwidth.": np.full(12, -0.3),
        f"{begun}, but a less accurate one.": np.full(12, 0.3),
        f"{begun}; it is at some beamwidths more accurate, at others less.": 0.3
        * np.sign(BEAMWIDTH - 50.0),
        f"{begun}; no difference in its accuracy is significant at any beamwidth.": np.zeros(12),
    }
    for headline, change in cases.items():
        assert told(with_map(study, change + jitter(0.1)))[0] == headline


def test_nothing_is_answered_before_there_are_worlds_or_cases():
    headline, *_ = told(invent(1))
    assert headline == "Not decided: a single world is left."
    assert rows(invent(1))[MAP, "EKF"] == ("not decided: a single world is left",) * 2
    alone = told(only(invent(5), [("ekf", "passive")]))
    assert alone[0] == "Not decided: the study has no pair of active and fused."


def test_what_is_not_significant_is_not_called_equal():
    study = with_map(invent(2), jitter(0.1)[[0, -1]])
    for title in ("EKF", "FastSLAM 2.0"):
        found = rows(study)[MAP, title]
        assert found == ("not significantly better or worse at any beamwidth",) * 2


def test_a_filter_without_a_world_left_is_undecided_and_the_other_answers():
    study = with_map(invent(60), np.full(12, -0.3) + jitter(0.1))
    study.trials["ekf", "passive"].diverged[:] = True
    lines = told(study)
    assert lines[0] == "Yes: a fuller map, and a more accurate one at every beamwidth."
    assert rows(study)[MAP, "EKF"] == (
        "not decided: no world is left", "better at every beamwidth",
    )  # fmt: skip
    assert rows(study)[MAP, "FastSLAM 2.0"] == ("better at every beamwidth",) * 2
    study.trials["fastslam", "passive"].diverged[:] = True
    headline, without, *_ = told(study)
    assert headline == "It depends on which worlds are counted."
    assert without == "Without diverged worlds: Not decided: no world is left."


def test_an_answer_that_hangs_on_what_is_left_out_is_given_both_ways():
    study = with_map(invent(60), np.full(12, -0.3) + jitter(0.1))
    for name in ("ekf", "fastslam"):
        spoilt = np.where(np.arange(60) < 20, 3.0, 0.0)[:, None]
        study = changed(study, (name, "fused"), COMMON, lambda error, more=spoilt: error + more)
        study.trials[name, "fused"].diverged[:20] = True
    headline, without, within, _ = told(study)
    assert headline == "A fuller map, yes; a more accurate one depends on which worlds are counted."
    assert without == (
        "Without diverged worlds and without diverged cases: "
        "Yes: a fuller map, and a more accurate one at every beamwidth."
    )
    assert within == "With everything: It builds a fuller map, and a less accurate one."


def with_bound(study, way, least):
    return changed(study, way, POSITION_BOUND, lambda bound: np.broadcast_to(least, bound.shape))


def test_what_the_bound_allows_is_said_at_both_ends_and_how_near_each_filter_comes():
    study = invent(60)
    for name in ("ekf", "fastslam"):
        for strategy, least in (("active", 0.3), ("fused", 0.25), ("passive", 0.5)):
            study = with_bound(study, (name, strategy), least)
            far = least * (1.5 if name == "ekf" else 2.0)
            study = changed(study, (name, strategy), POSITION, lambda e, far=far: 0.0 * e + far)
    found = rows(study)
    for at in ("11°", "180°"):
        bound = f"position bound [m], active → fused, at {at}"
        assert found[bound, "EKF"] == ("0.300 → 0.250",) * 2
    for strategy in ("active", "fused", "passive"):
        times = f"position RMSE over its bound, {strategy}"
        assert found[times, "EKF"] == ("1.50", "1.50")
        assert found[times, "FastSLAM 2.0"] == ("2.00", "2.00")


def test_worlds_without_a_bound_are_answered_without_it():
    study = invent(20)
    for way in study.trials:
        study = with_bound(study, way, np.nan)
    assert told(study)[0].startswith("It builds a fuller map")
    assert not any("bound" in finding for finding, _ in rows(study))
