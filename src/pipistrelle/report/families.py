"""The paper's eight claims as families of statements about means over worlds.

Each claim falls into parts, each part into statements, and all statements of a claim are judged
as one family (`pipistrelle.evaluation.comparison`). What a study has no cases for, it says
nothing of: such a part is empty.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from pipistrelle.evaluation.comparison import Relation, Statement, pooled_std, pseudovalues
from pipistrelle.figures.style import FILTER_NAMES
from pipistrelle.report.published import CROSSING, NARROW, TABLE_II, cell_of, row_name
from pipistrelle.report.tables import COMMON, Cell, Rule, Study, kept, samples

STATES = 3.0
"""Expected NEES of a consistent filter of the pose (Bradley & Abaid, Sec. V-A)."""
BOTH = ("ekf", "fastslam")


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
    """Claim 1: our means lie within the paper's standard deviation of the paper's.

    Parameters
    ----------
    study : Study
    rule : one of `tables.RULES`

    Returns
    -------
    list of Part

    Notes
    -----
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
        sentence = f"{kind}: ours minus the paper's lies within the paper's σ"
        parts.append(Part(sentence=sentence, unit="landmarks", statements=tuple(statements)))
    return parts


def consistency(study: Study, rule: Rule) -> list[Part]:
    r"""Claim 2: how far ANEES is from its expectation, how it swings with the laps, how it rises.

    Per strategy, averaged over the beamwidths. The departure of a curve is the mean over time of
    :math:`|\ln(\bar\epsilon_k / 3)|`, by the jackknife over worlds. Swing and rise are the
    coefficients of :math:`(1 - \cos 2\pi\tau) / 2` and :math:`\tau` in a least-squares fit with a
    constant and a sine, tau being time in laps: low at the start of each lap, high half-way.

    Parameters
    ----------
    study : Study
    rule : one of `tables.RULES`

    Returns
    -------
    list of Part
        Swing and rise are empty for a drive of less than two laps.

    Notes
    -----
    Bradley & Abaid, Sec. V-B and Eqs. (23) to (25).
    """
    nearer, swing, rise = [], [], []
    fit = _lap_fit(study)
    for strategy in ("active", "fused", "passive"):
        curves = _paired_curves(study, rule, strategy)
        if curves is not None and len(curves["ekf"]) > 0:
            gap = _departures(curves["fastslam"]) - _departures(curves["ekf"])
            nearer.append(Statement(label=strategy, sample=gap))
        for name in BOTH:
            single = _curves(study, rule, [(name, strategy)])
            if single is None or fit is None:
                continue
            worlds = np.mean(single[name], axis=1)
            label = f"{FILTER_NAMES[name]}, {strategy}"
            rise.append(Statement(label=label, sample=worlds @ fit[1]))
            if (name, strategy) != ("fastslam", "fused"):
                swing.append(Statement(label=label, sample=worlds @ fit[2]))
    departure = "EKF's ANEES is nearer to 3 than FastSLAM's (mean |ln(ANEES/3)|, difference)"
    return [
        Part(sentence=departure, unit="", statements=tuple(nearer)),
        Part(
            sentence="ANEES swings with the laps, low at each return to the start (swing in NEES)",
            unit="",
            statements=tuple(swing),
        ),
        Part(sentence="ANEES rises (NEES per lap)", unit="", statements=tuple(rise)),
    ]


def filters(study: Study, rule: Rule) -> list[Part]:
    """Claim 3: EKF's position RMSE is lower than FastSLAM's everywhere, and passive is worst.

    Parameters
    ----------
    study : Study
    rule : one of `tables.RULES`

    Returns
    -------
    list of Part

    Notes
    -----
    Bradley & Abaid, Sec. V-C.
    """
    score = "position_rmse_m"
    lower = [
        statement
        for strategy in ("active", "fused", "passive")
        for statement in _differences(study, rule, score, ("fastslam", strategy), ("ekf", strategy))
    ]
    worst = [
        statement
        for name in BOTH
        for strategy in ("active", "fused")
        for statement in _differences(study, rule, score, (name, "passive"), (name, strategy))
    ]
    return [
        Part(
            sentence="Position RMSE of FastSLAM 2.0 minus EKF's is above 0",
            unit="m",
            statements=tuple(lower),
        ),
        Part(
            sentence="Position RMSE of passive minus the other's is above 0",
            unit="m",
            statements=tuple(worst),
        ),
    ]


def ekf_gain(study: Study, rule: Rule) -> list[Part]:
    """Claim 4: with the EKF, fused beats active at narrow beams on average, in heading always.

    Parameters
    ----------
    study : Study
    rule : one of `tables.RULES`

    Returns
    -------
    list of Part

    Notes
    -----
    Bradley & Abaid, Sec. V-C and Appendix A.
    """
    active, fused = ("ekf", "active"), ("ekf", "fused")
    position = _differences(
        study, rule, "position_rmse_m", active, fused, relation="slightly above", below=CROSSING
    )
    heading = _differences(study, rule, "heading_rmse_rad", active, fused)
    return [
        Part(
            sentence="Position RMSE of active minus fused is above 0 below 42°, not significantly",
            unit="m",
            statements=tuple(position),
        ),
        Part(
            sentence="Heading RMSE of active minus fused is above 0",
            unit="rad",
            statements=tuple(heading),
        ),
    ]


def fastslam_gain(study: Study, rule: Rule) -> list[Part]:
    """Claim 5: with FastSLAM 2.0, fused never beats active in position.

    Parameters
    ----------
    study : Study
    rule : one of `tables.RULES`

    Returns
    -------
    list of Part

    Notes
    -----
    Bradley & Abaid, Sec. V-C.
    """
    pair = ("fastslam", "active"), ("fastslam", "fused")
    never = _differences(study, rule, "position_rmse_m", *pair, relation="not above")
    sentence = "Position RMSE of active minus fused is not seen above 0"
    return [Part(sentence=sentence, unit="m", statements=tuple(never))]


def narrow_limit(study: Study, rule: Rule) -> list[Part]:
    """Claim 6: the narrower the beam, the nearer fused comes to passive.

    In each world, the distance between their position RMSEs is fitted by a line over the
    logarithm of the beamwidth; its slope is what a doubling of the beamwidth adds.

    Parameters
    ----------
    study : Study
    rule : one of `tables.RULES`

    Returns
    -------
    list of Part

    Notes
    -----
    Bradley & Abaid, Sec. V-C.
    """
    score, slopes, ends = "position_rmse_m", [], []
    for name in BOTH:
        if not {(name, "fused"), (name, "passive")} <= study.outcomes.keys():
            continue
        beams = len(study.beamwidth)
        cells: list[Cell] = [(name, "fused", i) for i in range(beams)]
        *fused, passive = samples(study, rule, score, [*cells, (name, "passive", 0)])
        label = FILTER_NAMES[name]
        if beams > 1:
            octave = np.log2(study.beamwidth)
            octave = octave - octave.mean()
            slope = np.abs(np.array(fused).T - passive[:, None]) @ octave / (octave @ octave)
            slopes.append(Statement(label=label, sample=slope))
        pair = samples(study, rule, score, [(name, "passive", 0), cells[0]])
        label = f"{label}, {_degrees(study.beamwidth[0])}"
        ends.append(_within(label, *pair))
    return [
        Part(
            sentence="Distance between fused and passive in position RMSE grows with the beamwidth "
            "(per doubling)",
            unit="m",
            statements=tuple(slopes),
        ),
        Part(
            sentence="At the narrowest beam, passive minus fused lies within σ",
            unit="m",
            statements=tuple(ends),
        ),
    ]


def maps(study: Study, rule: Rule) -> list[Part]:
    """Claim 7: fused never beats active in map RMSE, and is within about one sigma.

    Parameters
    ----------
    study : Study
    rule : one of `tables.RULES`

    Returns
    -------
    list of Part

    Notes
    -----
    Bradley & Abaid, Sec. V-D: over the landmarks seen by all strategies, "most of the time".
    """
    never, within = [], []
    for name in BOTH:
        pair = (name, "active"), (name, "fused")
        never += _differences(study, rule, COMMON, *pair, relation="not above")
        within += _differences(study, rule, COMMON, *pair, relation="within")
    return [
        Part(
            sentence="Map RMSE of active minus fused is not seen above 0",
            unit="m",
            statements=tuple(never),
        ),
        Part(
            sentence="At most beamwidths it lies within σ",
            unit="m",
            need="most",
            statements=tuple(within),
        ),
    ]


def counts(study: Study, rule: Rule) -> list[Part]:
    """Claim 8: passive sees more landmarks than active, by more than one sigma below 65 degrees.

    Parameters
    ----------
    study : Study
    rule : one of `tables.RULES`

    Returns
    -------
    list of Part

    Notes
    -----
    Bradley & Abaid, Sec. V-E.
    """
    more, far = [], []
    for name in BOTH:
        pair = (name, "passive"), (name, "active")
        more += _differences(study, rule, "landmarks_total", *pair)
        far += _differences(
            study, rule, "landmarks_total", *pair, below=NARROW, beyond_sigma=True
        )
    return [
        Part(
            sentence="Landmarks seen by passive minus active's are above 0",
            unit="landmarks",
            statements=tuple(more),
        ),
        Part(
            sentence="Below 65° they are above σ", unit="landmarks", statements=tuple(far)
        ),
    ]


FAMILIES: tuple[Callable[[Study, Rule], list[Part]], ...] = (
    table_ii, consistency, filters, ekf_gain, fastslam_gain, narrow_limit, maps, counts,
)  # fmt: skip
"""The claims, in the paper's order."""


def _degrees(beamwidth: float) -> str:
    return f"{beamwidth:.0f}°"


def _differences(
    study: Study,
    rule: Rule,
    score: str,
    first: tuple[str, str],
    second: tuple[str, str],
    *,
    relation: Relation = "above",
    below: float = math.inf,
    beyond_sigma: bool = False,
) -> list[Statement]:
    """State something of the first minus the second at each beamwidth, once for passive alone."""
    if not {first, second} <= study.outcomes.keys():
        return []
    columns = [i for i, width in enumerate(study.beamwidth) if width < below]
    if first[1] == second[1] == "passive":
        columns = [0]
    named = _named(first, second)
    statements = []
    for i in columns:
        pair = samples(study, rule, score, [(*first, i), (*second, i)])
        beam = "" if first[1] == second[1] == "passive" else f", {_degrees(study.beamwidth[i])}"
        if relation == "within":
            statements.append(_within(named + beam, *pair))
            continue
        margin = pooled_std(*pair) if beyond_sigma and len(pair[0]) > 1 else 0.0
        difference = pair[0] - pair[1]
        if beyond_sigma and len(difference) < 2:
            difference = difference[:0]
        statements.append(
            Statement(label=named + beam, sample=difference, relation=relation, margin=margin)
        )
    return statements


def _named(first: tuple[str, str], second: tuple[str, str]) -> str:
    """Name a pair by what it does not have in common with the rest of its part."""
    if first[0] != second[0]:
        return first[1]
    other = f" − {second[1]}" if first[1] == "passive" and second[1] == "fused" else ""
    other = other or (f" − {second[1]}" if first[1] == "passive" else "")
    return f"{FILTER_NAMES[first[0]]}{', passive' + other if other else ''}"


def _within(label: str, first: np.ndarray, second: np.ndarray) -> Statement:
    """State that two cases differ by less than their common standard deviation."""
    enough = len(first) > 1
    return Statement(
        label=label,
        sample=(first - second) if enough else np.empty(0),
        relation="within",
        margin=pooled_std(first, second) if enough else 0.0,
    )


def _curves(
    study: Study, rule: Rule, ways: Sequence[tuple[str, str]]
) -> dict[str, Float[np.ndarray, "m b k"]] | None:
    """Return NEES curves by filter, in the worlds where all cells of these ways count."""
    if not set(ways) <= study.outcomes.keys():
        return None
    beams = {way: study.outcomes[way].nees.shape[1] for way in ways}
    counts = kept(study, rule, [(*way, i) for way in ways for i in range(beams[way])])
    for way in ways:
        counts = counts & np.all(np.isfinite(study.outcomes[way].nees), axis=(1, 2))
    return {name: study.outcomes[name, way].nees[counts] for name, way in ways}


def _paired_curves(
    study: Study, rule: Rule, strategy: str
) -> dict[str, Float[np.ndarray, "m b k"]] | None:
    return _curves(study, rule, [(name, strategy) for name in BOTH])


def _departures(curves: Float[np.ndarray, "m b k"]) -> Float[np.ndarray, " m"]:
    """Return the departure from consistency as pseudo-values, averaged over the beamwidths."""

    def departure(mean: Float[np.ndarray, "j k"]) -> Float[np.ndarray, " j"]:
        return np.mean(np.abs(np.log(mean / STATES)), axis=1)

    if len(curves) < 2:
        return np.array([np.mean(departure(curves[i])) for i in range(len(curves))])
    beams = [pseudovalues(curves[:, i], departure) for i in range(curves.shape[1])]
    return np.mean(beams, axis=0)


def _lap_fit(study: Study) -> Float[np.ndarray, "4 k"] | None:
    """Return what turns a curve into constant, rise, swing and sine; None within two laps."""
    frames = next(iter(study.outcomes.values())).nees.shape[2]
    lap = lap_time(study)
    scenario = study.config.scenario
    tau = np.arange(1, frames + 1) * scenario.steps_per_frame * scenario.step / lap
    if frames == 0 or tau[-1] < 2.0:
        return None
    turn = 2.0 * np.pi * tau
    design = np.column_stack([np.ones(frames), tau, (1.0 - np.cos(turn)) / 2.0, np.sin(turn)])
    return np.linalg.pinv(design)


def lap_time(study: Study) -> float:
    r"""Time of one round of the drive without noise.

    .. math:: 2 \pi B / (V |\sin\gamma|)

    Parameters
    ----------
    study : Study

    Returns
    -------
    [s]
        Infinite for a straight drive.

    Notes
    -----
    Bradley & Abaid, Eq. (5).
    """
    config = study.config
    rate = config.scenario.speed * abs(math.sin(config.scenario.steering)) / config.motion.wheelbase
    return 2.0 * math.pi / rate if rate > 0.0 else math.inf
