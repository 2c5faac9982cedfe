"""The paper's claims, each a sentence and what it states about means over worlds.

A claim falls into parts, each part into statements, and all statements of a claim are judged as
one family (`pipistrelle.evaluation.comparison`). So a claim speaks of the paper's two filters and
of no other that a study has: each further statement would make the paper's own harder to prove.
What a study has no cases for, it says nothing of: such a part is empty. `CLAIMS`, at the end, is
the only list of them; to add a claim, write its parts and give it its sentence there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipistrelle.config import STRATEGIES
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
from pipistrelle.report.studied import COMMON, HEADING, POSITION, Selection, samples


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
    parts: Callable[[Selection], list[Part]]
    """Gives the parts of the claim, of the worlds that the selection counts."""


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


def ekf_more_accurate(selection: Selection) -> list[Part]:
    """Claim 3: EKF's position RMSE is lower than FastSLAM's everywhere, and passive is worst.

    Returns: each filter's beamwidths: EKF against FastSLAM by strategy, passive against the others.

    Bradley & Abaid, Sec. V-C.
    """
    lower, worst = [], []
    for way in STRATEGIES:
        pair = ("fastslam", way), ("ekf", way)
        lower += differences(selection, POSITION, *pair, name=way)
    for name in FILTERS:
        for way in ("active", "fused"):
            label = f"{FILTERS[name]}, {way}"
            worst += differences(selection, POSITION, (name, "passive"), (name, way), name=label)
    return [
        Part(
            sentence="Position RMSE: FastSLAM 2.0 minus EKF is above 0",
            unit="m",
            statements=tuple(lower),
        ),
        Part(
            sentence="Position RMSE: passive minus active, and minus fused, is above 0",
            unit="m",
            statements=tuple(worst),
        ),
    ]


def ekf_gains_by_fusing(selection: Selection) -> list[Part]:
    """Claim 4: with the EKF, fused beats active at narrow beams on average, in heading always.

    Returns: position at the narrow beamwidths, heading at all of them.

    Bradley & Abaid, Sec. V-C and Appendix A.
    """
    pair, name = (("ekf", "active"), ("ekf", "fused")), "EKF"
    position = differences(
        selection, POSITION, *pair, name=name, relation="slightly above", below=CROSSING
    )
    heading = differences(selection, HEADING, *pair, name=name)
    return [
        Part(
            sentence="Position RMSE below 42°: active minus fused is above 0, not significantly",
            unit="m",
            statements=tuple(position),
        ),
        Part(
            sentence="Heading RMSE: active minus fused is above 0",
            unit="rad",
            statements=tuple(heading),
        ),
    ]


def fastslam_never_gains(selection: Selection) -> list[Part]:
    """Claim 5: with FastSLAM 2.0, fused never beats active in position.

    Returns: one, a statement per beamwidth.

    Bradley & Abaid, Sec. V-C.
    """
    pair, name = (("fastslam", "active"), ("fastslam", "fused")), FILTERS["fastslam"]
    never = differences(selection, POSITION, *pair, name=name, relation="not above")
    sentence = "Position RMSE: active minus fused is not significantly above 0"
    return [Part(sentence=sentence, unit="m", statements=tuple(never))]


def fused_tends_to_passive(selection: Selection) -> list[Part]:
    """Claim 6: the narrower the beam, the nearer fused comes to passive.

    Returns: the slope, and the narrowest beam; a statement per filter in each.

    Bradley & Abaid, Sec. V-C.
    """
    slopes, ends = [], []
    for name, label in FILTERS.items():
        if (slope := approach(selection, POSITION, name)) is not None:
            slopes.append(Statement(label=label, sample=slope))
        pair = (name, "passive"), (name, "fused")
        ends += differences(selection, POSITION, *pair, name=label, relation="within", sigma=True)[
            :1
        ]
    return [
        Part(
            sentence="Position RMSE: the distance between fused and passive grows with the "
            "beamwidth; its slope per doubling is above 0",
            unit="m",
            statements=tuple(slopes),
        ),
        Part(
            sentence="Position RMSE at the narrowest beam: passive minus fused lies within σ",
            unit="m",
            statements=tuple(ends),
        ),
    ]


def maps_never_gain(selection: Selection) -> list[Part]:
    """Claim 7: fused never beats active in map RMSE, and is within about one sigma.

    Over the landmarks seen by all strategies, "most of the time".

    Returns: never better, and mostly near; a statement per filter and beamwidth in each.

    Bradley & Abaid, Sec. V-D.
    """
    never, within = [], []
    for name, label in FILTERS.items():
        pair = (name, "active"), (name, "fused")
        never += differences(selection, COMMON, *pair, name=label, relation="not above")
        within += differences(selection, COMMON, *pair, name=label, relation="within", sigma=True)
    return [
        Part(
            sentence="Map RMSE: active minus fused is not significantly above 0",
            unit="m",
            statements=tuple(never),
        ),
        Part(
            sentence="Map RMSE: at most beamwidths, active minus fused lies within σ",
            unit="m",
            need="most",
            statements=tuple(within),
        ),
    ]


def passive_sees_more(selection: Selection) -> list[Part]:
    """Claim 8: passive sees more landmarks than active, by more than one sigma only below 65 deg.

    Returns: at all beamwidths; at those below 65 degrees; and, which the paper's "below" says as
    well, at the others. A statement per filter and beamwidth.

    Bradley & Abaid, Sec. V-E.
    """
    more, far, near, score = [], [], [], "landmarks_total"
    for name, label in FILTERS.items():
        pair = (name, "passive"), (name, "active")
        more += differences(selection, score, *pair, name=label, fitted=lambda width: width > 179.0)
        far += differences(selection, score, *pair, name=label, below=NARROW, sigma=True)
        near += differences(
            selection, score, *pair, name=label, relation="not above", above=NARROW, sigma=True
        )
    return [
        Part(
            sentence="Landmarks seen: passive minus active is above 0",
            unit="landmarks",
            statements=tuple(more),
        ),
        Part(
            sentence="Landmarks seen below 65°: passive minus active is above σ",
            unit="landmarks",
            statements=tuple(far),
        ),
        Part(
            sentence="Landmarks seen from 65° on: passive minus active is not significantly "
            "above σ",
            unit="landmarks",
            statements=tuple(near),
        ),
    ]


CLAIMS = (
    Claim(
        sentence="Landmarks, in total and fully initialised, number as in Table II, within its σ.",
        parts=counts_as_printed,
    ),
    Claim(
        sentence="EKF-SLAM is more consistent than FastSLAM 2.0; ANEES swings with the laps and "
        "rises.",
        parts=ekf_more_consistent,
    ),
    Claim(
        sentence="EKF-SLAM has the lower position RMSE everywhere; passive sensing has the "
        "highest.",
        parts=ekf_more_accurate,
    ),
    Claim(
        sentence="With EKF-SLAM, fused beats active in position below about 42°, on average but "
        "not significantly, and in heading at every beamwidth.",
        parts=ekf_gains_by_fusing,
    ),
    Claim(
        sentence="With FastSLAM 2.0, fused never beats active in position.",
        parts=fastslam_never_gains,
    ),
    Claim(
        sentence="Fused tends to passive as the beam narrows.",
        parts=fused_tends_to_passive,
    ),
    Claim(
        sentence="In map RMSE, fused never beats active, and is within about one σ.",
        parts=maps_never_gain,
    ),
    Claim(
        sentence="Passive sees more landmarks than active at every beamwidth, by more than σ "
        "only below 65°.",
        parts=passive_sees_more,
    ),
)
"""Those of Bradley & Abaid, Sec. V, in its order, which numbers them."""
