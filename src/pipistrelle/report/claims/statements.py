"""The paper's claims, each a sentence and what it states about means over worlds.

A claim falls into parts, each part into statements, and all statements of a claim are judged as
one family (`pipistrelle.evaluation.comparison`). So a claim speaks of the paper's two filters and
of no other that a study has: each further statement would make the paper's own harder to prove.
What a study has no cases for, it says nothing of: such a part is empty. `CLAIMS`, at the end, is
the only list of them; to add a claim, give it there its sentence and its parts, most of which are
differences of a score between two ways (`_compare`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from pipistrelle.config import STRATEGIES, Strategy
from pipistrelle.evaluation.comparison import Statement
from pipistrelle.report.claims.contrasts import approach, curves, departure, differences, lap_fit
from pipistrelle.report.claims.published import (
    CROSSING,
    FILTERS,
    FITTED,
    NARROW,
    TABLE_II,
    cell_of,
    row_name,
)
from pipistrelle.report.studied import COMMON, HEADING, POSITION, Selection, Way, samples

SEEN = "landmarks_total"


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """Statements that are judged together as one part of a claim."""

    sentence: str
    unit: str
    need: Literal["all", "most"] = "all"
    """How many statements must hold for the part to hold."""
    statements: tuple[Statement, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A claim of the paper: its sentence, its parts and how they are made from a study."""

    sentence: str
    parts: tuple[Callable[[Selection], list[Part]], ...]
    """Each gives parts of the claim, of the worlds that the selection counts."""


def counts_as_printed(selection: Selection) -> list[Part]:
    """Claim 1: our mean counts lie within the paper's standard deviation of the paper's.

    Returns: fully initialised landmarks, and all; one statement per row of the table that the study
    has a case of.

    Bradley & Abaid, Table II.
    """
    parts = []
    for kind, counted in (("Fully initialised", "full"), ("Total", "total")):
        statements = []
        for row in TABLE_II:
            if (cell := cell_of(selection.study, row)) is None:
                continue
            printed, sigma = getattr(row, counted)
            (count,) = samples(selection, f"landmarks_{counted}", [cell])
            label = f"{FILTERS[row.filter]}, {row_name(row)}"
            statements.append(
                Statement(
                    label=label,
                    sample=count - printed,
                    relation="within",
                    margin=sigma,
                    sigma=sigma,
                    fitted=(row.filter, counted, row.beamwidth) in FITTED,
                )
            )
        sentence = f"{kind}: our mean minus the paper's lies within the paper's σ"
        parts.append(Part(sentence=sentence, unit="landmarks", statements=tuple(statements)))
    return parts


def ekf_more_consistent(selection: Selection) -> list[Part]:
    """Claim 2: which filter's ANEES is nearer to a consistent one's, how it swings and rises.

    Per strategy, averaged over the beamwidths; the paper calls FastSLAM's fused ANEES anomalous
    and does not count it among the periodic ones.

    Returns: nearer, a statement per strategy; swing and rise, one per filter and strategy, none
    where a drive is less than two laps. A consistent filter's is not the paper's 3 but what it is
    after an exact start.

    Bradley & Abaid, Sec. V-B.
    """
    nearer, swing, rise = [], [], []
    fit = lap_fit(selection.study)
    for strategy in STRATEGIES:
        both = [("fastslam", strategy), ("ekf", strategy)]
        pair = curves(selection, both)
        if pair is not None:
            ideal = [selection.study.trials[way].consistent[0] for way in both]
            gap = departure(pair[0], ideal[0]) - departure(pair[1], ideal[1])
            nearer.append(Statement(label=strategy, sample=gap))
        for name in FILTERS:
            single = curves(selection, [(name, strategy)])
            if single is None or fit is None:
                continue
            mean = np.mean(single[0], axis=1)
            label = f"{FILTERS[name]}, {strategy}"
            rise.append(Statement(label=label, sample=mean @ fit[0]))
            if (name, strategy) != ("fastslam", "fused"):
                swing.append(Statement(label=label, sample=mean @ fit[1]))
    titles = (
        "EKF's ANEES is nearer to a consistent filter's E than FastSLAM's: mean ln²(ANEES/E), the "
        "latter minus the former, is above 0",
        "ANEES swings with the laps, low at each return to the start: its swing is above 0",
        "ANEES rises: its slope per lap is above 0",
    )
    return [
        Part(sentence=title, unit="", statements=tuple(statements))
        for title, statements in zip(titles, (nearer, swing, rise), strict=True)
    ]


def _nears_passive(selection: Selection) -> list[Part]:
    """Return the part on how the distance from fused to passive grows with the beamwidth."""
    slopes = {label: approach(selection, POSITION, name) for name, label in FILTERS.items()}
    return [
        Part(
            sentence="Position RMSE: the distance between fused and passive grows with the "
            "beamwidth; its slope per doubling is above 0",
            unit="m",
            statements=tuple(
                Statement(label=label, sample=slope)
                for label, slope in slopes.items()
                if slope is not None
            ),
        )
    ]


Pairs = tuple[tuple[str, Way, Way], ...]


def _by_filter(first: Strategy, second: Strategy) -> Pairs:
    """Pair two strategies with each filter, under the filter's title."""
    return tuple((label, (name, first), (name, second)) for name, label in FILTERS.items())


def _compare(
    sentence: str,
    unit: str,
    score: str,
    pairs: Pairs,
    *,
    need: Literal["all", "most"] = "all",
    narrowest: bool = False,
    **options: Any,
) -> Callable[[Selection], list[Part]]:
    """Return the part whose statements are differences of a score, first minus second of each pair.

    `narrowest`: of each pair only the narrowest beam; `options`: of `contrasts.differences`.
    """
    most = 1 if narrowest else None

    def part(selection: Selection) -> list[Part]:
        statements = [
            statement
            for label, *pair in pairs
            for statement in differences(selection, score, *pair, name=label, **options)[:most]
        ]
        return [Part(sentence=sentence, unit=unit, need=need, statements=tuple(statements))]

    return part


_EKF = (("EKF", ("ekf", "active"), ("ekf", "fused")),)
_FASTSLAM = ((FILTERS["fastslam"], ("fastslam", "active"), ("fastslam", "fused")),)
_TWO_FILTERS = tuple((way, ("fastslam", way), ("ekf", way)) for way in STRATEGIES)
_OVER_PASSIVE = tuple(
    (f"{label}, {way}", (name, "passive"), (name, way))
    for name, label in FILTERS.items()
    for way in ("active", "fused")
)
_OVER_FUSED, _OVER_ACTIVE = _by_filter("passive", "fused"), _by_filter("passive", "active")
_GAINS = _by_filter("active", "fused")

CLAIMS = (
    Claim(
        sentence="Landmarks, in total and fully initialised, number as in Table II, within its σ.",
        parts=(counts_as_printed,),
    ),
    Claim(
        sentence="EKF-SLAM is more consistent than FastSLAM 2.0; ANEES swings with the laps and "
        "rises.",
        parts=(ekf_more_consistent,),
    ),
    Claim(
        sentence="EKF-SLAM has the lower position RMSE everywhere; passive sensing has the "
        "highest.",
        parts=(
            _compare(
                "Position RMSE: FastSLAM 2.0 minus EKF is above 0", "m", POSITION, _TWO_FILTERS
            ),
            _compare(
                "Position RMSE: passive minus active, and minus fused, is above 0",
                "m", POSITION, _OVER_PASSIVE,
            ),
        ),
    ),
    Claim(
        sentence="With EKF-SLAM, fused beats active in position below about 42°, on average but "
        "not significantly, and in heading at every beamwidth.",
        parts=(
            _compare(
                "Position RMSE below 42°: active minus fused is above 0, not significantly",
                "m", POSITION, _EKF, relation="slightly above", below=CROSSING,
            ),
            _compare("Heading RMSE: active minus fused is above 0", "rad", HEADING, _EKF),
        ),
    ),
    Claim(
        sentence="With FastSLAM 2.0, fused never beats active in position.",
        parts=(
            _compare(
                "Position RMSE: active minus fused is not significantly above 0",
                "m", POSITION, _FASTSLAM, relation="not above",
            ),
        ),
    ),
    Claim(
        sentence="Fused tends to passive as the beam narrows.",
        parts=(
            _nears_passive,
            _compare(
                "Position RMSE at the narrowest beam: passive minus fused lies within σ",
                "m", POSITION, _OVER_FUSED, narrowest=True, relation="within", sigma=True,
            ),
        ),
    ),
    Claim(
        sentence="In map RMSE, fused never beats active, and is within about one σ.",
        parts=(
            _compare(
                "Map RMSE: active minus fused is not significantly above 0",
                "m", COMMON, _GAINS, relation="not above",
            ),
            _compare(
                "Map RMSE: at most beamwidths, active minus fused lies within σ",
                "m", COMMON, _GAINS, need="most", relation="within", sigma=True,
            ),
        ),
    ),
    Claim(
        sentence="Passive sees more landmarks than active at every beamwidth, by more than σ "
        "only below 65°.",
        parts=(
            _compare(
                "Landmarks seen: passive minus active is above 0",
                "landmarks", SEEN, _OVER_ACTIVE, fitted=lambda width: width > 179.0,
            ),
            _compare(
                "Landmarks seen below 65°: passive minus active is above σ",
                "landmarks", SEEN, _OVER_ACTIVE, below=NARROW, sigma=True,
            ),
            _compare(
                "Landmarks seen from 65° on: passive minus active is not significantly above σ",
                "landmarks", SEEN, _OVER_ACTIVE, relation="not above", above=NARROW, sigma=True,
            ),
        ),
    ),
)  # fmt: skip
"""Those of Bradley & Abaid, Sec. V, in its order, which numbers them."""
