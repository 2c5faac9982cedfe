r"""Comparison: what many worlds say about a statement, and how surely.

A world gives one number: how much better one case did there than another, or a statistic of one
case. Worlds are independent and every case has met the same ones, so the differences of a pair
carry none of what makes one world harder than the next: their mean has the t interval

.. math:: \bar d \pm t_{1 - \alpha / 2, n - 1} \, s / \sqrt{n}.

A claim is a family of m such means ("at every beamwidth"), and the more of them there are, the
surer one looks extreme by luck. Holm's step-down procedure keeps the chance of any wrong
rejection in a family at alpha: the p values are taken from the smallest; the one of rank r is
held against alpha / (m - r + 1), and the first that fails ends it. The intervals given here
belong to it. Statement i has an edge :math:`e_i` (0, or a margin); testing :math:`\theta_i \le
e_i` one-sided at alpha / 2 leaves a set A of means whose hypotheses stand, and the lower bounds
are

.. math:: L_i = e_i \; (i \notin A \ne \emptyset), \qquad
          L_i = \bar d_i - t_{1 - \alpha / 2|A|} \, s_i / \sqrt{n_i} \; (i \in A), \qquad
          L_i = \max(e_i, \bar d_i - t_{1 - \alpha / 2m} \, s_i / \sqrt{n_i}) \; (A = \emptyset).

So a bound passes its edge exactly where Holm rejects, and all lower bounds hold together with
probability 1 - alpha / 2, whatever the dependence (Source: Strassburger & Bretz, Statistics in
Medicine 27, 2008; Guilbaud, Biometrical Journal 50, 2008). Upper bounds are built alike, and
both sides together hold with probability 1 - alpha. The price: of a rejected mean, while others
stand, the bound says which side of the edge it is on, and no more. How large a mean is, is said
by a wider interval, Bonferroni's,

.. math:: \bar d_i \pm t_{1 - \alpha / 2m} \, s_i / \sqrt{n_i},

of which all m hold together with probability 1 - alpha, too. What leaves its edge out is rejected
by Holm; what Holm rejects may reach just beyond it.

Where two cases have not met the same worlds, nothing is paired and a difference is that of two
means. Its standard error is :math:`\sqrt{s_1^2 / n_1 + s_2^2 / n_2}`, and its t distribution has
the degrees of freedom of Welch (Source: Biometrika 34, 1947).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

Relation = Literal["above", "not above", "slightly above", "within"]
INTERVALS = (
    "Intervals hold together, at 95 %, for all differences that are judged as one family; a "
    "difference of half an interval's width would have been shown in any case. Holm's correction "
    "decides what is shown, now and then one whose interval just reaches zero."
)
"""Sentence for readers wherever `Finding.family` is printed beside a mean."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Statement:
    """One mean over worlds, and what is claimed of it."""

    label: str
    sample: Float[np.ndarray, " n"]
    """One number per world, in any unit."""
    relation: Relation = "above"
    """"above": the mean is above the margin. "not above": it is not seen to be. "slightly
    above": it is above in this sample, but not seen to be. "within": it lies between minus
    and plus the margin."""
    margin: float = 0.0
    sigma: float = math.nan
    """How much one case varies over the worlds, in the sample's unit: a yardstick beside the
    interval, which tells how surely a mean is known and not how large it is. NaN: none."""
    fitted: bool = False
    """Whether settings were fitted to this number: that it holds then proves little."""
    against: Float[np.ndarray, " m"] | None = None
    """Numbers of other worlds: what is stated is the mean of ``sample`` less theirs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Test result of one statement, as one of a family."""

    label: str
    relation: Relation
    margin: float
    sigma: float
    fitted: bool
    n: int
    """Worlds; of two samples, those of the smaller."""
    mean: float
    std: float
    """`mean` and `std`: of the sample; NaN where it is too small to have one. Of two samples the
    difference of the means, and the standard deviation of one sample that would know it as
    surely."""
    alone: tuple[float, float]
    """t interval of this mean by itself."""
    family: tuple[float, float]
    """Bonferroni's interval: as wide as lets all of the family hold together."""
    interval: tuple[float, float]
    """Simultaneous interval, as the module says."""
    p: float
    """Two-sided, Holm-adjusted: below 1 - confidence exactly where a bound passes its edge."""
    holds: bool | None


def judge(statements: Sequence[Statement], confidence: float = 0.95) -> tuple[Finding, ...]:
    """Judge a family of statements together.

    A statement of absence ("not above", "slightly above") holds only where the family could have
    seen a mean of one standard deviation of the sample: where half the width of its widest
    interval, t / sqrt(n), is at most 1. A statement "within" stands in the family twice, since it
    has two opposites.

    `confidence`: that all intervals hold their means. Where a sample has fewer than two
    numbers, or no spread to measure, nothing is decided and the interval is infinite.

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
        resolved = _half_width((moments[0], 0.0, 1.0), share) <= 1.0
        holds, p = _verdict(statement, moments, p_low[own], p_high[own], tail, resolved)
        width, wider = _half_width(moments, tail), _half_width(moments, share)
        centre = moments[1] if math.isfinite(moments[1]) else 0.0
        findings.append(
            Finding(
                label=statement.label,
                relation=statement.relation,
                margin=statement.margin,
                sigma=statement.sigma,
                fitted=statement.fitted,
                n=_worlds(statement),
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
    r"""Return the Holm-adjusted p values of a family.

    .. math:: \tilde p_{(r)} = \min\bigl(1, \max_{s \le r} (m - s + 1) \, p_{(s)}\bigr)

    The p-values stand in the order given; rejecting those up to alpha keeps the family's error at
    alpha.

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
    r"""Return the standard deviation common to two samples, by which they are compared.

    .. math:: \sigma = \sqrt{(s_1^2 + s_2^2) / 2}

    `first`, `second`: at least two numbers each.

    >>> pooled_std(np.array([0.0, 2.0]), np.array([5.0, 5.0]))
    1.0
    """
    return math.sqrt((np.var(first, ddof=1) + np.var(second, ddof=1)) / 2.0)


def pseudovalues(
    curves: Float[np.ndarray, "n k"],
    statistic: Callable[[Float[np.ndarray, "m k"]], Float[np.ndarray, " m"]],
) -> Float[np.ndarray, " n"]:
    r"""Return what each world contributes to a statistic of the mean curve: the jackknife.

    .. math:: \theta_i = n \, T(\bar c) - (n - 1) \, T(\bar c_{-i})

    Their mean is the statistic, freed of bias of order 1/n, and a t interval of theirs is one of
    it. A linear statistic gives back its value in each world.

    `curves`: one row per world, at least two; `statistic`: t, of each row by itself.

    Source: Tukey, Annals of Mathematical Statistics 29, 1958.

    >>> pseudovalues(np.array([[1.0], [3.0], [5.0]]), lambda mean: 2.0 * mean[:, 0])
    array([ 2.,  6., 10.])
    """
    n = len(curves)
    mean = np.mean(curves, axis=0)
    without = (n * mean - curves) / (n - 1)
    return n * statistic(mean[None])[0] - (n - 1) * statistic(without)


def _worlds(statement: Statement) -> int:
    """Return the number of worlds of a statement; of two samples the smaller number."""
    both = [statement.sample, *([] if statement.against is None else [statement.against])]
    return min(map(len, both))


def _moments(statement: Statement) -> tuple[float, float, float]:
    """Return number, mean and standard deviation of a statement's sample.

    Of two samples those of one whose mean would be known as surely, by Welch.
    """
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
    """Return number, mean and standard deviation of a sample; NaN where there is none."""
    sample = np.asarray(numbers, dtype=np.float64)
    if not np.all(np.isfinite(sample)):
        raise ValueError(f"{label}: found a number that is not finite")
    mean = float(np.mean(sample)) if len(sample) else math.nan
    # What never varies says nothing of how much it varies.
    spread = len(sample) > 1 and np.ptp(sample) > 0.0
    return len(sample), mean, float(np.std(sample, ddof=1)) if spread else math.nan


def _half_width(moments: tuple[float, float, float], tail: float) -> float:
    """Return the half-width of the t interval that leaves this much outside on each side."""
    from scipy.special import stdtrit

    n, _, std = moments
    return float(-stdtrit(n - 1, tail)) * std / math.sqrt(n) if n > 1 and std > 0 else math.inf


def _lower_bounds(
    samples: Sequence[tuple[float, float, float]], edges: Sequence[float], alpha: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Bound means from below and return Holm-adjusted p values of not being above their edges."""
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
    statement: Statement,
    moments: tuple[float, float, float],
    p_low: Float[np.ndarray, " e"],
    p_high: Float[np.ndarray, " e"],
    tail: float,
    resolved: bool,
) -> tuple[bool | None, float]:
    """Decide a statement by the p values of its edges, the opposite's edges last."""
    _, mean, std = moments
    above, below = p_low <= tail, p_high <= tail
    p = min(1.0, 2.0 * float(min(p_low[0], p_high[0])))
    match statement.relation:
        case "above":
            return (True if above[0] else (False if below[0] else None)), p
        case "within":
            if above[1] or below[1]:
                return False, min(1.0, 2.0 * float(min(p_low[1], p_high[1])))
            inside = bool(above[0] and below[0])
            return (True if inside else None), min(1.0, 2.0 * float(max(p_low[0], p_high[0])))
        case "not above":
            absent = True
            seen = above[0]
        case "slightly above":
            absent = mean > statement.margin
            seen = above[0] or below[0]
    if seen:
        return False, p
    return (True if absent and resolved and std > 0.0 else None), p
