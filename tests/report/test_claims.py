"""Verdicts: what reproduces, refutes or leaves open a sentence or a claim; the answer in words."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pipistrelle.report import claims
from pipistrelle.report.claims import judge_claims, judge_sentences, scoreboard
from pipistrelle.report.sentences import SEEN, SENTENCES, Comparison, Part, Sentence
from pipistrelle.report.study import (
    COMMON,
    HEADING,
    LANDMARKS,
    POSITION,
    POSITION_BOUND,
    RULES,
    select,
    selections,
)
from report.invented import BEAMWIDTH, add, changed, diverging, invent, noise, only, with_third

FUSED = "ekf", "fused"


@pytest.fixture(scope="module")
def study():
    return invent(60)


def judged(study, number):
    (row,) = judge_sentences(selections(study), [SENTENCES[number - 1]])
    return row


@pytest.mark.parametrize("signs", ["++-", "+--", "+-", "+", "-", ""])
@pytest.mark.parametrize("need", ["all", "most", "implied"])
def test_a_part_needs_all_or_most_comparisons_and_an_implied_part_refutes_nothing(
    study, need, signs
):
    def made(_, signs=signs):
        return [Comparison(sign, "m", (sign == "+") - 0.5 + np.array([0.0, 0.1, 0.2]) / 9, 1.0)
                for sign in signs]  # fmt: skip

    parts = (partial(made, signs="+"), Part(made, need))
    row = claims._judged(Sentence(1, None, "", "", parts), select(study, "world"))
    enough = signs.count("+") > len(signs) / 2 if need == "most" else "-" not in signs
    holds = enough if signs else None
    expected = [holds, holds, holds, signs.count("-")]
    if need == "implied":
        expected = [True, True, holds or None, 0]
    assert [row[key] for key in ("by_means", "by_bands", "by_intervals", "refuted")] == expected


def test_passive_far_ahead_at_wide_beams_leaves_the_sentence_on_it_open(study):
    """The paper says by how much below 65 degrees, and only implies that it is less from there."""
    study = add(SEEN, "active", -6.0 * (BEAMWIDTH > 64.0))(study)
    row = judged(study, 21)
    assert row["by_exclusion"]["world"]["parts"] == [True, True, None]
    assert (row["verdict"], row["refuted"]) == ("open", 0)
    assert (row["by_means"], row["by_bands"], row["comparisons"]) == (True, True, 40)
    assert judge_claims([row])[0]["verdict"] == "open"


def test_noise_as_large_as_the_effects_and_no_difference_at_all_leave_sentences_open(study):
    rng, loud = np.random.default_rng(8), study
    for way in study.trials:
        loud = changed(loud, way, POSITION, lambda error: error + noise(rng, *error.shape))
    assert {judged(loud, number)["verdict"] for number in (8, 11)} == {"open"}
    same = study.trials | {("fastslam", "fused"): study.trials["fastslam", "active"]}
    assert judged(replace(study, trials=same), 13)["verdict"] == "open"


@pytest.mark.slow
def test_where_fused_and_active_are_the_same_no_sentence_on_them_is_refuted():
    """Over many studies without any difference, the family's error is at most 5 %."""
    wrong, runs = 0, 200
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        plain = rng.normal(1.0, 0.2, (2, 30, 12))
        one = only(invent(30), [("fastslam", "active"), ("fastslam", "fused")])
        for strategy, errors in zip(("active", "fused"), plain, strict=True):
            one = changed(one, ("fastslam", strategy), POSITION, lambda _, now=errors: now)
        wrong += claims._judged(SENTENCES[12], select(one, "none"))["by_intervals"] is False
    assert wrong / runs <= 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / runs)


def spoilt(study, way, count=30, **changes):
    """Let some worlds diverge with a filter and a strategy; errors change there by so much."""
    trials, first = study.trials[way], (np.arange(60) < count)[:, None]
    scores = {score: trials.scores[score] + change * first for score, change in changes.items()}
    made = replace(diverging(trials, slice(count)), scores=trials.scores | scores)
    return replace(study, trials=study.trials | {way: made})


def test_a_verdict_that_depends_on_the_exclusion_is_open(study):
    """Diverged worlds in which active has the better heading, and only there."""
    row = judged(spoilt(study, ("ekf", "active"), **{HEADING: -1.0}), 25)
    assert [row["by_exclusion"][rule]["by_intervals"] for rule in RULES] == [True, True, False]
    assert (row["verdict"], row["reason"]) == ("open", (
        "The verdict depends on what is left out: it holds without diverged worlds, it holds "
        "without diverged cases and it is refuted with everything."
    ))  # fmt: skip


@pytest.mark.parametrize(
    ("number", "score", "change", "spoil", "parts"),
    [
        (16, LANDMARKS, 9.0, -99.0, ([False], [False])),  # too many, then too few
        (12, POSITION, 0.1 * (BEAMWIDTH < 41.0), -9.0, ([False, None, None], [True, False, None])),
    ],
)
def test_a_sentence_that_fails_for_another_reason_under_each_rule_is_open(
    study, number, score, change, spoil, parts
):
    wrong = add(score, "fused", change, ["ekf"])(study)
    row = judged(spoilt(wrong, FUSED, **{score: spoil}), number)
    assert [row["by_exclusion"][rule]["by_intervals"] for rule in RULES] == [False] * 3
    assert tuple(row["by_exclusion"][rule]["parts"] for rule in ("world", "none")) == parts
    assert row["verdict"] == "open"
    assert "not each time for the same reason" in row["reason"]


def test_a_sentence_with_a_part_failing_under_every_rule_is_not_reproduced(study):
    worse = spoilt(add(HEADING, "fused", 0.02)(study), FUSED, **{POSITION: 3.0})
    assert judged(worse, 25)["verdict"] == "not-reproduced"


def test_a_claim_is_reproduced_by_all_of_its_sentences_and_refuted_by_one(study):
    rows = judge_sentences(selections(study), SENTENCES[2:4])
    assert [claim["verdict"] for claim in judge_claims(rows)] == ["reproduced"]
    for second, verdict in (("open", "open"), ("not-reproduced", "not-reproduced")):
        (claim,) = judge_claims([rows[0], rows[1] | {"verdict": second}])
        assert (claim["claim"], claim["verdict"], claim["sentences"]) == (2, verdict, [3, 4])
        assert claim["decided_by"] == [4]
        assert [claim[name] for name in ("means", "bands", "intervals")] == [2, 2, 2]


def test_the_scoreboard_counts_every_sentence_once_by_each_yardstick(study):
    rows = judge_sentences(selections(only(study, [("ekf", "active"), FUSED])))
    board = scoreboard(rows)
    without = [row["sentence"] for row in rows if not row["comparisons"]]
    assert without == [2, 3, 5, 7, 8, 10, 11, 13, 15, 19, 20, 21, 24]
    assert (board["sentences"], board["not_judged"]) == (26, 13)
    for name in (*claims.YARDSTICKS, "verdict"):
        assert sum(board[name].values()) == 13
    assert board["means"]["reproduced"] == [row["by_means"] for row in rows].count(True)
    assert board["errors"] == pytest.approx(np.sqrt(60 / 107), rel=0.01)
    assert rows[1]["reason"] == "The study has no cases for it, or too few worlds."
    assert rows[8]["reason"] == "The study has no cases for a part of it."


def answer_of(study, sentences=()):
    by_rule = selections(study)
    return claims.papers_answer(by_rule, judge_sentences(by_rule, sentences))


def test_the_answer_counts_sentences_and_names_claims(study):
    assert answer_of(study, SENTENCES)[-2:] == [
        "Of the paper's 26 sentences on results, 13 hold by means and 16 by bands of one standard "
        "deviation. Whatever is left out, 95 % intervals show eight of them and refute two.",
        "Claims 2 and 6 are reproduced; claims 1, 3, 4, 5, 7 and 8 are open.",
    ]
    *_, counted, last = answer_of(only(invent(4), [("ekf", "active"), FUSED]), SENTENCES)
    assert counted.endswith(" The study has no cases, or too few worlds, for 13.")
    assert last == "All eight claims are open."


@pytest.mark.parametrize("worlds", [1, 2, 3])
def test_a_study_that_has_hardly_begun_can_be_judged(worlds):
    board = scoreboard(judge_sentences(selections(invent(worlds))))
    assert (board["not_judged"] == 26) is (worlds == 1)


def test_the_finding_farthest_from_holding_decides(study):
    worse = add(COMMON, "fused", -0.3 * (BEAMWIDTH < 12), ["ekf"])(study)
    world = judged(worse, 14)["by_exclusion"]["world"]
    decisive = world["findings"][world["decisive"]]
    assert decisive["label"] == "EKF fused − EKF active, 11°"
    assert decisive["mean"] == pytest.approx(-0.28, abs=1e-9)


def test_rows_are_json_and_errors_are_medians_of_a_single_unit(study):
    rows = judge_sentences(selections(spoilt(study, ("fastslam", "active"), **{POSITION: 5.0})))
    assert json.loads(json.dumps(rows, allow_nan=False))[12]["by_exclusion"].keys() == {*RULES}
    assert [rows[12]["by_exclusion"][rule]["findings"][0]["n"] for rule in RULES] == [30, 30, 60]
    assert (rows[14]["unit"], rows[14]["papers_error"]) == (None, None)
    for name in ("papers_error", "standard_error"):
        made = [one[name] for one in rows[12]["by_exclusion"]["world"]["findings"]]
        assert (rows[12]["unit"], rows[12][name]) == ("m", np.median(made))


@pytest.mark.parametrize("name", ["aekf", "toy_slam.filters:Smoother"])
def test_a_third_filter_changes_nothing_in_the_papers_sentences(study, name):
    third = with_third(study, name)
    assert judge_sentences(selections(third)) == judge_sentences(selections(study))
    lonely = only(third, [way for way in third.trials if way[0] == name])
    assert scoreboard(judge_sentences(selections(lonely)))["not_judged"] == 26


def rows(study):
    """The numbers behind the answer: without diverged worlds, and with everything."""
    return {
        (row["finding"], row["filter"]): (row["without_diverged_worlds"], row["with_everything"])
        for row in claims.findings(selections(study))
    }


MAP = "map RMSE of shared landmarks: fused minus active"
JITTER = 0.1 * np.linspace(-1.0, 1.0, 60)[:, None]


def with_map(change, study=None):
    """Let the map error of fused sensing be that of active sensing and a change."""
    study = invent(60) if study is None else study
    for name in ("ekf", "fastslam"):
        active = study.trials[name, "active"].scores[COMMON]
        study = changed(study, (name, "fused"), COMMON, lambda _, now=active: now + change)
    return study


def test_the_answer_averages_over_beams_and_the_table_names_the_better_beams():
    study = with_map(np.where(BEAMWIDTH < 30.0, -0.3, 0.0) + JITTER)
    assert answer_of(study) == [
        "EKF and FastSLAM 2.0: a fuller map, more accurate, averaged over the beamwidths."
    ]
    found = rows(study)
    assert found["landmarks placed, active → fused, at 11°", "EKF"] == ("20 → 30",) * 2
    assert found["landmarks placed, active → fused, at 180°", "EKF"] == ("36 → 38",) * 2
    assert found[MAP, "EKF"] == (
        "−0.125 m [−0.14, −0.11]; better at 5 of 12 beamwidths (11°, 14°, 18°, 22°, 27°)",
    ) * 2  # fmt: skip
    for title, _ in claims.COMPARED.values():
        assert (f"{title}: fused minus active", "FastSLAM 2.0") in found


@pytest.mark.parametrize(
    ("change", "words"),
    [(-0.3, "more accurate"), (0.3, "less accurate"), (0.0, "no difference in accuracy shown")],
)
@pytest.mark.parametrize(("more", "fuller"), [(0.0, "a fuller map"), (30.0, "a less full map")])
def test_the_answer_has_the_signs_of_landmarks_and_of_the_map_error(change, words, more, fuller):
    study = with_map(change + JITTER)
    study = add(LANDMARKS, "active", more)(study)
    assert answer_of(study)[0].startswith(f"EKF and FastSLAM 2.0: {fuller}, {words}, averaged")


def test_the_table_has_means_over_all_beams_with_intervals():
    study = with_map(np.linspace(-0.5, 0.1, 12) + JITTER)
    gap = [study.trials["ekf", way].scores[COMMON] for way in ("fused", "active")]
    mean = np.mean(gap[0] - gap[1])
    assert rows(study)[MAP, "EKF"][0].startswith(f"−{-mean:.1f} m [")
    two = rows(with_map(JITTER[[0, -1]], invent(2)))
    for title in ("EKF", "FastSLAM 2.0"):
        assert two[MAP, title] == ("0 m [−1.27, 1.27]",) * 2


def test_the_answer_is_undecided_without_worlds_or_cases():
    single = "EKF and FastSLAM 2.0: not decided, a single world is left"
    assert single in answer_of(invent(1))[0]
    assert rows(invent(1))[MAP, "EKF"] == ("not decided: a single world is left",) * 2
    passive = answer_of(only(invent(5), [("ekf", "passive")]))
    assert passive == ["Not decided: the study has no pair of active and fused."]


def test_a_filter_without_worlds_is_undecided_and_the_other_is_answered():
    study = with_map(np.full(12, -0.3) + JITTER)
    study.trials["ekf", "passive"] = diverging(study.trials["ekf", "passive"], slice(None))
    headline, *lines = answer_of(study)
    assert headline == "It depends on which worlds are counted."
    assert [lines[0], lines[2]] == [
        "Without diverged worlds: EKF: not decided, no world is left; FastSLAM 2.0: a fuller map, "
        "more accurate, averaged over the beamwidths.",
        "With everything: EKF and FastSLAM 2.0: a fuller map, more accurate, averaged over the "
        "beamwidths.",
    ]
    without, everything = rows(study)[MAP, "EKF"]
    assert without == "no world is left"
    assert "better at 12 of 12 beamwidths" in everything


def test_an_answer_that_depends_on_the_exclusion_is_given_under_each_rule():
    study = with_map(np.where(np.arange(60) < 20, 2.7, -0.3)[:, None] + JITTER)
    for name in ("ekf", "fastslam"):
        study.trials[name, "fused"] = diverging(study.trials[name, "fused"], slice(20))
    headline, *lines = answer_of(study)
    assert headline == "It depends on which worlds are counted."
    assert [line.split(", averaged")[0] for line in lines] == [
        "Without diverged worlds: EKF and FastSLAM 2.0: a fuller map, more accurate",
        "Without diverged cases: EKF and FastSLAM 2.0: a fuller map, more accurate",
        "With everything: EKF and FastSLAM 2.0: a fuller map, less accurate",
    ]


def test_the_table_has_the_bound_at_both_ends_and_the_multiple_of_each_filter():
    study = invent(60)
    for name, strategy in study.trials:
        least, times = {"active": 0.3, "fused": 0.25, "passive": 0.5}[strategy], 1.5
        for score, one in ((POSITION_BOUND, least), (POSITION, times * least)):
            study = changed(study, (name, strategy), score, lambda s, one=one: 0.0 * s + one)
    study = changed(study, ("fastslam", "fused"), POSITION, lambda error: 2.0 * error)
    found = rows(study)
    for at in ("11°", "180°"):
        at = f"position bound [m], active → fused, at {at}"
        assert found[at, "EKF"] == ("0.300 → 0.250",) * 2
    for strategy in ("active", "fused", "passive"):
        times = f"position RMSE over its bound, {strategy}"
        assert found[times, "EKF"] == ("1.50", "1.50")
    assert found["position RMSE over its bound, fused", "FastSLAM 2.0"] == ("3.00", "3.00")
    for way in study.trials:
        study = changed(study, way, POSITION_BOUND, lambda bound: np.nan * bound)
    assert "a fuller map" in answer_of(study)[0]
    assert not any("bound" in finding for finding, _ in rows(study))
