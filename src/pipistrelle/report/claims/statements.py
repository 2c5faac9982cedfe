"""The paper's eight claims as families of statements about means over worlds.

Each claim falls into parts, each part into statements, and all statements of a claim are judged
as one family (`pipistrelle.evaluation.comparison`). What a study has no cases for, it says
nothing of: such a part is empty. Each function takes a study and an exclusion rule.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipistrelle.evaluation.comparison import Statement
from pipistrelle.figures.style import FILTER_NAMES
from pipistrelle.report.claims.contrasts import approach, curves, departure, differences, lap_fit
from pipistrelle.report.claims.published import CROSSING, NARROW, TABLE_II, cell_of, row_name
from pipistrelle.report.studied import COMMON, Rule, Study, samples

STRATEGIES = ("active", "fused", "passive")
POSITION, HEADING = "position_rmse_m", "heading_rmse_rad"


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """Statements that together say one thing.

    Attributes
    ----------
    sentence : str
    unit : "m", "rad", "landmarks" or ""
    need : "all" or "most"
        How many statements must hold for the part to hold.
    statements : tuple of Statement
    """

    sentence: str
    unit: str
    need: Literal["all", "most"] = "all"
    statements: tuple[Statement, ...]


def table_ii(study: Study, rule: Rule) -> list[Part]:
    """Claim 1: our mean counts lie within the paper's standard deviation of the paper's.

    Bradley & Abaid, Table II.
    """
    parts = []
    for kind, score in (("Fully initialised", "landmarks_full"), ("Total", "landmarks_total")):
        statements = []
        for row in TABLE_II:
            if (cell := cell_of(study, row)) is None:
                continue
            printed, sigma = row.full if score == "landmarks_full" else row.total
            (count,) = samples(study, rule, score, [cell])
            label = f"{FILTER_NAMES[row.filter]}, {row_name(row)}"
            statements.append(
                Statement(label=label, sample=count - printed, relation="within", margin=sigma)
            )
        sentence = f"{kind}: our mean minus the paper's lies within the paper's σ"
        parts.append(Part(sentence=sentence, unit="landmarks", statements=tuple(statements)))
    return parts


def consistency(study: Study, rule: Rule) -> list[Part]:
    """Claim 2: which filter's ANEES is nearer to 3, how it swings with the laps, how it rises.

    Per strategy, averaged over the beamwidths; the paper calls FastSLAM's fused ANEES anomalous
    and does not count it among the periodic ones. Bradley & Abaid, Sec. V-B.
    """
    nearer, swing, rise = [], [], []
    fit = lap_fit(study)
    for strategy in STRATEGIES:
        pair = curves(study, rule, [("fastslam", strategy), ("ekf", strategy)])
        if pair is not None:
            gap = departure(pair[0]) - departure(pair[1])
            nearer.append(Statement(label=strategy, sample=gap))
        for name in FILTER_NAMES:
            single = curves(study, rule, [(name, strategy)])
            if single is None or fit is None:
                continue
            mean = np.mean(single[0], axis=1)
            label = f"{FILTER_NAMES[name]}, {strategy}"
            rise.append(Statement(label=label, sample=mean @ fit[0]))
            if (name, strategy) != ("fastslam", "fused"):
                swing.append(Statement(label=label, sample=mean @ fit[1]))
    titles = (
        "EKF's ANEES is nearer to 3 than FastSLAM's: mean ln²(ANEES/3), the latter minus the "
        "former, is above 0",
        "ANEES swings with the laps, low at each return to the start: its swing is above 0",
        "ANEES rises: its slope per lap is above 0",
    )
    return [
        Part(sentence=title, unit="", statements=tuple(statements))
        for title, statements in zip(titles, (nearer, swing, rise), strict=True)
    ]


def filters(study: Study, rule: Rule) -> list[Part]:
    """Claim 3: EKF's position RMSE is lower than FastSLAM's everywhere, and passive is worst.

    Bradley & Abaid, Sec. V-C.
    """
    lower, worst = [], []
    for way in STRATEGIES:
        pair = ("fastslam", way), ("ekf", way)
        lower += differences(study, rule, POSITION, *pair, name=way)
    for name in FILTER_NAMES:
        for way in STRATEGIES[:2]:
            label = f"{FILTER_NAMES[name]}, {way}"
            worst += differences(study, rule, POSITION, (name, "passive"), (name, way), name=label)
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


def ekf_gain(study: Study, rule: Rule) -> list[Part]:
    """Claim 4: with the EKF, fused beats active at narrow beams on average, in heading always.

    Bradley & Abaid, Sec. V-C and Appendix A.
    """
    pair, name = (("ekf", "active"), ("ekf", "fused")), "EKF"
    position = differences(
        study, rule, POSITION, *pair, name=name, relation="slightly above", below=CROSSING
    )
    heading = differences(study, rule, HEADING, *pair, name=name)
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


def fastslam_gain(study: Study, rule: Rule) -> list[Part]:
    """Claim 5: with FastSLAM 2.0, fused never beats active in position.

    Bradley & Abaid, Sec. V-C.
    """
    pair, name = (("fastslam", "active"), ("fastslam", "fused")), FILTER_NAMES["fastslam"]
    never = differences(study, rule, POSITION, *pair, name=name, relation="not above")
    sentence = "Position RMSE: active minus fused is not significantly above 0"
    return [Part(sentence=sentence, unit="m", statements=tuple(never))]


def narrow_limit(study: Study, rule: Rule) -> list[Part]:
    """Claim 6: the narrower the beam, the nearer fused comes to passive.

    Bradley & Abaid, Sec. V-C.
    """
    slopes, ends = [], []
    for name, label in FILTER_NAMES.items():
        if (slope := approach(study, rule, POSITION, name)) is not None:
            slopes.append(Statement(label=label, sample=slope))
        pair = (name, "passive"), (name, "fused")
        ends += differences(
            study, rule, POSITION, *pair, name=label, relation="within", sigma=True
        )[:1]
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


def maps(study: Study, rule: Rule) -> list[Part]:
    """Claim 7: fused never beats active in map RMSE, and is within about one sigma.

    Over the landmarks seen by all strategies, "most of the time". Bradley & Abaid, Sec. V-D.
    """
    never, within = [], []
    for name, label in FILTER_NAMES.items():
        pair = (name, "active"), (name, "fused")
        never += differences(study, rule, COMMON, *pair, name=label, relation="not above")
        within += differences(study, rule, COMMON, *pair, name=label, relation="within", sigma=True)
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


def counts(study: Study, rule: Rule) -> list[Part]:
    """Claim 8: passive sees more landmarks than active, by more than one sigma below 65 degrees.

    Bradley & Abaid, Sec. V-E.
    """
    more, far, score = [], [], "landmarks_total"
    for name, label in FILTER_NAMES.items():
        pair = (name, "passive"), (name, "active")
        more += differences(study, rule, score, *pair, name=label)
        far += differences(study, rule, score, *pair, name=label, below=NARROW, sigma=True)
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
    ]


FAMILIES: tuple[Callable[[Study, Rule], list[Part]], ...] = (
    table_ii, consistency, filters, ekf_gain, fastslam_gain, narrow_limit, maps, counts,
)  # fmt: skip
"""The claims, in the order of `claims.SENTENCES`."""
