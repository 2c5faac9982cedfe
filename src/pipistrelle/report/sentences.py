r"""The 26 sentences of the paper that state results, each judged in three ways.

Bradley & Abaid state results in Secs. V-A to V-D and Appendix A. Each sentence is a list of
comparisons: a statistic over worlds that the sentence says is above 0, or within a margin of 0.
The worlds are those that the paper's exclusion leaves.

- **By means**: the statistic has the stated sign or size.
- **By bands**, the paper's yardstick for significance: the bands of one standard deviation over the
  worlds, :math:`m_1 \pm \sigma_1` and :math:`m_2 \pm \sigma_2`, do not contradict the sentence.
  What it calls larger is not smaller by more than :math:`\sigma_1 + \sigma_2`; what it calls not
  significant has overlapping bands.
- **By intervals**: the t interval of the statistic, corrected for all comparisons of the sentence
  (`evaluation.comparison.judge`). It alone says how surely a mean is known.

Standard deviations, maxima and other statistics of all worlds are jackknifed
(`evaluation.comparison.pseudovalues`). The paper's own sampling error is that of its 107 or 100
worlds, our standard deviation of the difference being the estimate of its own.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from pipistrelle.config import STRATEGIES
from pipistrelle.evaluation.comparison import Statement, judge, pooled_std, pseudovalues
from pipistrelle.report.claims import (
    CROSSING,
    EXCLUDED,
    FILTERS,
    NARROW,
    SEEN,
    TABLE_II,
    WORLDS,
    cell_of,
    curves,
    departure,
    lap_fit,
    row_name,
)
from pipistrelle.report.study import (
    COMMON,
    HEADING,
    LANDMARKS,
    POSITION,
    Selection,
    Way,
    case_name,
    own_cases,
    samples,
)

Worlds = Float[np.ndarray, " n"]
ACTIVE, FUSED, PASSIVE = STRATEGIES


class Comparison(NamedTuple):
    """A statistic over worlds, to be above 0 or within a margin of 0."""

    label: str
    sample: Worlds
    """A number per world, whose mean is the statistic."""
    band: float = 0.0
    """Sum of the standard deviations over worlds of the two numbers compared; 0 if the statistic is
    no difference of two means."""
    margin: float | None = None
    """Bound of the absolute value; None: the statistic exceeds `least`."""
    least: float = 0.0
    """Bound from below."""

    def by_means(self) -> bool:
        """Return whether the mean has the stated sign or size."""
        mean = float(np.mean(self.sample))
        return mean > self.least if self.margin is None else abs(mean) <= self.margin

    def by_bands(self) -> bool:
        """Return whether bands of one standard deviation do not contradict the sentence."""
        mean = float(np.mean(self.sample))
        if self.margin is not None:
            return abs(mean) <= max(self.margin, self.band)
        return mean > (self.least or -self.band)

    def statement(self) -> Statement:
        """Return the comparison as a statement for `judge`."""
        if self.margin is None:
            return Statement(label=self.label, sample=self.sample, margin=self.least)
        return Statement(
            label=self.label, sample=self.sample, relation="within", margin=self.margin
        )


Comparisons = Callable[[Selection], Iterable[Comparison]]
"""Makes comparisons, which must all hold."""


class Most(NamedTuple):
    """A part of a sentence that holds if more than half of its comparisons do."""

    make: Comparisons

    def __call__(self, selection: Selection) -> Iterable[Comparison]:
        """Make the comparisons."""
        return self.make(selection)


class Sentence(NamedTuple):
    """A sentence of the paper, with the comparisons that it makes."""

    number: int
    claim: int
    """Claim to which it belongs."""
    section: str
    words: str
    parts: tuple[Comparisons, ...]
    """Each makes some comparisons; all parts must hold."""


def judge_sentences(selection: Selection) -> list[dict[str, Any]]:
    """Judge every sentence by means, bands and intervals: rows of ``summary.json``.

    `selection`: usually under the rule "world", the paper's. Each yardstick has the number of
    comparisons that hold, and whether the sentence holds; None: undecided, or without cases.
    """
    return [_judged(sentence, selection) for sentence in SENTENCES]


def _judged(sentence: Sentence, selection: Selection) -> dict[str, Any]:
    """Judge a sentence: its row of ``summary.json``."""
    parts = [[one for one in make(selection) if one.sample.size > 1] for make in sentence.parts]
    made = [one for part in parts for one in part]
    findings = judge([one.statement() for one in made])
    row: dict[str, Any] = {
        "sentence": sentence.number,
        "claim": sentence.claim,
        "section": sentence.section,
        "words": sentence.words,
        "comparisons": len(made),
        "papers_error": _papers_error(made),
    }
    yardsticks: dict[str, list[bool | None]] = {
        "means": [one.by_means() for one in made],
        "bands": [one.by_bands() for one in made],
        "intervals": [finding.holds for finding in findings],
    }
    for name, verdicts in yardsticks.items():
        left = iter(verdicts)
        by_part = [
            _holds([next(left) for _ in part], isinstance(make, Most))
            for make, part in zip(sentence.parts, parts, strict=True)
        ]
        row[name] = verdicts.count(True)
        row[f"by_{name}"] = False if False in by_part else (None if None in by_part else True)
    return row | {"refuted": yardsticks["intervals"].count(False)}


def _holds(verdicts: Sequence[bool | None], most: bool) -> bool | None:
    """Decide a part from its comparisons; without any it is undecided."""
    need = len(verdicts) // 2 + 1 if most else len(verdicts)
    if verdicts.count(False) > len(verdicts) - need:
        return False
    return True if verdicts and verdicts.count(True) >= need else None


def _papers_error(made: Sequence[Comparison]) -> float | None:
    """Return the median standard error of the paper's means, of its 107 worlds."""
    spreads = [float(np.std(one.sample, ddof=1)) for one in made]
    kept = WORLDS - EXCLUDED["ekf"]
    return float(np.median(spreads)) / math.sqrt(kept) if spreads else None


# Comparisons of two cases


def _pairs(
    selection: Selection,
    score: str,
    first: Way,
    second: Way,
    above: float = 0.0,
    below: float = math.inf,
) -> Iterator[tuple[str, Worlds, Worlds]]:
    """Yield label and scores of two ways at each beamwidth [deg] from `above` to below `below`."""
    study = selection.study
    if not {first, second} <= study.trials.keys():
        return
    numbers = sorted({*own_cases(study.trials[first]), *own_cases(study.trials[second])})
    for i in map(int, numbers):
        if above <= study.beamwidth[i] < below:
            a, b = samples(selection, score, [(*first, i), (*second, i)])
            beam = case_name(study, first, i) or case_name(study, second, i)
            names = f"{FILTERS[first[0]]} {first[1]}, {FILTERS[second[0]]} {second[1]}"
            yield f"{names}, {beam}".rstrip(", "), a, b


def _spread(sample: Worlds) -> float:
    """Return the standard deviation over worlds; 0 of a single world."""
    return float(np.std(sample, ddof=1)) if len(sample) > 1 else 0.0


def _larger(
    score: str, *pairs: tuple[Way, Way], near: bool = False, by_sigma: bool = False, **beams: float
) -> Comparisons:
    """Compare means: the first of each pair is larger, or larger by σ, or they differ by at most σ.

    σ is the pooled standard deviation over worlds.
    """

    def made(selection: Selection) -> Iterator[Comparison]:
        for pair in pairs:
            for label, a, b in _pairs(selection, score, *pair, **beams):
                if len(a) > 1:
                    band, sigma = _spread(a) + _spread(b), pooled_std(a, b)
                    margin, least = sigma if near else None, sigma if by_sigma else 0.0
                    yield Comparison(label, a - b, band, margin, least)

    return made


_near, _larger_by_sigma = partial(_larger, near=True), partial(_larger, by_sigma=True)


def _more_spread(score: str, *pairs: tuple[Way, Way]) -> Comparisons:
    """Compare standard deviations over worlds: the first of each pair has the larger."""

    def made(selection: Selection) -> Iterator[Comparison]:
        for pair in pairs:
            for label, a, b in _pairs(selection, score, *pair):
                if len(a) > 2:
                    yield Comparison(f"σ, {label}", _stds(a, b) @ [1.0, -1.0])

    return made


def _stds(*columns: Worlds) -> Float[np.ndarray, "n k"]:
    """Return jackknife pseudo-values of the standard deviations of k samples."""
    return np.column_stack(
        [_statistic(c[:, np.newaxis], lambda _, std: std[:, 0]) for c in columns]
    )


def _statistic(
    worlds: Float[np.ndarray, "n k"], statistic: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> Worlds:
    """Return pseudo-values of a statistic of the means of k numbers and of their squares."""
    middle = worlds.mean(axis=0)
    moments = np.hstack((worlds - middle, np.square(worlds - middle)))
    k = worlds.shape[1]

    def of(mean: Float[np.ndarray, "m 2k"]) -> Float[np.ndarray, " m"]:
        off, squares = mean[:, :k], mean[:, k:]
        return statistic(off + middle, np.sqrt(np.maximum(squares - off**2, 0.0)))

    return pseudovalues(moments, of)


# Trends over the beamwidth


def _octaves(selection: Selection) -> Float[np.ndarray, " b"]:
    """Return the weights that give a curve's slope per doubling of the beamwidth."""
    octave = np.log2(selection.study.beamwidth)
    octave = octave - octave.mean()
    return octave / (octave @ octave)


def _curve(selection: Selection, score: str, way: Way) -> Float[np.ndarray, "n b"] | None:
    """Return a score at every beamwidth; None if the study lacks it or has a single one."""
    beams = len(selection.study.beamwidth)
    if way not in selection.study.trials or beams < 2:
        return None
    return np.array(samples(selection, score, [(*way, i) for i in range(beams)])).T


def _grows(score: str, *ways: Way, sign: float = 1.0, spread: bool = False) -> Comparisons:
    """Compare a score along the beamwidths: it, or its spread, grows with the beam (or shrinks)."""

    def made(selection: Selection) -> Iterator[Comparison]:
        for way in ways:
            curve = _curve(selection, score, way)
            if curve is None or len(curve) < 3:
                continue
            slope = sign * _octaves(selection)
            sample = curve @ slope
            if spread:
                sample = _statistic(curve, lambda _, std, slope=slope: std @ slope)
            yield Comparison(f"{FILTERS[way[0]]}, {way[1]}", sample)

    return made


def _distance_grows(
    score: str, first: str, second: str, *, names: Sequence[str] = (*FILTERS,), share: bool = False
) -> Comparisons:
    """Compare two strategies along the beamwidths: their difference grows with the beam.

    `share`: the difference of means divided by the sum of the standard deviations.
    """

    def made(selection: Selection) -> Iterator[Comparison]:
        for name in names:
            study = selection.study
            if not {(name, first), (name, second)} <= study.trials.keys():
                continue
            beams = len(study.beamwidth)
            if beams < 2:
                continue
            cells = [(name, way, i) for way in (first, second) for i in range(beams)]
            both = np.array(samples(selection, score, cells)).T
            if len(both) < 3:
                continue
            slope = _octaves(selection)
            yield Comparison(
                FILTERS[name], _statistic(both, partial(_gap, slope=slope, share=share))
            )

    return made


def _gap(mean: np.ndarray, std: np.ndarray, *, slope: np.ndarray, share: bool) -> np.ndarray:
    """Return the slope of the distance of two curves' means, or of its share of their bands."""
    beams = slope.size
    gap = np.abs(mean[:, :beams] - mean[:, beams:])
    return (gap / (std[:, :beams] + std[:, beams:]) if share else gap) @ slope


# Consistency and counts


def _lost_as_many(name: str) -> Comparisons:
    """Compare the number of lost worlds with the paper's, by the binomial error of both."""

    def made(selection: Selection) -> Iterator[Comparison]:
        if name in selection.lost:
            lost, share = selection.lost[name], EXCLUDED[name] / WORLDS
            error = math.sqrt(WORLDS * share * (1.0 - share) * (1.0 + WORLDS / len(lost)))
            yield Comparison(FILTERS[name], WORLDS * (lost - share), band=error, margin=error)

    return made


def _less_consistent(selection: Selection) -> Iterator[Comparison]:
    """Compare mean NEES: FastSLAM's is above EKF's with every strategy."""
    for strategy in STRATEGIES:
        pair = curves(selection, [("fastslam", strategy), ("ekf", strategy)])
        if pair is not None:
            fast, ekf = (one.mean(axis=(1, 2)) for one in pair)
            yield Comparison(strategy, fast - ekf)


def _swings_and_rises(selection: Selection) -> Iterator[Comparison]:
    """Compare ANEES along the laps: low at each return to the start, and rising."""
    fit = lap_fit(selection.study)
    for name, strategy in product(FILTERS, STRATEGIES):
        single = curves(selection, [(name, strategy)]) if fit is not None else None
        if single is not None and fit is not None:
            mean = single[0].mean(axis=1)
            yield Comparison(f"{FILTERS[name]}, {strategy}: rise", mean @ fit[0])
            yield Comparison(f"{FILTERS[name]}, {strategy}: swing", mean @ fit[1])


def _active_longer_consistent(selection: Selection) -> Iterator[Comparison]:
    """Compare departures of EKF's ANEES from a consistent filter's: passive's is larger."""
    for strategy in (ACTIVE, FUSED):
        ways = [("ekf", PASSIVE), ("ekf", strategy)]
        pair = curves(selection, ways)
        if pair is not None and len(pair[0]) > 1:
            ideal = [selection.study.trials[way].consistent[0] for way in ways]
            gap = departure(pair[0], ideal[0]) - departure(pair[1], ideal[1])
            yield Comparison(f"passive, {strategy}", gap)


def _consistent_when_narrow(selection: Selection) -> Iterator[Comparison]:
    """Compare EKF's fused mean NEES along the beamwidths: it grows with the beam."""
    single = curves(selection, [("ekf", FUSED)])
    if single is not None and single[0].shape[1] > 1:
        yield Comparison("EKF, fused", single[0].mean(axis=2) @ _octaves(selection))


def _fused_anees_largest(selection: Selection) -> Iterator[Comparison]:
    """Compare FastSLAM's largest ANEES: fused sensing is above active and passive sensing."""
    for strategy in (ACTIVE, PASSIVE):
        pair = curves(selection, [("fastslam", FUSED), ("fastslam", strategy)])
        if pair is not None and len(pair[0]) > 1:
            flat = [one.reshape(len(one), -1) for one in pair]
            first = flat[0].shape[1]

            def excess(mean: np.ndarray, first: int = first) -> np.ndarray:
                return mean[:, :first].max(axis=1) - mean[:, first:].max(axis=1)

            yield Comparison(f"fused, {strategy}", pseudovalues(np.hstack(flat), excess))


def _as_printed(selection: Selection) -> Iterator[Comparison]:
    """Compare the means of Table II: ours is within the paper's standard deviation."""
    for row, kind in product(TABLE_II, ("full", "total")):
        if (cell := cell_of(selection.study, row)) is not None:
            printed, sigma = getattr(row, kind)
            (count,) = samples(selection, f"landmarks_{kind}", [cell])
            label = f"{FILTERS[row.filter]}, {row_name(row)}, {kind}"
            yield Comparison(label, count - printed, band=sigma + _spread(count), margin=sigma)


def _spread_as_printed(selection: Selection) -> Iterator[Comparison]:
    """Compare the standard deviations of the seen landmarks in Table II: within a third."""
    for row in TABLE_II:
        if (cell := cell_of(selection.study, row)) is not None:
            (count,) = samples(selection, SEEN, [cell])
            if len(count) > 2:
                sample = _stds(count)[:, 0] - row.total[1]
                label = f"σ, {FILTERS[row.filter]}, {row_name(row)}"
                yield Comparison(label, sample, margin=row.total[1] / 3.0)


def _lead_grows(selection: Selection) -> Iterator[Comparison]:
    """Compare the lead of fused over active sensing in landmarks: it shrinks with the beam."""
    for name, title in FILTERS.items():
        fused, active = (_curve(selection, LANDMARKS, (name, way)) for way in (FUSED, ACTIVE))
        if fused is not None and active is not None:
            beams = range(len(selection.study.beamwidth))
            cells = [(name, way, i) for way in (ACTIVE, FUSED) for i in beams]
            both = np.array(samples(selection, LANDMARKS, cells)).T
            lead = both[:, : len(beams)] - both[:, len(beams) :]
            yield Comparison(title, lead @ _octaves(selection))


# The sentences


def _both(first: str, second: str) -> tuple[tuple[Way, Way], ...]:
    """Pair two strategies with each of the paper's filters."""
    return tuple(((name, first), (name, second)) for name in FILTERS)


def _other_filter(first: str = "fastslam", second: str = "ekf") -> tuple[tuple[Way, Way], ...]:
    """Pair the two filters with each strategy."""
    return tuple(((first, way), (second, way)) for way in STRATEGIES)


_WORST = (*_both(PASSIVE, ACTIVE), *_both(PASSIVE, FUSED))
_EKF_GAIN = (("ekf", ACTIVE), ("ekf", FUSED))
_EKF_LOSS = _EKF_GAIN[::-1]
_FAST_LOSS = (("fastslam", FUSED), ("fastslam", ACTIVE))
_LARGEST = tuple(
    (("fastslam", PASSIVE), way) for way in product(FILTERS, STRATEGIES)
    if way != ("fastslam", PASSIVE)
)  # fmt: skip
_OF_BOTH = {way: tuple((name, way) for name in FILTERS) for way in STRATEGIES}
_TABLE: tuple[tuple[int, str, str, tuple[Comparisons, ...]], ...] = (
    (2, "V-A", "EKF-SLAM: 8 of the 115 worlds are excluded.", (_lost_as_many("ekf"),)),
    (2, "V-A", "FastSLAM 2.0: 15 of the 115 worlds are excluded.", (_lost_as_many("fastslam"),)),
    (2, "V-B", "EKF-SLAM is much more consistent than FastSLAM 2.0.", (_less_consistent,)),
    (2, "V-B", "The ANEES is periodic, low near the start, and its maxima rise.",
     (_swings_and_rises,)),
    (2, "V-B", "EKF-SLAM: active sensing stays near the ideal for longer than passive sensing, and "
     "so does fused sensing.", (_active_longer_consistent,)),
    (2, "V-B", "EKF-SLAM: fused sensing is more consistent as the beam narrows.",
     (_consistent_when_narrow,)),
    (2, "V-B", "FastSLAM 2.0: the ANEES of fused sensing extends far past that of the others.",
     (_fused_anees_largest,)),
    (3, "V-C", "Passive sensing has the greatest mean position RMSE.",
     (_larger(POSITION, *_WORST),)),
    (3, "V-C", "Passive sensing has the greatest σ of the position RMSE; fused and passive vary "
     "more than active.",
     (_more_spread(POSITION, *_WORST), _more_spread(POSITION, *_both(FUSED, ACTIVE)))),
    (3, "V-C", "EKF-SLAM has lower mean position RMSE and variance than FastSLAM 2.0 in all "
     "combinations.",
     (_larger(POSITION, *_other_filter()), _more_spread(POSITION, *_other_filter()))),
    (6, "V-C", "As the beam narrows, fused sensing approaches passive sensing in position.",
     (_distance_grows(POSITION, FUSED, PASSIVE),)),
    (4, "V-C", "EKF-SLAM: below about 42°, fused sensing improves on active sensing on average, "
     "never significantly.",
     (_larger(POSITION, _EKF_GAIN, below=CROSSING), _larger(POSITION, _EKF_LOSS, above=CROSSING),
      _near(POSITION, _EKF_GAIN))),
    (5, "V-C", "FastSLAM 2.0: fused sensing never improves on active sensing, which is not "
     "significantly better.", (_larger(POSITION, _FAST_LOSS), _near(POSITION, _FAST_LOSS))),
    (7, "V-D", "Map: fused sensing never outperforms active sensing on average, and is mostly "
     "within about one σ.",
     (_larger(COMMON, *_both(FUSED, ACTIVE)), Most(_near(COMMON, *_both(FUSED, ACTIVE))))),
    (7, "V-D", "Map: as the beam narrows, fused sensing follows passive sensing, at a lower error.",
     (_larger(COMMON, *_both(PASSIVE, FUSED)), _distance_grows(COMMON, FUSED, PASSIVE))),
    (1, "V-D", "Table II: 16 mean numbers of landmarks.", (_as_printed,)),
    (1, "V-D", "Table II: the σ of the seen landmarks.", (_spread_as_printed,)),
    (8, "V-D", "Active sensing initialises fewer landmarks as the beam narrows.",
     (_grows(LANDMARKS, *_OF_BOTH[ACTIVE]),)),
    (8, "V-D", "EKF-SLAM: passive sensing initialises more landmarks than active sensing.",
     (_larger(LANDMARKS, (("ekf", PASSIVE), ("ekf", ACTIVE))),)),
    (8, "V-D", "FastSLAM 2.0: passive sensing has the largest σ of initialised landmarks of all.",
     (_more_spread(LANDMARKS, *_LARGEST),)),
    (8, "V-D", "Passive sensing sees more landmarks than active sensing, by at least one σ below "
     "65°.",
     (_larger(SEEN, *_both(PASSIVE, ACTIVE)),
      _larger_by_sigma(SEEN, *_both(PASSIVE, ACTIVE), below=NARROW))),
    (1, "V-D", "Fused sensing initialises fewer landmarks as the beam narrows, and its lead over "
     "active sensing grows.",
     (_grows(LANDMARKS, *_OF_BOTH[FUSED]), _lead_grows)),
    (1, "V-D", "Fused sensing: the σ of the landmarks grows as the beam narrows.",
     (_grows(LANDMARKS, *_OF_BOTH[FUSED], sign=-1.0, spread=True),
      _grows(SEEN, *_OF_BOTH[FUSED], sign=-1.0, spread=True))),
    (3, "App. A", "EKF-SLAM has the more accurate heading everywhere.",
     (_larger(HEADING, *_other_filter()),)),
    (4, "App. A", "EKF-SLAM: fused sensing has the more accurate heading at every beamwidth.",
     (_larger(HEADING, _EKF_GAIN),)),
    (7, "VI", "EKF-SLAM, map: the bands of fused and active sensing overlap more as the beam "
     "narrows.",
     (_distance_grows(COMMON, FUSED, ACTIVE, names=("ekf",), share=True),)),
)  # fmt: skip
SENTENCES = tuple(Sentence(number, *row) for number, row in enumerate(_TABLE, start=1))
"""The sentences, in the paper's order."""
