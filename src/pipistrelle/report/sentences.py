r"""The 26 sentences that state results of the paper, as comparisons that a study can make.

Bradley & Abaid state results in Secs. V-A to V-D and VI and in Appendix A. A sentence has parts. A
part makes comparisons: statistics over worlds that the sentence says are above 0, or within a
margin of 0. Each comparison has three yardsticks:

- **Means**: the statistic has the stated sign or size.
- **Bands**, the paper's own yardstick for significance: the bands of one standard deviation over
  the worlds, :math:`m_1 \pm \sigma_1` and :math:`m_2 \pm \sigma_2`, do not contradict the sentence.
  The mean that it calls larger is not smaller by more than :math:`\sigma_1 + \sigma_2`; bands of
  means without a significant difference overlap.
- **Intervals**: the t interval of the statistic, corrected for all comparisons of the sentence
  (`evaluation.comparison.judge`). Only intervals show how surely a mean is known.

Standard deviations, maxima and other statistics of all worlds are jackknifed
(`evaluation.comparison.pseudovalues`). `SENTENCES` is the only list. `report.claims` judges it.
"""

import math
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import product
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from pipistrelle.config import STRATEGIES
from pipistrelle.estimation.catalogue import PAPERS, entry
from pipistrelle.evaluation.comparison import Relation, Statement, pooled_std, pseudovalues
from pipistrelle.evaluation.consistency import anees_departure
from pipistrelle.evaluation.scores import SCORES
from pipistrelle.files import shipped_text
from pipistrelle.report.study import (
    COMMON,
    HEADING,
    LANDMARKS,
    NEES,
    POSITION,
    Cell,
    Selection,
    Study,
    Way,
    case_name,
    frame_time,
    kept,
    lap_time,
    mean_std,
    own_cases,
    samples,
)
from pipistrelle.report.variables import BEAM, BEAMWIDTHS, beam_name

Worlds = Float[np.ndarray, " n"]
ACTIVE, FUSED, PASSIVE = STRATEGIES
FILTERS = {name: entry(name).title for name in PAPERS}
"""The paper's filters, to which its claims apply."""
SEEN = "landmarks_total"
EXCLUDED = {"ekf": 8, "fastslam": 15}
"""Worlds that the paper dropped, of `WORLDS` (Bradley & Abaid, Sec. V-A)."""
WORLDS = 115
NEAR = 0.25
"""Beamwidths that differ by less are the same [deg]: the paper rounds radii to 0.1 mm."""
CROSSING = 41.0
"""Below the paper's 42 degrees, where it sees fused overtake active [deg]."""
NARROW = 64.0
"""Below the paper's 65 degrees, where its gap passes one sigma [deg]."""


class Printed(NamedTuple):
    """Row of Table II for a filter: mean and standard deviation of landmarks."""

    filter: str
    beamwidth: float
    """[deg] Of fused sensing; 0 for passive."""
    full: tuple[float, float]
    """Fully initialised landmarks."""
    total: tuple[float, float]
    """Fully and partially initialised landmarks."""


_PAPER = tomllib.loads(shipped_text("report/paper.toml"))
TABLE_II = tuple(Printed(**row) for row in _PAPER["table_ii"])
"""Bradley & Abaid, Table II."""
FITTED = {
    ("ekf", "total", 180.0),
    ("fastslam", "total", 180.0),
    ("ekf", "total", 0.0),
    ("fastslam", "total", 0.0),
    ("ekf", "full", 0.0),
}
"""Means of Table II to which unreported settings were fitted: the levels to the totals at 180
degrees and of passive sensing, the rays to passive EKF-SLAM's full landmarks. Active sensing at 180
degrees was kept below the paper's passive count."""


def papers_cases(study: Study) -> bool:
    """Return whether a study holds the cases of the paper.

    These are its two filters with all three strategies at its twelve beamwidths, and no other
    variable; more filters and beamwidths are allowed.
    """
    ways = {(name, strategy) for name in FILTERS for strategy in STRATEGIES}
    beams = [variable.name for variable in study.variables] == [BEAM]
    near = [np.any(np.abs(study.beamwidth - width) < NEAR) for width in BEAMWIDTHS]
    return beams and ways <= study.trials.keys() and all(near)


def cell_of(study: Study, printed: Printed) -> Cell | None:
    """Return the cell of a row of Table II; None if the study has no such case."""
    strategy = "fused" if printed.beamwidth else "passive"
    if (printed.filter, strategy) not in study.trials:
        return None
    if strategy == "passive":
        return printed.filter, strategy, 0
    near = np.flatnonzero(np.abs(study.beamwidth - printed.beamwidth) < NEAR)
    return (printed.filter, strategy, int(near[0])) if len(near) else None


def row_name(printed: Printed) -> str:
    """Name a row as in Table II: by its beam, or as passive."""
    return beam_name(printed.beamwidth) if printed.beamwidth else "passive (0°)"


# Comparisons


class Comparison(NamedTuple):
    """A statistic over worlds that exceeds a bound, or is within a margin of 0."""

    label: str
    unit: str
    """As in `variables.UNITS`, perhaps with "per doubling" of the beamwidth."""
    sample: Worlds
    """A number per world, whose mean is the statistic."""
    papers_error: float
    """Standard error of the paper's statistic, in the same unit."""
    band: float = 0.0
    """Sum of the standard deviations over worlds of the two numbers compared; 0 if the statistic is
    no difference of two means."""
    margin: float | None = None
    """Bound of the absolute value; None: the statistic exceeds `least`."""
    least: float = 0.0
    fitted: bool = False
    """Whether settings were fitted to this number, so that it is weak evidence."""

    def surplus(self, band: float = 0.0) -> float:
        """Return how far the mean is on the stated side of its bound, which a band moves away."""
        mean = float(np.mean(self.sample))
        if self.margin is None:
            return mean - (self.least or -band)
        return max(self.margin, band) - abs(mean)

    def statement(self) -> Statement:
        """Return the comparison as a statement for `judge`."""
        relation: Relation = "above" if self.margin is None else "within"
        edge = self.least if self.margin is None else self.margin
        return Statement(label=self.label, sample=self.sample, relation=relation, margin=edge)


Comparisons = Callable[[Selection], Iterable[Comparison]]
"""Makes comparisons, which must all hold."""


class Part(NamedTuple):
    """A part of a sentence, with the share of comparisons that it needs."""

    make: Comparisons
    need: Literal["all", "most", "implied"]
    """"most": more than half must hold. "implied": the words do not contain it. It may leave the
    sentence open by intervals, never refutes it, and does not count by means and bands."""


class Sentence(NamedTuple):
    """A sentence of the paper, with the comparisons that it makes."""

    number: int
    claim: int | None
    """Number of the claim in `CLAIMS` to which it belongs, if any."""
    section: str
    words: str
    parts: tuple[Comparisons | Part, ...]
    """All must hold."""


def _compared(
    label: str, unit: str, sample: Worlds, *names: str, std: float | None = None, **limits: Any
) -> Comparison:
    """Return a comparison, with the error of the paper's statistic over the worlds that it kept.

    `names`: filters, by default both; the worlds are those of the filter that lost more. `std`: of
    the paper's numbers over worlds; by default that of the sample.
    """
    count = WORLDS - max(EXCLUDED[name] for name in names or FILTERS)
    error = (mean_std(sample)[1] if std is None else std) / math.sqrt(count)
    return Comparison(label, unit, sample, error, **limits)


def _unit(score: str) -> str:
    """Return the unit of a score."""
    return SCORES[score].unit if score in SCORES else "m"


def larger(
    score: str,
    *pairs: tuple[Way, Way],
    near: bool = False,
    sigmas: float = 0.0,
    spread: bool = False,
    above: float = 0.0,
    below: float = math.inf,
    fitted_above: float = math.inf,
) -> Comparisons:
    """Compare means at each beamwidth: the first of each pair is larger by more than `sigmas` σ.

    `score`: one of `study.READ`, or `study.COMMON`. `pairs`: of filter and strategy; a pair that
    the study lacks gives nothing, and cases that do not depend on the beamwidth count once. σ is
    the pooled standard deviation over worlds. `near`: the means differ by at most σ instead.
    `spread`: the standard deviations over worlds are compared instead. `above`, `below` [deg]: only
    beamwidths from `above` on and below `below`. `fitted_above` [deg]: settings were fitted to
    wider beams.
    """

    def made(selection: Selection) -> Iterator[Comparison]:
        study = selection.study
        for first, second in pairs:
            if not {first, second} <= study.trials.keys():
                continue
            cases = {way: own_cases(study.trials[way]) for way in (first, second)}
            named = max(cases, key=lambda way: len(cases[way]))
            for i in map(int, np.union1d(*cases.values())):
                a, b = samples(selection, score, [(*first, i), (*second, i)])
                if len(a) < 2 + spread or not above <= study.beamwidth[i] < below:
                    continue
                names = " − ".join(f"{FILTERS[name]} {way}" for name, way in (first, second))
                label = f"{names}, {case_name(study, named, i)}".rstrip(", ")
                if spread:
                    sample = jackknifed(np.column_stack((a, b)), lambda _, std: std @ [1.0, -1.0])
                    yield _compared(f"σ of {label}", _unit(score), sample, first[0], second[0])
                    continue
                sigma = pooled_std(a, b)
                limits = {"margin": sigma} if near else {"least": sigmas * sigma}
                limits["band"] = mean_std(a)[1] + mean_std(b)[1]
                one = _compared(label, _unit(score), a - b, first[0], second[0], **limits)
                yield one._replace(fitted=bool(study.beamwidth[i] > fitted_above))

    return made


_near, _more_spread = partial(larger, near=True), partial(larger, spread=True)


def jackknifed(
    worlds: Float[np.ndarray, "n k"], statistic: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> Worlds:
    """Return pseudo-values of a statistic of the means and standard deviations of k numbers."""
    middle = worlds.mean(axis=0)
    moments = np.hstack((worlds - middle, np.square(worlds - middle)))
    k = worlds.shape[1]

    def of(mean: Float[np.ndarray, "m 2k"]) -> Float[np.ndarray, " m"]:
        off, squares = mean[:, :k], mean[:, k:]
        return statistic(off + middle, np.sqrt(np.maximum(squares - off**2, 0.0)))

    return pseudovalues(moments, of)


Curves = Float[np.ndarray, "m w b"]
"""Numbers of w ways at b beamwidths."""


def trend(
    score: str,
    what: str,
    *groups: tuple[Way, ...],
    curve: Callable[[Curves, Curves], Float[np.ndarray, "m b"]] = lambda mean, _: mean[:, 0],
    unit: str | None = None,
) -> Comparisons:
    r"""Compare a curve over the beamwidth: it grows, by b per doubling.

    .. math:: y \approx a + b \log_2(\mathrm{HPBW})

    `what`: name of y. `groups`: the ways of a curve; each group gives a comparison. `curve`: makes
    y from means and standard deviations; by default the mean of the first way. `unit`: of y, if not
    the score's.
    """

    def made(selection: Selection) -> Iterator[Comparison]:
        study = selection.study
        octave, beams = np.log2(study.beamwidth), len(study.beamwidth)
        octave = octave - octave.mean()

        def slope(mean: np.ndarray, std: np.ndarray) -> np.ndarray:
            mean, std = (one.reshape(-1, len(groups[0]), beams) for one in (mean, std))
            return curve(mean, std) @ octave / (octave @ octave)

        for ways in groups if beams > 1 else ():
            if {*ways} <= study.trials.keys():
                cells = [(*way, i) for way in ways for i in range(beams)]
                worlds = np.array(samples(selection, score, cells)).T
                per = f"{_unit(score) if unit is None else unit} per doubling".strip()
                if len(worlds) > 2:
                    (name, _), *_ = ways
                    sample = jackknifed(worlds, slope)
                    yield _compared(f"{FILTERS[name]}: {what}", per, sample, name)

    return made


def _distance(mean: Curves, _: Curves) -> Float[np.ndarray, "m b"]:
    """Return the distance of the means of two ways."""
    return np.abs(mean[:, 0] - mean[:, 1])


# Consistency and counts


def curves(selection: Selection, ways: Sequence[Way]) -> list[Float[np.ndarray, "m b k"]] | None:
    """Return the NEES over time in the worlds where all cases of some ways count."""
    trials = selection.study.trials
    if not set(ways) <= trials.keys():
        return None
    nees = [trials[way].nees for way in ways]
    cells = [(*way, i) for way, one in zip(ways, nees, strict=True) for i in range(one.shape[1])]
    finite = [np.isfinite(one).all(axis=(1, 2)) for one in nees]
    return [one[kept(selection, cells) & np.all(finite, axis=0)] for one in nees]


def departure(
    nees: Float[np.ndarray, "m b k"], expected: Float[np.ndarray, "b k"]
) -> Float[np.ndarray, " m"]:
    """Return jackknife pseudo-values of `anees_departure`, averaged over the beamwidths.

    `expected`: ANEES of a consistent filter.
    """
    by_beam = [
        pseudovalues(nees[:, i], partial(anees_departure, expected=ideal))
        for i, ideal in enumerate(expected)
    ]
    return np.mean(by_beam, axis=0)


def lap_fit(study: Study) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]] | None:
    r"""Return the weights that give the rise and the swing of a curve over time.

    Least squares of

    .. math:: \epsilon(\tau) = a + b \tau + c \, (1 - \cos 2\pi\tau) / 2 + d \sin 2\pi\tau

    with tau the time in laps: b is the rise per lap, c the swing, low at the start of each lap
    and high half-way. None for a drive of less than two laps.

    Bradley & Abaid, Sec. V-B.
    """
    frames = next(iter(study.trials.values())).nees.shape[2]
    tau = frame_time(study, frames) / lap_time(study)
    if frames == 0 or tau[-1] < 2.0:
        return None
    turn = 2.0 * np.pi * tau
    design = np.column_stack([np.ones(frames), tau, (1.0 - np.cos(turn)) / 2.0, np.sin(turn)])
    _, rise, swing, _ = np.linalg.pinv(design)
    return rise, swing


def _lost(name: str) -> Comparisons:
    """Compare the number of lost worlds with the paper's, by the binomial error of both."""

    def made(selection: Selection) -> Iterator[Comparison]:
        if name in selection.lost:
            lost, share = selection.lost[name], EXCLUDED[name] / WORLDS
            theirs = math.sqrt(WORLDS * share * (1.0 - share))
            error = theirs * math.sqrt(1.0 + WORLDS / len(lost))
            label = f"{FILTERS[name]}: worlds lost of {WORLDS} − {EXCLUDED[name]}"
            yield Comparison(label, "", WORLDS * (lost - share), theirs, error, margin=error)

    return made


def _less_consistent(selection: Selection) -> Iterator[Comparison]:
    """Compare mean NEES: FastSLAM's is above EKF's with every strategy."""
    for strategy in STRATEGIES:
        pair = curves(selection, [("fastslam", strategy), ("ekf", strategy)])
        if pair is not None:
            fast, ekf = (one.mean(axis=(1, 2)) for one in pair)
            yield _compared(f"{strategy}: mean NEES, FastSLAM 2.0 − EKF", "", fast - ekf)


def _swings_and_rises(selection: Selection) -> Iterator[Comparison]:
    """Compare ANEES along the laps: low at each return to the start, and rising."""
    fit = lap_fit(selection.study)
    for name, strategy in product(FILTERS, STRATEGIES):
        single = curves(selection, [(name, strategy)]) if fit is not None else None
        if single is not None and fit is not None:
            mean = single[0].mean(axis=1)
            for what, weights in zip(("rise per lap", "swing"), fit, strict=True):
                yield _compared(f"{FILTERS[name]}, {strategy}: {what}", "", mean @ weights, name)


def _active_longer_consistent(selection: Selection) -> Iterator[Comparison]:
    """Compare departures of EKF's ANEES from a consistent filter's: passive's is larger."""
    for strategy in (ACTIVE, FUSED):
        ways = [("ekf", PASSIVE), ("ekf", strategy)]
        pair = curves(selection, ways)
        if pair is not None and len(pair[0]) > 1:
            ideal = [selection.study.trials[way].consistent[0] for way in ways]
            gap = departure(pair[0], ideal[0]) - departure(pair[1], ideal[1])
            yield _compared(f"EKF: mean ln²(ANEES/E), passive − {strategy}", "", gap, "ekf")


def _fused_anees_largest(selection: Selection) -> Iterator[Comparison]:
    """Compare FastSLAM's largest ANEES: fused sensing is above active and passive sensing."""
    for strategy in (ACTIVE, PASSIVE):
        pair = curves(selection, [("fastslam", FUSED), ("fastslam", strategy)])
        if pair is not None and len(pair[0]) > 1:
            flat = [one.reshape(len(one), -1) for one in pair]
            k = flat[0].shape[1]
            gap = pseudovalues(
                np.hstack(flat), lambda m, k=k: m[:, :k].max(axis=1) - m[:, k:].max(axis=1)
            )
            yield _compared(f"FastSLAM 2.0: largest ANEES, fused − {strategy}", "", gap, "fastslam")


def _as_printed(selection: Selection) -> Iterator[Comparison]:
    """Compare the means of Table II: ours is within the paper's standard deviation."""
    for row, kind in product(TABLE_II, ("full", "total")):
        if (cell := cell_of(selection.study, row)) is not None:
            printed, sigma = getattr(row, kind)
            (count,) = samples(selection, f"landmarks_{kind}", [cell])
            label = f"{FILTERS[row.filter]}, {row_name(row)}: {kind} − {printed}"
            limits = {"std": sigma, "margin": sigma, "band": sigma + mean_std(count)[1]}
            one = _compared(label, "landmarks", count - printed, row.filter, **limits)
            yield one._replace(fitted=(row.filter, kind, row.beamwidth) in FITTED)


def _spread_as_printed(selection: Selection) -> Iterator[Comparison]:
    """Compare the standard deviations of the seen landmarks in Table II: within a third."""
    for row in TABLE_II:
        if (cell := cell_of(selection.study, row)) is not None:
            (count,) = samples(selection, SEEN, [cell])
            if len(count) > 2:
                sigma = row.total[1]
                sample = jackknifed(count[:, np.newaxis], lambda _, std: std[:, 0]) - sigma
                label = f"{FILTERS[row.filter]}, {row_name(row)}: σ − {sigma}"
                yield _compared(label, "landmarks", sample, row.filter, margin=sigma / 3.0)


# The sentences


def both(first: str, second: str) -> tuple[tuple[Way, Way], ...]:
    """Pair two strategies with each of the paper's filters."""
    return tuple(((name, first), (name, second)) for name in FILTERS)


_OTHER_FILTER = tuple((("fastslam", way), ("ekf", way)) for way in STRATEGIES)
_WORST = (*both(PASSIVE, ACTIVE), *both(PASSIVE, FUSED))
_EKF_GAIN = (("ekf", ACTIVE), ("ekf", FUSED))
_EKF_LOSS = _EKF_GAIN[::-1]
_FAST_LOSS = (("fastslam", FUSED), ("fastslam", ACTIVE))
_LARGEST = tuple(
    (("fastslam", PASSIVE), way) for way in product(FILTERS, STRATEGIES)
    if way != ("fastslam", PASSIVE)
)  # fmt: skip
_OF_BOTH = {way: tuple(((name, way),) for name in FILTERS) for way in STRATEGIES}
CLAIMS = {int(number): claim for number, claim in _PAPER["claims"].items()}
"""The paper's claims by number: each is a group of sentences."""
_TABLE: tuple[tuple[int | None, str, str, tuple[Comparisons | Part, ...]], ...] = (
    (None, "V-A", "EKF-SLAM: 8 of the 115 worlds are excluded.", (_lost("ekf"),)),
    (None, "V-A", "FastSLAM 2.0: 15 of the 115 worlds are excluded.", (_lost("fastslam"),)),
    (2, "V-B", "EKF-SLAM is much more consistent than FastSLAM 2.0.", (_less_consistent,)),
    (2, "V-B", "The ANEES is periodic, low near the start, and its maxima rise.",
     (_swings_and_rises,)),
    (None, "V-B", "EKF-SLAM: active sensing stays near the ideal for longer than passive sensing, "
     "and so does fused sensing.", (_active_longer_consistent,)),
    (None, "V-B", "EKF-SLAM: fused sensing is more consistent as the beam narrows.",
     (trend(NEES, "fused, mean NEES", (("ekf", FUSED),)),)),
    (None, "V-B", "FastSLAM 2.0: the ANEES of fused sensing extends far past that of the others.",
     (_fused_anees_largest,)),
    (3, "V-C", "Passive sensing has the greatest mean position RMSE.",
     (larger(POSITION, *_WORST),)),
    (3, "V-C", "Passive sensing has the greatest σ of the position RMSE; fused and passive vary "
     "more than active.",
     (_more_spread(POSITION, *_WORST), _more_spread(POSITION, *both(FUSED, ACTIVE)))),
    (3, "V-C", "EKF-SLAM has lower mean position RMSE and variance than FastSLAM 2.0 in all "
     "combinations.",
     (larger(POSITION, *_OTHER_FILTER), _more_spread(POSITION, *_OTHER_FILTER))),
    (6, "V-C", "As the beam narrows, fused sensing approaches passive sensing in position.",
     (trend(POSITION, "|fused − passive|", *both(FUSED, PASSIVE), curve=_distance),)),
    (4, "V-C", "EKF-SLAM: below about 42°, fused sensing improves on active sensing on average, "
     "never significantly.",
     (larger(POSITION, _EKF_GAIN, below=CROSSING), larger(POSITION, _EKF_LOSS, above=CROSSING),
      _near(POSITION, _EKF_GAIN))),
    (5, "V-C", "FastSLAM 2.0: fused sensing never improves on active sensing, which is not "
     "significantly better.", (larger(POSITION, _FAST_LOSS), _near(POSITION, _FAST_LOSS))),
    (7, "V-D", "Map: fused sensing never outperforms active sensing on average, and is mostly "
     "within about one σ.",
     (larger(COMMON, *both(FUSED, ACTIVE)), Part(_near(COMMON, *both(FUSED, ACTIVE)), "most"))),
    (7, "V-D", "Map: as the beam narrows, fused sensing follows passive sensing, at a lower error.",
     (larger(COMMON, *both(PASSIVE, FUSED)),
      trend(COMMON, "|fused − passive|", *both(FUSED, PASSIVE), curve=_distance))),
    (1, "V-D", "Table II: 16 mean numbers of landmarks.", (_as_printed,)),
    (1, "V-D", "Table II: the σ of the seen landmarks.", (_spread_as_printed,)),
    (None, "V-D", "Active sensing initialises fewer landmarks as the beam narrows.",
     (trend(LANDMARKS, "active", *_OF_BOTH[ACTIVE]),)),
    (None, "V-D", "EKF-SLAM: passive sensing initialises more landmarks than active sensing.",
     (larger(LANDMARKS, (("ekf", PASSIVE), ("ekf", ACTIVE))),)),
    (None, "V-D", "FastSLAM 2.0: passive sensing has the largest σ of initialised landmarks of "
     "all.", (_more_spread(LANDMARKS, *_LARGEST),)),
    (8, "V-D", "Passive sensing sees more landmarks than active sensing, by at least one σ below "
     "65°.",
     (larger(SEEN, *both(PASSIVE, ACTIVE), fitted_above=179.0),
      larger(SEEN, *both(PASSIVE, ACTIVE), sigmas=1.0, below=NARROW),
      Part(larger(SEEN, *both(ACTIVE, PASSIVE), sigmas=-1.0, above=NARROW), "implied"))),
    (None, "V-D", "Fused sensing initialises fewer landmarks as the beam narrows, and its lead "
     "over active sensing grows.",
     (trend(LANDMARKS, "fused", *_OF_BOTH[FUSED]),
      trend(LANDMARKS, "active − fused", *both(ACTIVE, FUSED),
            curve=lambda mean, _: mean[:, 0] - mean[:, 1]))),
    (None, "V-D", "Fused sensing: the σ of the landmarks grows as the beam narrows.",
     tuple(trend(score, f"fused, −σ of the {kind}", *_OF_BOTH[FUSED],
                 curve=lambda _, std: -std[:, 0])
           for score, kind in ((LANDMARKS, "initialised"), (SEEN, "seen")))),
    (3, "App. A", "EKF-SLAM has the more accurate heading everywhere.",
     (larger(HEADING, *_OTHER_FILTER),)),
    (4, "App. A", "EKF-SLAM: fused sensing has the more accurate heading at every beamwidth.",
     (larger(HEADING, _EKF_GAIN),)),
    (7, "VI", "EKF-SLAM, map: the bands of fused and active sensing overlap more as the beam "
     "narrows.",
     (trend(COMMON, "|fused − active| over σ + σ", (("ekf", FUSED), ("ekf", ACTIVE)), unit="",
            curve=lambda mean, std: _distance(mean, std) / std.sum(axis=1)),)),
)  # fmt: skip
SENTENCES = tuple(Sentence(number, *row) for number, row in enumerate(_TABLE, start=1))
"""The sentences, in the paper's order."""
