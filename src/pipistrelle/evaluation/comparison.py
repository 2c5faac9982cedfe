r"""Statistics over worlds: paired differences, their intervals and families of tests.

Each world gives a number: the difference of two cases, or a statistic of a case. Worlds are
independent and all cases meet the same worlds, so paired differences do not depend on how hard a
world is. Their mean has the t interval

.. math:: \bar d \pm t_{1 - \alpha / 2, n - 1} \, s / \sqrt{n}.

A claim is a family of m such means ("at every beamwidth"). Holm's step-down procedure keeps the
probability of any wrong rejection in a family at alpha: the p values are taken in rising order,
the p value of rank r is compared with alpha / (m - r + 1), and the first failure ends the
procedure. The intervals given here belong to it. Statement i has an edge :math:`e_i` (0, or a
margin); testing :math:`\theta_i \le e_i` one-sided at alpha / 2 leaves a set A of means whose
hypotheses are not rejected, and the lower bounds are

.. math:: L_i = e_i \; (i \notin A \ne \emptyset), \qquad
          L_i = \bar d_i - t_{1 - \alpha / 2|A|} \, s_i / \sqrt{n_i} \; (i \in A), \qquad
          L_i = \max(e_i, \bar d_i - t_{1 - \alpha / 2m} \, s_i / \sqrt{n_i}) \; (A = \emptyset).

So a bound passes its edge exactly if Holm rejects, and all lower bounds hold together with
probability 1 - alpha / 2 under any dependence (Source: Strassburger & Bretz, Statistics in
Medicine 27, 2008; Guilbaud, Biometrical Journal 50, 2008). Upper bounds are built in the same way,
and both sides together hold with probability 1 - alpha. While other hypotheses remain, the bound
of a rejected mean only gives its side of the edge. The size of a mean is given by the wider
interval of Bonferroni,

.. math:: \bar d_i \pm t_{1 - \alpha / 2m} \, s_i / \sqrt{n_i};

all m of them hold together with probability 1 - alpha. Holm rejects every mean whose interval
excludes its edge, and some whose interval just includes it.

Two cases that met different worlds are not paired: their difference of means has the standard
error :math:`\sqrt{s_1^2 / n_1 + s_2^2 / n_2}` and a t distribution with the degrees of freedom of
Welch (Source: Biometrika 34, 1947).

`contrasts` compares the values of any factor of a table in this way.
"""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    import polars as pl

Relation = Literal["above", "within"]
INTERVALS = (
    "The 95 % intervals of a family hold together. Holm's correction decides what is shown, "
    "always a difference of half an interval's width, rarely one whose interval reaches zero."
)
"""Explanation to be printed wherever `Finding.family` is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Statement:
    """A claim about the mean of a sample with a number per world."""

    label: str
    sample: Float[np.ndarray, " n"]
    """A number per world, in any unit."""
    relation: Relation = "above"
    """"above": the mean is above the margin. "within": it is between minus and plus the margin."""
    margin: float = 0.0
    against: Float[np.ndarray, " m"] | None = None
    """Numbers of other worlds, whose mean is subtracted from the mean of ``sample``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Test result of a statement: mean, confidence intervals, p value, and whether it holds."""

    n: int
    """Number of worlds, of two samples in the smaller."""
    mean: float
    std: float
    """`mean` and `std`: of the sample; NaN if it is too small. Of two samples the difference of the
    means, and the standard deviation of a single sample with the same standard error."""
    alone: tuple[float, float]
    """t interval of this mean, without correction."""
    family: tuple[float, float]
    """Bonferroni's interval: those of a family hold together."""
    interval: tuple[float, float]
    """Simultaneous interval of Holm's procedure."""
    p: float
    """Two-sided, Holm-adjusted: below 1 - confidence exactly if a bound passes its edge."""
    holds: bool | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Contrast:
    """Comparison of two values of a factor, such as two filters, over worlds."""

    by: Mapping[str, Any]
    """Values of the columns that both have in common."""
    a: Any
    b: Any
    paired: bool
    """Whether both met the same worlds."""
    worlds: tuple[int, int]
    """Numbers of worlds that count."""
    means: tuple[float, float]
    """Over these worlds; NaN without any."""
    same: bool
    """Whether both are equal in every world."""
    finding: Finding
    """Test of b minus a."""


def contrasts(
    frame: "pl.DataFrame",
    factor: str,
    by: Sequence[str] = (),
    *,
    over: Sequence[str] = (),
    family: Sequence[str] = (),
    draw: str = "",
    set_same_aside: bool = False,
) -> tuple[Contrast, ...]:
    """Compare every value of a factor with its first value, world by world.

    Parameters
    ----------
    frame : polars.DataFrame
        A row per number: columns `world`, `value` (null or NaN: does not count) and those named
        below, without nulls.
    factor : str
        Column whose values are compared. The value of the first row of a group is the reference.
    by : sequence of str
        Columns that group the rows; values are compared within a group.
    over : sequence of str
        Columns over which differences are averaged in each world. A world counts if all of its
        differences are finite.
    family : sequence of str
        Columns whose values, at the compared value, name the family of tests; none: a single one.
    draw : str
        Column of the draw of the worlds. Values of different draws are not paired. Empty: all
        worlds are the same.
    set_same_aside : bool
        Whether contrasts that are equal in every world are left out of their family.

    Returns
    -------
    tuple of Contrast
        In the order of the rows.

    Examples
    --------
    >>> import polars as pl
    >>> frame = pl.DataFrame({
    ...     "world": [1, 2, 3] * 2,
    ...     "strategy": ["active"] * 3 + ["fused"] * 3,
    ...     "value": [1.0, 2.0, 3.0, 0.5, 1.3, 2.4],
    ... })
    >>> (contrast,) = contrasts(frame, "strategy")
    >>> contrast.a, contrast.b, round(contrast.finding.mean, 6), contrast.finding.holds
    ('active', 'fused', -0.6, False)
    """
    import polars as pl

    keys = [*by, factor]
    rows = frame.with_row_index("_row").with_columns(pl.col("value").cast(float).fill_null(np.nan))
    rows = rows.with_columns(
        (pl.col(factor).first().over([*by]) if by else pl.col(factor).first()).alias("_a"),
        (pl.col(draw) if draw else pl.lit(0)).alias("_draw"),
    )
    first = rows.filter(pl.col(factor) == pl.col("_a")).select(
        *by, *over, "world", _first="value", _draw_a="_draw"
    )
    second = rows.filter(pl.col(factor) != pl.col("_a"))
    change = pl.col("value") - pl.col("_first")
    joined = second.join(first, on=[*by, *over, "world"]).sort("_row")
    paired = _by_key(joined.with_columns(_change=change), keys, ["_change", "_first", "value"])
    lone_a, lone_b = _by_key(first, [*by], ["_first"]), _by_key(second, keys, ["value"])
    draws = {row[:-1]: row[-1] for row in first.select(*by, "_draw_a").iter_rows()}
    judged: dict[Hashable, list[tuple[int, Statement]]] = {}
    found: list[dict[str, Any]] = []
    for row in second.unique(keys, keep="first", maintain_order=True).iter_rows(named=True):
        group = tuple(row[column] for column in by)
        key, label = (*group, row[factor]), f"{row[factor]}"
        empty = np.empty(0)
        if same_draw := draws.get(group) == row["_draw"]:
            sample, a, b = paired.get(key, (empty,) * 3)
            statement = Statement(label=label, sample=sample)
        else:
            (a,), (b,) = lone_a.get(group, (empty,)), lone_b.get(key, (empty,))
            statement = Statement(label=label, sample=b, against=a)
        same = same_draw and len(a) > 0 and not statement.sample.any()
        head = {
            "by": dict(zip(by, group, strict=True)),
            "a": row["_a"],
            "b": row[factor],
            "paired": same_draw,
            "worlds": (len(a), len(b)),
            "means": tuple(float(np.mean(one)) if len(one) else math.nan for one in (a, b)),
            "same": same,
        }
        name = tuple(row[column] for column in family)
        name = (*name, len(found)) if same and set_same_aside else name
        judged.setdefault(name, []).append((len(found), statement))
        found.append(head)
    for members in judged.values():
        findings = judge([statement for _, statement in members])
        for (place, _), finding in zip(members, findings, strict=True):
            found[place]["finding"] = finding
    return tuple(Contrast(**head) for head in found)


def _by_key(
    rows: "pl.DataFrame", keys: Sequence[str], columns: Sequence[str]
) -> dict[tuple[Any, ...], tuple[Float[np.ndarray, " n"], ...]]:
    """Average columns per world; return them by key, as arrays over worlds with finite values."""
    import polars as pl

    means = rows.group_by([*keys, "world"], maintain_order=True).agg(pl.col(*columns).mean())
    means = means.filter(pl.col(columns[0]).is_finite())
    samples = means.group_by([*keys], maintain_order=True).agg(*columns) if keys else None
    if samples is None:
        return {(): tuple(means[column].to_numpy() for column in columns)}
    return {
        row[: len(keys)]: tuple(np.array(one, dtype=float) for one in row[len(keys) :])
        for row in samples.iter_rows()
    }


def judge(statements: Sequence[Statement], confidence: float = 0.95) -> tuple[Finding, ...]:
    """Test statements together with Holm's correction; return the finding of each.

    A statement "within" counts twice, since it has two opposites.

    `confidence`: probability that all intervals hold their means. A sample of fewer than two
    numbers, or without spread, decides nothing and has an infinite interval.

    >>> worlds = np.array([1.0, 2.0, 3.0, 2.0])
    >>> ours, theirs = judge(
    ...     [Statement(label="gain", sample=worlds), Statement(label="loss", sample=-worlds)]
    ... )
    >>> ours.holds, theirs.holds, [round(bound, 2) for bound in ours.alone]
    (True, False, [0.7, 3.3])
    """
    samples, edges, rows = [], [], []
    for statement in statements:
        margin, first = statement.margin, len(edges)
        edges += [(margin, margin)]
        if statement.relation == "within":
            edges[first:] = [(-margin, margin), (margin, -margin)]
        rows.append(slice(first, len(edges)))
        samples += [_moments(statement)] * (len(edges) - first)
    tail = (1.0 - confidence) / 2.0
    mirrored = [(n, -mean, std) for n, mean, std in samples]
    low, p_low = _lower_bounds(samples, [edge for edge, _ in edges], tail)
    high, p_high = _lower_bounds(mirrored, [-edge for _, edge in edges], tail)
    findings = []
    for statement, own in zip(statements, rows, strict=True):
        moments = samples[own.start]
        share = tail / len(samples)
        holds, p = _verdict(statement.relation, p_low[own], p_high[own], tail)
        width, wider = _half_width(moments, tail), _half_width(moments, share)
        centre = moments[1] if math.isfinite(moments[1]) else 0.0
        findings.append(
            Finding(
                n=min(len(one) for one in (statement.sample, statement.against) if one is not None),
                mean=moments[1],
                std=moments[2],
                alone=(centre - width, centre + width),
                family=(centre - wider, centre + wider),
                interval=(float(np.max(low[own])), float(-np.max(high[own]))),
                p=p,
                holds=holds,
            )
        )
    return tuple(findings)


def holm(p: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    r"""Return the Holm-adjusted p values of a family, in the given order.

    .. math:: \tilde p_{(r)} = \min\bigl(1, \max_{s \le r} (m - s + 1) \, p_{(s)}\bigr)

    Rejecting p values up to alpha keeps the family's error at alpha.

    Source: Holm, Scandinavian Journal of Statistics 6, 1979.

    >>> holm(np.array([0.04, 0.01, 0.03]))
    array([0.06, 0.03, 0.06])
    """
    order = np.argsort(p, kind="stable")
    steps = np.maximum.accumulate((len(p) - np.arange(len(p))) * p[order])
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(steps, 1.0)
    return adjusted


def pooled_std(first: Float[np.ndarray, " n"], second: Float[np.ndarray, " m"]) -> float:
    r"""Return the pooled standard deviation of two samples of equal weight.

    .. math:: \sigma = \sqrt{(s_1^2 + s_2^2) / 2}

    >>> pooled_std(np.array([0.0, 2.0]), np.array([5.0, 5.0]))
    1.0
    """
    return math.sqrt((np.var(first, ddof=1) + np.var(second, ddof=1)) / 2.0)


def pseudovalues(
    curves: Float[np.ndarray, "n k"],
    statistic: Callable[[Float[np.ndarray, "m k"]], Float[np.ndarray, " m"]],
) -> Float[np.ndarray, " n"]:
    r"""Return jackknife pseudo-values of a statistic of the mean curve over worlds.

    .. math:: \theta_i = n \, T(\bar c) - (n - 1) \, T(\bar c_{-i})

    Their mean is the statistic without bias of order 1/n, and their t interval is an interval of
    it. A linear statistic gives its value in each world.

    `curves`: a row per world, at least two. `statistic`: T of each row.

    Source: Tukey, Annals of Mathematical Statistics 29, 1958.

    >>> pseudovalues(np.array([[1.0], [3.0], [5.0]]), lambda mean: 2.0 * mean[:, 0])
    array([ 2.,  6., 10.])
    """
    n = len(curves)
    mean = np.mean(curves, axis=0)
    without = (n * mean - curves) / (n - 1)
    return n * statistic(mean[None])[0] - (n - 1) * statistic(without)


def _moments(statement: Statement) -> tuple[float, float, float]:
    """Return size, mean and std of a sample, or Welch's equivalent of two samples' difference."""
    n, mean, std = _sample_moments(statement.label, statement.sample)
    if statement.against is None:
        return n, mean, std
    m, other, spread = _sample_moments(statement.label, statement.against)
    squares = std * std / max(n, 1), spread * spread / max(m, 1)
    if not sum(squares) > 0.0:
        return n, mean - other, math.nan
    freedom = sum(squares) ** 2 / (squares[0] ** 2 / (n - 1) + squares[1] ** 2 / (m - 1))
    return freedom + 1.0, mean - other, math.sqrt(sum(squares) * (freedom + 1.0))


def _sample_moments(label: str, numbers: Float[np.ndarray, " n"]) -> tuple[int, float, float]:
    """Return size, mean and standard deviation of a sample; NaN if undefined."""
    sample = np.asarray(numbers, dtype=np.float64)
    if not np.all(np.isfinite(sample)):
        raise ValueError(f"{label}: found a number that is not finite")
    mean = float(np.mean(sample)) if len(sample) else math.nan
    spread = len(sample) > 1 and np.ptp(sample) > 0.0
    return len(sample), mean, float(np.std(sample, ddof=1)) if spread else math.nan


def _half_width(moments: tuple[float, float, float], tail: float) -> float:
    """Return the half-width of the t interval with a probability of `tail` on each side."""
    from scipy.special import stdtrit

    n, _, std = moments
    return float(-stdtrit(n - 1, tail)) * std / math.sqrt(n) if n > 1 and std > 0 else math.inf


def _lower_bounds(
    samples: Sequence[tuple[float, float, float]], edges: Sequence[float], alpha: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Return simultaneous lower bounds of means, and Holm's p values against given edges."""
    from scipy.special import stdtr

    p = np.ones(len(samples))
    for i, ((n, mean, std), edge) in enumerate(zip(samples, edges, strict=True)):
        if std > 0.0:
            p[i] = stdtr(n - 1, (edge - mean) * math.sqrt(n) / std)
    adjusted = holm(p)
    standing = adjusted > alpha
    count = int(np.sum(standing)) or len(samples)
    bounds = np.array(edges, dtype=np.float64)
    for i, moments in enumerate(samples):
        if standing.any() and not standing[i]:
            continue
        bound = np.nan_to_num(moments[1]) - _half_width(moments, alpha / count)
        bounds[i] = bound if standing[i] else max(bound, edges[i])
    return bounds, adjusted


def _verdict(
    relation: Relation, p_low: Float[np.ndarray, " e"], p_high: Float[np.ndarray, " e"], tail: float
) -> tuple[bool | None, float]:
    """Decide a statement from the p values of its edges, the opposite's edges last."""
    above, below = p_low <= tail, p_high <= tail
    p = min(1.0, 2.0 * float(min(p_low[-1], p_high[-1])))
    if relation == "above":
        return (True if above[0] else (False if below[0] else None)), p
    if above[1] or below[1]:
        return False, p
    inside = bool(above[0] and below[0])
    return (True if inside else None), min(1.0, 2.0 * float(max(p_low[0], p_high[0])))
