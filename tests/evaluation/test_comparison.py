"""Families of statements: against closed forms and SciPy, and by simulation with controls."""

import math

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pipistrelle.evaluation.comparison import (
    Statement,
    contrasts,
    holm,
    judge,
    pooled_std,
    pseudovalues,
)

SEED = st.integers(0, 2**32 - 1)
P_VALUES = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12).map(np.array)


def statements(samples, relation="above", margin=0.0):
    return [
        Statement(label=str(i), sample=sample, relation=relation, margin=margin)
        for i, sample in enumerate(samples)
    ]


def drawn(rng, means, n):
    """Samples of a family, correlated as differences of one world are."""
    return np.asarray(means)[:, None] + rng.normal(size=(len(means), n)) + rng.normal(size=n)


@given(SEED, st.integers(3, 60))
def test_a_single_mean_has_the_t_interval(seed, n):
    sample = np.random.default_rng(seed).normal(1.0, 2.0, n)
    (finding,) = judge(statements([sample]))
    known = stats.ttest_1samp(sample, 0.0).confidence_interval(0.95)
    assert finding.alone == pytest.approx((known.low, known.high), rel=1e-9, abs=1e-9)
    assert finding.p == pytest.approx(stats.ttest_1samp(sample, 0.0).pvalue, rel=1e-9)
    assert finding.mean == pytest.approx(sample.mean(), rel=1e-12)


@given(SEED, st.integers(3, 40), st.integers(3, 40))
def test_a_difference_of_two_samples_has_the_interval_of_welch(seed, n, m):
    rng = np.random.default_rng(seed)
    first, second = rng.normal(1.0, 2.0, n), rng.normal(2.0, 0.3, m)
    (finding,) = judge([Statement(label="", sample=second, against=first)])
    known = stats.ttest_ind(second, first, equal_var=False)
    alone = known.confidence_interval(0.95)
    assert finding.alone == pytest.approx((alone.low, alone.high), rel=1e-9, abs=1e-9)
    assert finding.interval == pytest.approx((alone.low, alone.high), rel=1e-9, abs=1e-9)
    assert finding.p == pytest.approx(known.pvalue, rel=1e-9)
    assert finding.mean == pytest.approx(second.mean() - first.mean(), rel=1e-9, abs=1e-12)
    assert finding.n == min(n, m)


def test_two_samples_without_spread_or_numbers_are_undecided():
    some, none, one = np.array([1.0, 2.0, 4.0]), np.empty(0), np.array([3.0])
    for sample, against in ((some, none), (none, some), (some, one), (one, one), (some * 0, some)):
        (finding,) = judge([Statement(label="", sample=sample, against=against)])
        assert finding.holds is None
        assert finding.interval == (-math.inf, math.inf)
        assert finding.n == min(len(sample), len(against))


def test_pairs_and_two_samples_share_a_family():
    rng = np.random.default_rng(4)
    a, b, c = (rng.normal(level, 1.0, 30) for level in (0.0, 0.7, 0.6))
    family = [Statement(label="p", sample=b - a), Statement(label="u", sample=c, against=a)]
    alone = [judge([statement])[0].p for statement in family]
    together = [finding.p for finding in judge(family)]
    assert together == pytest.approx(holm(np.array(alone)), rel=1e-9)


def test_holms_adjustment_matches_a_calculation_by_hand():
    assert holm(np.array([0.01, 0.04, 0.03, 0.005])) == pytest.approx([0.03, 0.06, 0.06, 0.02])


@given(P_VALUES)
def test_holm_keeps_the_order_and_is_at_most_bonferronis(p):
    adjusted = holm(p)
    assert (adjusted >= p).all()
    assert (adjusted <= np.minimum(len(p) * p, 1.0)).all()
    assert (np.diff(adjusted[np.argsort(p, kind="stable")]) >= 0.0).all()


@given(P_VALUES, st.floats(0.001, 0.2))
def test_holm_rejects_the_same_as_the_closed_bonferroni_test(p, alpha):
    """Each hypothesis falls when every intersection that holds it does: Holm's shortcut."""
    p = p[:6]
    closed = np.ones(len(p), dtype=bool)
    for subset in range(1, 2 ** len(p)):
        inside = np.array([bool(subset >> i & 1) for i in range(len(p))])
        falls = inside.sum() * p[inside].min() <= alpha
        closed[inside] &= falls
    assert ((holm(p) <= alpha) == closed).all()


@given(SEED, st.integers(1, 8), st.integers(3, 20))
def test_a_bound_passes_its_edge_exactly_where_p_is_small(seed, m, n):
    rng = np.random.default_rng(seed)
    for finding in judge(statements(drawn(rng, rng.normal(0.0, 1.5, m), n))):
        low, high = finding.interval
        assert low <= finding.mean <= high
        assert (low >= 0.0 or high <= 0.0) == (finding.p <= 0.05)
        assert finding.holds == (True if low >= 0.0 else (False if high <= 0.0 else None))


@given(SEED, st.integers(2, 8))
def test_the_order_of_a_family_does_not_matter(seed, m):
    rng = np.random.default_rng(seed)
    samples = drawn(rng, rng.normal(0.0, 1.0, m), 12)
    order = rng.permutation(m)
    there = judge(statements(samples))
    here = judge([statements(samples)[i] for i in order])
    for i, finding in zip(order, here, strict=True):
        assert finding.interval == pytest.approx(there[i].interval)
        assert finding.p == pytest.approx(there[i].p)


@given(SEED, st.floats(1e-3, 1e3))
def test_the_unit_of_the_sample_does_not_matter(seed, unit):
    rng = np.random.default_rng(seed)
    samples = drawn(rng, [0.0, 0.4, 2.0], 15)
    for relation in ("above", "within"):
        ours = judge(statements(samples, relation, 0.5))
        theirs = judge(statements(samples * unit, relation, 0.5 * unit))
        for one, other in zip(ours, theirs, strict=True):
            assert other.holds is one.holds
            assert np.array(other.interval) / unit == pytest.approx(one.interval, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "means",
    [np.zeros(8), np.full(8, 5.0), [0.0, 0.0, 0.0, 0.0, 3.0, 3.0, 0.6, -0.6]],
    ids=["nothing", "all large", "some"],
)
def test_family_intervals_cover_jointly_and_single_intervals_do_not(means):
    rng = np.random.default_rng(11)
    runs, together, alone = 2000, 0, 0
    for _ in range(runs):
        findings = judge(statements(drawn(rng, means, 20)))
        pairs = list(zip(findings, means, strict=True))
        together += all(f.interval[0] <= mean <= f.interval[1] for f, mean in pairs)
        alone += all(f.alone[0] <= mean <= f.alone[1] for f, mean in pairs)
    error = math.sqrt(0.95 * 0.05 / runs)
    assert together / runs >= 0.95 - 3.0 * error
    assert alone / runs < 0.95 - 6.0 * error, "the control: without correction they fail"


def test_holm_resolves_a_weak_effect_that_bonferroni_misses():
    rng = np.random.default_rng(5)
    strong = list(drawn(rng, np.full(7, 4.0), 20))
    weak = rng.normal(size=20)
    weak = (weak - weak.mean()) / weak.std(ddof=1)
    weak = weak + stats.t.ppf(1 - 0.025 / 3, 19) / math.sqrt(20)  # enough at 1/3, not at 1/8
    *_, finding = judge(statements([*strong, weak]))
    assert finding.holds is True
    bonferroni = stats.t.ppf(1 - 0.025 / 8, 19) / math.sqrt(20)
    assert weak.mean() - bonferroni < 0.0


@given(SEED)
def test_a_single_statement_of_nearness_is_two_one_sided_tests(seed):
    rng = np.random.default_rng(seed)
    sample = rng.normal(rng.uniform(-1.5, 1.5), 1.0, 12)
    (finding,) = judge(statements([sample], "within", 1.0))
    # In the family stand both opposites: beyond either margin.
    inside = [
        stats.ttest_1samp(sample, -1.0, alternative="greater").pvalue,
        stats.ttest_1samp(sample, 1.0, alternative="less").pvalue,
    ]
    below = [inside[0], stats.ttest_1samp(sample, 1.0, alternative="greater").pvalue]
    above = [inside[1], stats.ttest_1samp(sample, -1.0, alternative="less").pvalue]
    rejected = [holm(np.array(pair)) <= 0.025 for pair in (below, above)]
    near = bool(rejected[0][0] and rejected[1][0])
    far = bool(rejected[0][1] or rejected[1][1])
    assert finding.holds is (False if far else (True if near else None))


def test_statements_of_nearness_are_confirmed_or_refuted():
    shape = np.linspace(-1.0, 1.0, 60)
    near, far, between = judge(
        [
            *statements([shape + 0.2, shape + 3.0], "within", 1.0),
            Statement(label="", sample=shape + 1.0, relation="within", margin=1.0),
        ]
    )
    assert (near.holds, far.holds, between.holds) == (True, False, None)
    assert -1.0 <= near.interval[0] < near.interval[1] <= 1.0
    assert far.interval[0] >= 1.0


def test_a_statement_of_nearness_counts_twice_in_its_family():
    shape = np.linspace(-1.0, 1.0, 9)
    first, _ = judge([*statements([shape]), *statements([shape], "within", 9.0)])
    half_width = stats.t.ppf(1.0 - 0.025 / 3, 8) * shape.std(ddof=1) / 3.0
    assert first.family == pytest.approx((-half_width, half_width))


@pytest.mark.parametrize("confidence", [0.5, 0.8, 0.95, 0.99, 0.9999])
def test_the_confidence_asked_for_decides(confidence):
    shape = np.linspace(-1.0, 1.0, 12)
    for shift in np.linspace(0.05, 1.0, 20):
        (finding,) = judge(statements([shape + shift]), confidence)
        known = stats.ttest_1samp(shape + shift, 0.0)
        assert (finding.holds is True) == (known.pvalue < 1.0 - confidence)
        bounds = known.confidence_interval(confidence)
        assert finding.interval[1] == pytest.approx(bounds.high, rel=1e-9)


@pytest.mark.parametrize("standing", [1, 2, 3])
def test_undecided_statements_share_alpha_in_their_intervals(standing):
    shape, n = np.linspace(-1.0, 1.0, 20), 20
    weak = [shape + 0.01 * i for i in range(standing)]
    findings = judge(statements([*weak, *(shape + 9.0 for _ in range(8 - standing))]))
    assert [f.holds for f in findings] == [None] * standing + [True] * (8 - standing)
    low = stats.t.ppf(1.0 - 0.025 / standing, n - 1) * shape.std(ddof=1) / math.sqrt(n)
    high = stats.t.ppf(1.0 - 0.025 / 8, n - 1) * shape.std(ddof=1) / math.sqrt(n)  # none is below
    for finding in findings[:standing]:
        assert finding.interval == pytest.approx((finding.mean - low, finding.mean + high))


@pytest.mark.parametrize("sample", [[], [1.0], [2.0, 2.0], [0.1 + 0.2] * 30])
@pytest.mark.parametrize("relation", ["above", "within"])
def test_a_sample_without_spread_is_undecided(sample, relation):
    (finding,) = judge(statements([np.array(sample)], relation, 0.5))
    assert finding.holds is None
    assert finding.interval == (-math.inf, math.inf)
    assert finding.alone == (-math.inf, math.inf)
    assert finding.p == 1.0
    assert finding.n == len(sample)


def test_no_statements_give_no_findings():
    assert judge([]) == ()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_refused_by_name(bad):
    with pytest.raises(ValueError, match="gain at 33°"):
        judge([Statement(label="gain at 33°", sample=np.array([1.0, bad]))])


def test_the_common_deviation_is_the_root_of_the_mean_variance():
    rng = np.random.default_rng(2)
    first, second = rng.normal(0, 3.0, 40), rng.normal(9, 4.0, 40)
    expected = math.sqrt((first.var(ddof=1) + second.var(ddof=1)) / 2)
    assert pooled_std(first, second) == pytest.approx(expected)
    assert pooled_std(second, first) == pooled_std(first, second)


@given(SEED)
def test_pseudovalues_of_a_linear_statistic_are_its_values(seed):
    rng = np.random.default_rng(seed)
    curves, weights = rng.normal(size=(7, 5)), rng.normal(size=5)
    values = pseudovalues(curves, lambda mean: mean @ weights)
    assert values == pytest.approx(curves @ weights, abs=1e-12)


def test_pseudovalues_remove_the_bias_of_a_square():
    """The square of a mean of n draws is too large by s^2/n: the jackknife takes off just that."""
    sample = np.random.default_rng(4).normal(3.0, 1.0, (500, 1))
    values = pseudovalues(sample, lambda mean: mean[:, 0] ** 2)
    mean, variance = sample.mean(), sample.var(ddof=1)
    assert values.mean() == pytest.approx(mean**2 - variance / 500, rel=1e-12)
    # By the delta method the error is 2 |mean| s / sqrt(n), to relative order 1 / sqrt(n).
    error = values.std(ddof=1) / math.sqrt(500)
    assert error == pytest.approx(2 * mean * math.sqrt(variance / 500), rel=3 / math.sqrt(500))


def test_the_familys_intervals_are_as_wide_as_lets_all_of_them_hold_and_nothing_open_leaves_zero():
    rng = np.random.default_rng(5)
    samples = [rng.normal(mean, 1.0, 20) for mean in (5.0, 0.5, 0.3, -0.2, 0.0)]
    findings = judge([Statement(label="", sample=sample) for sample in samples])
    assert {True, None} <= {finding.holds for finding in findings}, "a family of both kinds"
    for finding, sample in zip(findings, samples, strict=True):
        known = stats.ttest_1samp(sample, 0.0).confidence_interval(1.0 - 0.05 / 5)
        assert finding.family == pytest.approx((known.low, known.high), rel=1e-9)
        low, high = finding.family
        assert finding.holds is not None or low <= 0.0 <= high
        assert low <= finding.alone[0] <= finding.alone[1] <= high
        for more in (1.01, -1.01):
            moved = sample - sample.mean() + more * (high - low) / 2.0
            others = [other for other in samples if other is not sample]
            again, *_ = judge([Statement(label="", sample=one) for one in (moved, *others)])
            assert again.holds is (more > 0.0), "half the width is shown whatever the others are"


def table(**columns):
    """Rows of six worlds for each of the levels, repeated for each of the rooms."""
    rng = np.random.default_rng(8)
    frame = pl.DataFrame({"level": ["low", "high", "top"]}).join(
        pl.DataFrame({"room": [1, 2]}), how="cross"
    )
    frame = frame.join(pl.DataFrame({"world": range(6)}), how="cross")
    return frame.with_columns(value=pl.Series(rng.normal(size=len(frame))), **columns)


def values_of(frame, **asked):
    return frame.filter(*(pl.col(name) == value for name, value in asked.items()))["value"]


def test_contrasts_compare_every_value_with_the_first_in_each_group():
    frame = table()
    found = contrasts(frame, "level", ["room"], family=["room"])
    assert [(one.by["room"], one.a, one.b) for one in found] == [
        (room, "low", level) for level in ("high", "top") for room in (1, 2)
    ]
    for room in (1, 2):
        low = values_of(frame, room=room, level="low").to_numpy()
        samples = [values_of(frame, room=room, level=b).to_numpy() - low for b in ("high", "top")]
        expected = judge([Statement(label="", sample=sample) for sample in samples])
        mine = [one.finding for one in found if one.by["room"] == room]
        assert [f.p for f in mine] == [f.p for f in expected]
        assert [f.family for f in mine] == [f.family for f in expected]


def test_contrasts_average_over_columns_in_worlds_with_all_numbers():
    spoilt = (pl.col("world") == 2) & (pl.col("room") == 1) & (pl.col("level") == "high")
    frame = table().with_columns(value=pl.when(~spoilt).then("value"))
    high, top = contrasts(frame, "level", over=["room"])
    assert (high.worlds, top.worlds) == ((5, 5), (6, 6))
    sides = [
        values_of(frame, level=level).to_numpy().reshape(2, 6).mean(axis=0)
        for level in ("top", "low")
    ]
    assert top.finding.mean == pytest.approx(np.mean(sides[0] - sides[1]), rel=1e-12)
    assert top.means == pytest.approx((sides[1].mean(), sides[0].mean()), rel=1e-12)


def test_contrasts_of_different_draws_are_not_paired():
    frame = table(draw=pl.col("level") == "top").filter(pl.col("room") == 1)
    high, top = contrasts(frame, "level", draw="draw")
    assert (high.paired, top.paired) == (True, False)
    low, other = (values_of(frame, level=level).to_numpy() for level in ("low", "top"))
    samples = values_of(frame, level="high").to_numpy() - low
    expected = judge(
        [Statement(label="", sample=samples), Statement(label="", sample=other, against=low)]
    )
    assert [high.finding.p, top.finding.p] == [finding.p for finding in expected]


@pytest.mark.parametrize(("aside", "count"), [(True, 1), (False, 2)])
def test_equal_contrasts_may_leave_their_family(aside, count):
    frame = table().filter(pl.col("room") == 1)
    low = dict(frame.filter(pl.col("level") == "low").select("world", "value").iter_rows())
    same = pl.col("world").replace_strict(low)
    frame = frame.with_columns(
        value=pl.when(pl.col("level") == "high").then(same).otherwise("value")
    )
    high, top = contrasts(frame, "level", set_same_aside=aside)
    assert (high.same, top.same) == (True, False)
    sample = values_of(frame, level="top").to_numpy() - np.array(list(low.values()))
    (single,) = judge([Statement(label="", sample=sample)])
    assert top.finding.p == pytest.approx(min(1.0, count * single.p))


def test_a_contrast_without_worlds_in_common_decides_nothing():
    frame = table().filter(pl.col("level") != "top")
    shifted = pl.when(pl.col("level") == "high").then(pl.col("world") + 10).otherwise("world")
    (one,) = contrasts(frame.with_columns(world=shifted), "level", over=["room"])
    assert (one.worlds, one.finding.n, one.finding.holds) == ((0, 0), 0, None)
