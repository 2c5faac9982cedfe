"""Claims of the paper (Bradley & Abaid), judged by a study.

A claim has parts, a part has statements about means over worlds, and all statements of a claim are
one family (`pipistrelle.evaluation.comparison`). Claims only concern the paper's two filters, since
further statements would make the paper's harder to prove. A part for which a study has no cases is
empty. `CLAIMS` is the only list: to add a claim, give it a sentence and parts, most of which are
differences of a score between two ways (`_differs`).

*Reproduced*: every part holds under every rule of exclusion. *Not reproduced*: the opposite of some
part is significant under every rule, in the same direction. *Open*: neither. Rules are compared
part by part. A part that must hold everywhere is refuted by one statement whose opposite is
significant; a part that must hold at most beamwidths by more than half of them.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from pipistrelle.config import STRATEGIES, Strategy
from pipistrelle.estimation.catalogue import PAPERS, entry
from pipistrelle.evaluation.comparison import (
    Finding,
    Relation,
    Statement,
    judge,
    pooled_std,
    pseudovalues,
)
from pipistrelle.report.effects import (
    Measure,
    compare,
    direction,
    json_finding,
)
from pipistrelle.report.study import (
    COMMON,
    HEADING,
    LANDMARKS,
    POSITION,
    POSITION_ALIGNED,
    POSITION_BOUND,
    Cell,
    Rule,
    Selection,
    Study,
    Way,
    case_name,
    filter_titles,
    kept,
    own_cases,
    samples,
    times_the_bound,
)
from pipistrelle.report.variables import (
    BEAM,
    BEAMWIDTHS,
    amount,
    beam_name,
    interval,
    number_word,
    width_name,
)

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
WITHOUT: dict[Rule, str] = {
    "world": "without diverged worlds",
    "case": "without diverged cases",
    "none": "with everything",
}
"""The exclusion rules within a sentence."""
Verdict = Literal["reproduced", "not-reproduced", "open"]


class Printed(NamedTuple):
    """Row of Table II for a filter: mean and standard deviation of landmarks."""

    filter: str
    beamwidth: float
    """[deg] Of fused sensing; 0 for passive."""
    full: tuple[float, float]
    """Fully initialised landmarks."""
    total: tuple[float, float]
    """Fully and partially initialised landmarks."""


TABLE_II = (
    Printed("ekf", 180.0, full=(37.7, 2.9), total=(43.7, 2.6)),
    Printed("ekf", 33.2, full=(31.9, 3.3), total=(40.8, 3.2)),
    Printed("ekf", 11.4, full=(30.0, 3.3), total=(40.1, 3.2)),
    Printed("ekf", 0.0, full=(26.6, 3.3), total=(39.5, 3.4)),
    Printed("fastslam", 180.0, full=(39.3, 2.8), total=(43.7, 2.4)),
    Printed("fastslam", 33.2, full=(32.6, 3.3), total=(40.7, 3.1)),
    Printed("fastslam", 11.4, full=(30.5, 3.2), total=(40.2, 3.1)),
    Printed("fastslam", 0.0, full=(22.1, 4.9), total=(39.4, 3.3)),
)
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of a claim: statements that are judged together."""

    sentence: str
    unit: str
    need: Literal["all", "most"] = "all"
    """How many statements must hold for the part to hold."""
    statements: tuple[Statement, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A claim of the paper: its sentence and functions that make its parts from a selection."""

    sentence: str
    parts: tuple[Callable[[Selection], list[Part]], ...]


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


def differences(
    selection: Selection,
    score: str,
    first: Way,
    second: Way,
    *,
    name: str,
    relation: Relation = "above",
    above: float = 0.0,
    below: float = math.inf,
    sigma: bool = False,
    fitted_above: float = math.inf,
) -> list[Statement]:
    """State the difference of two ways' scores at each combination.

    `score`: one of `study.READ`, or `study.COMMON`. `first`, `second`: filter and strategy; cases
    that do not depend on the beamwidth count once. `name`: label of the pair. `relation`: as in
    `Statement`. `above`, `below` [deg]: only beamwidths from `above` on and below `below`. `sigma`:
    whether the margin is the pooled standard deviation over worlds; otherwise 0. `fitted_above`
    [deg]: settings were fitted to wider beams. Returns: empty if the study lacks either.
    """
    study = selection.study
    if not {first, second} <= study.trials.keys():
        return []
    numbers = sorted({*own_cases(study.trials[first]), *own_cases(study.trials[second])})
    named = max((first, second), key=lambda way: len(own_cases(study.trials[way])))
    statements = []
    for i in map(int, numbers):
        width = float(study.beamwidth[i])
        if not above <= width < below:
            continue
        pair = samples(selection, score, [(*first, i), (*second, i)])
        spread = pooled_std(*pair) if len(pair[0]) > 1 else math.nan
        at = case_name(study, named, i)
        statements.append(
            Statement(
                label=f"{name}, {at}" if at else name,
                sample=pair[0] - pair[1],
                relation=relation,
                margin=spread if sigma and len(pair[0]) > 1 else 0.0,
                sigma=spread,
                fitted=width > fitted_above,
            )
        )
    return statements


def gains(selection: Selection, name: str, score: str) -> list[tuple[str, Finding]]:
    """Judge active minus fused sensing of a filter at each combination, with its label."""
    statements = differences(selection, score, (name, "active"), (name, "fused"), name=name)
    return list(zip((s.label for s in statements), judge(statements), strict=True))


def approach(selection: Selection, score: str, name: str) -> Float[np.ndarray, " m"] | None:
    r"""Return the change of the distance between fused and passive per doubling of the beamwidth.

    In each world, the distance of the two scores is fitted by a line over the octaves:

    .. math:: |s_{fused} - s_{passive}| \approx a + b \log_2(\mathrm{HPBW})

    Returns: b of each world, in the score's unit per doubling; None if the filter lacks either
    strategy, or the study has a single beamwidth.
    """
    fused, passive = (name, "fused"), (name, "passive")
    study = selection.study
    beams = len(study.beamwidth)
    if not {fused, passive} <= study.trials.keys() or beams < 2:
        return None
    cells = [(*fused, i) for i in range(beams)]
    *wide, single = samples(selection, score, [*cells, (*passive, 0)])
    octave = np.log2(study.beamwidth)
    octave = octave - octave.mean()
    return np.abs(np.array(wide).T - single[:, None]) @ octave / (octave @ octave)


def curves(selection: Selection, ways: Sequence[Way]) -> list[Float[np.ndarray, "m b k"]] | None:
    """Return the NEES over time in the worlds where all cases of some ways count."""
    trials = selection.study.trials
    if not set(ways) <= trials.keys():
        return None
    nees = [trials[way].nees for way in ways]
    cells = [(*way, i) for way, one in zip(ways, nees, strict=True) for i in range(one.shape[1])]
    counts = kept(selection, cells)
    for one in nees:
        counts &= np.all(np.isfinite(one), axis=(1, 2))
    return [one[counts] for one in nees]


def departure(
    nees: Float[np.ndarray, "m b k"], expected: Float[np.ndarray, "b k"]
) -> Float[np.ndarray, " m"]:
    """Return jackknife pseudo-values of `anees_departure`, averaged over the beamwidths.

    `expected`: ANEES of a consistent filter. A single world gives its value.
    """
    by_beam = []
    for i, curve in enumerate(expected):
        statistic = partial(anees_departure, expected=curve)
        single = len(nees) < 2
        by_beam.append(statistic(nees[:, i]) if single else pseudovalues(nees[:, i], statistic))
    return np.mean(by_beam, axis=0)


def anees_departure(
    anees: Float[np.ndarray, "*j k"], expected: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "*j"]:
    r"""Return the distance of ANEES from a consistent filter's, over all frames.

    .. math:: T = \frac{1}{K} \sum_k \ln^2(\bar\epsilon_k / E_k)

    `expected`: E, below 3 if the start is exact (`evaluation.bound.nees_of_exact_start`).

    Bradley & Abaid, Eq. (24) and Sec. V-B, compare with 3: over-confident above, under-confident
    below.
    """
    return np.mean(np.square(np.log(anees / expected)), axis=-1)


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


def frame_time(study: Study, frames: int, number: int = 0) -> Float[np.ndarray, " k"]:
    """Return the times of the frames of a combination [s]."""
    scenario = study.configs[number].scenario
    return np.arange(1, frames + 1) * (scenario.steps_per_frame * scenario.step)


def lap_time(study: Study, number: int = 0) -> float:
    r"""Return the time of a lap without noise at a combination [s]; infinite for a straight drive.

    .. math:: 2 \pi B / (V |\sin\gamma|)

    Bradley & Abaid, Eq. (5).
    """
    config = study.configs[number]
    rate = config.scenario.speed * abs(math.sin(config.scenario.steering)) / config.motion.wheelbase
    return 2.0 * math.pi / rate if rate > 0.0 else math.inf


def counts_as_printed(selection: Selection) -> list[Part]:
    """Return the parts of claim 1: mean counts within the paper's standard deviation.

    Fully initialised landmarks, then all; a statement per row of Table II that the study has.
    """
    parts = []
    for kind, counted in (("Fully initialised", "full"), ("Total", "total")):
        statements = []
        for row in TABLE_II:
            if (cell := cell_of(selection.study, row)) is None:
                continue
            printed, sigma = getattr(row, counted)
            (count,) = samples(selection, f"landmarks_{counted}", [cell])
            statements.append(
                Statement(
                    label=f"{FILTERS[row.filter]}, {row_name(row)}",
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
    """Return the parts of claim 2: departure, swing and rise of the ANEES (Sec. V-B).

    Departure has a statement per strategy, averaged over the beamwidths; swing and rise have one
    per filter and strategy, none for drives of less than two laps. The paper does not count
    FastSLAM's fused ANEES among the periodic ones.
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
    """Return the part that fused sensing nears the RMSE of passive sensing in narrow beams."""
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


def _differs(
    sentence: str,
    unit: str,
    score: str,
    pairs: Iterable[tuple[str, Way, Way]],
    *,
    need: Literal["all", "most"] = "all",
    narrowest: bool = False,
    **options: Any,
) -> Callable[[Selection], list[Part]]:
    """Return a part on differences of a score, first minus second of each labelled pair.

    `narrowest`: only the narrowest beam of each pair. `options`: of `differences`.
    """

    def part(selection: Selection) -> list[Part]:
        statements = [
            statement
            for label, *pair in pairs
            for statement in differences(selection, score, *pair, name=label, **options)[
                : 1 if narrowest else None
            ]
        ]
        return [Part(sentence=sentence, unit=unit, need=need, statements=tuple(statements))]

    return part


def _by_filter(first: Strategy, second: Strategy) -> tuple[tuple[str, Way, Way], ...]:
    """Pair two strategies with each filter, under the filter's title."""
    return tuple((label, (name, first), (name, second)) for name, label in FILTERS.items())


_EKF, _FASTSLAM = ((pair,) for pair in _by_filter("active", "fused"))
_TWO_FILTERS = tuple((way, ("fastslam", way), ("ekf", way)) for way in STRATEGIES)
_OVER_PASSIVE = tuple(
    (f"{label}, {way}", (name, "passive"), (name, way))
    for name, label in FILTERS.items()
    for way in ("active", "fused")
)
_OVER_FUSED, _OVER_ACTIVE = _by_filter("passive", "fused"), _by_filter("passive", "active")
_GAINS = _by_filter("active", "fused")
_TABLE: tuple[tuple[str, tuple[Callable[[Selection], list[Part]], ...]], ...] = (
    ("Landmarks, in total and fully initialised, number as in Table II, within its σ.", (
        counts_as_printed,
    )),
    ("EKF-SLAM is more consistent than FastSLAM 2.0; ANEES swings with the laps and rises.", (
        ekf_more_consistent,
    )),
    ("EKF-SLAM has the lower position RMSE everywhere; passive sensing has the highest.", (
        _differs("Position RMSE: FastSLAM 2.0 minus EKF is above 0", "m", POSITION, _TWO_FILTERS),
        _differs("Position RMSE: passive minus active, and minus fused, is above 0",
                 "m", POSITION, _OVER_PASSIVE),
    )),
    ("With EKF-SLAM, fused beats active in position below about 42°, on average but not "
     "significantly, and in heading at every beamwidth.", (
        _differs("Position RMSE below 42°: active minus fused is above 0, not significantly",
                 "m", POSITION, _EKF, relation="slightly above", below=CROSSING),
        _differs("Heading RMSE: active minus fused is above 0", "rad", HEADING, _EKF),
    )),
    ("With FastSLAM 2.0, fused never beats active in position.", (
        _differs("Position RMSE: active minus fused is not significantly above 0",
                 "m", POSITION, _FASTSLAM, relation="not above"),
    )),
    ("Fused tends to passive as the beam narrows.", (
        _nears_passive,
        _differs("Position RMSE at the narrowest beam: passive minus fused lies within σ",
                 "m", POSITION, _OVER_FUSED, narrowest=True, relation="within", sigma=True),
    )),
    ("In map RMSE, fused never beats active, and is within about one σ.", (
        _differs("Map RMSE: active minus fused is not significantly above 0",
                 "m", COMMON, _GAINS, relation="not above"),
        _differs("Map RMSE: at most beamwidths, active minus fused lies within σ",
                 "m", COMMON, _GAINS, need="most", relation="within", sigma=True),
    )),
    ("Passive sees more landmarks than active at every beamwidth, by more than σ only below 65°.", (
        _differs("Landmarks seen: passive minus active is above 0",
                 "landmarks", SEEN, _OVER_ACTIVE, fitted_above=179.0),
        _differs("Landmarks seen below 65°: passive minus active is above σ",
                 "landmarks", SEEN, _OVER_ACTIVE, below=NARROW, sigma=True),
        _differs("Landmarks seen from 65° on: passive minus active is not significantly above σ",
                 "landmarks", SEEN, _OVER_ACTIVE, relation="not above", above=NARROW, sigma=True),
    )),
)  # fmt: skip
CLAIMS = tuple(Claim(sentence=sentence, parts=parts) for sentence, parts in _TABLE)
"""Claims of Bradley & Abaid, Sec. V, in its order."""


def judge_claims(
    selections: Mapping[Rule, Selection],
    claims: Sequence[Claim] = CLAIMS,
    confidence: float = 0.95,
) -> list[dict[str, Any]]:
    """Judge each claim as a family under every exclusion rule.

    `selections`: as `study.selections` gives them. `confidence`: that all intervals of a claim
    hold. Returns: the claims of ``summary.json``, and with each rule its `decisive` finding, which
    is the farthest from holding, or the nearest to failing. None replaces numbers not finite.
    """
    judged = []
    for number, claim in enumerate(claims, start=1):
        by_rule = {
            rule: _judged([part for make in claim.parts for part in make(selection)], confidence)
            for rule, selection in selections.items()
        }
        first, everything = (
            [finding for part in by_rule[rule]["parts"] for finding in part["findings"]]
            for rule in ("world", "none")
        )
        decisive = by_rule["world"]["decisive"]
        twins = (twin for one, twin in zip(first, everything, strict=True) if one is decisive)
        same = zip(*(judgement["parts"] for judgement in by_rule.values()), strict=True)
        verdict = _verdict([_holds_throughout(parts) for parts in same])
        judged.append(
            {
                "claim": number,
                "sentence": claim.sentence,
                **by_rule["world"],
                "verdict": verdict,
                "with_everything": next(twins, None),
                "rule": _reason(verdict, by_rule),
                "by_exclusion": by_rule,
            }
        )
    return judged


def record(claim: dict[str, Any]) -> dict[str, Any]:
    """Return a judged claim as in ``summary.json``."""
    by_rule = {
        rule: {key: value for key, value in one.items() if key != "decisive"}
        for rule, one in claim["by_exclusion"].items()
    }
    plain = {key: value for key, value in claim.items() if key not in ("decisive", "parts")}
    return plain | {"by_exclusion": by_rule}


def tally(part: dict[str, Any]) -> list[int]:
    """Count the statements of a part that hold, are undecided, and are refuted."""
    verdicts = [finding["holds"] for finding in part["findings"]]
    return [verdicts.count(verdict) for verdict in (True, None, False)]


def _judged(parts: Sequence[Part], confidence: float) -> dict[str, Any]:
    """Judge a claim's statements as a family, then its parts, then the claim."""
    findings = iter(judge([s for part in parts for s in part.statements], confidence))
    judged, ranks = [], []
    for part in parts:
        own = [next(findings) for _ in part.statements]
        holds = _holds([finding.holds for finding in own], part.need)
        plain = [
            {
                "label": statement.label,
                "relation": statement.relation,
                "margin": statement.margin if math.isfinite(statement.margin) else None,
                "sigma": statement.sigma if math.isfinite(statement.sigma) else None,
                "fitted": statement.fitted,
                **json_finding(finding),
                "holds": finding.holds,
            }
            for statement, finding in zip(part.statements, own, strict=True)
        ]
        head = {"sentence": part.sentence, "unit": part.unit, "need": part.need, "holds": holds}
        judged.append(head | {"findings": plain})
        ranks += [(_rank(finding, holds), finding, part.unit) for finding in plain]
    _, decisive, unit = min(ranks, key=lambda rank: rank[0], default=((), None, ""))
    shown = decisive or {"interval": None, "sigma": None, "p": None, "n": 0}
    return {
        "verdict": _verdict([part["holds"] for part in judged]),
        "statistic": shown.get("mean"),
        "of": shown.get("label"),
        "unit": unit,
        **{key: shown[key] for key in ("interval", "sigma", "p", "n")},
        "decisive": decisive,
        "parts": judged,
    }


def _holds(verdicts: list[bool | None], need: str) -> bool | None:
    """Decide a part from its statements; an empty part is undecided."""
    most = len(verdicts) // 2 + 1
    if verdicts.count(False) >= (most if need == "most" else 1):
        return False
    enough = verdicts.count(True) >= (most if need == "most" else len(verdicts))
    return True if verdicts and enough else None


def _verdict(parts: Sequence[bool | None]) -> Verdict:
    """Decide a claim by its parts."""
    if any(part is False for part in parts):
        return "not-reproduced"
    return "reproduced" if all(parts) else "open"


def _holds_throughout(same: Sequence[dict[str, Any]]) -> bool | None:
    """Decide a part over all exclusion rules; it is undecided if the rules disagree."""
    if all(part["holds"] for part in same):
        return True
    refuted = all(part["holds"] is False for part in same)
    sides = ({_side(f) for f in part["findings"] if f["holds"] is False} for part in same)
    return False if refuted and set.intersection(*sides) else None


def _side(finding: dict[str, Any]) -> float:
    """Return the side of a refuted mean: -1 too low for its claim, 1 too high."""
    if finding["relation"] in ("above", "not above"):
        return -1.0 if finding["relation"] == "above" else 1.0
    edge = 0.0 if finding["relation"] == "within" else finding["margin"]
    return math.copysign(1.0, finding["mean"] - edge)


def _rank(finding: dict[str, Any], holds: bool | None) -> tuple[int, float]:
    """Return a sort key: the verdict of the part, then the distance from failing in std errors."""
    order = {False: 0, None: 1, True: 2}[holds]
    if not finding["std"]:
        return order, -math.inf
    beyond = finding["mean"] - finding["margin"]
    distance = {
        "above": beyond,
        "not above": -beyond,
        "slightly above": -abs(beyond),
        "within": finding["margin"] - abs(finding["mean"]),
    }[finding["relation"]]
    return order, distance / (finding["std"] / math.sqrt(finding["n"]))


def _reason(verdict: Verdict, by_rule: Mapping[Rule, dict[str, Any]]) -> str:
    """Return the sentence that explains a verdict."""
    first, verdicts = by_rule["world"], {one["verdict"] for one in by_rule.values()}
    if not any(part["findings"] for part in first["parts"]):
        return "The study has no cases for this claim."
    if verdict == "open" and verdicts == {"not-reproduced"}:
        return "It fails whatever is left out, but for another reason each time: see its parts."
    if len(verdicts) > 1:
        words = ", ".join(
            f"{one['verdict'].replace('-', ' ')} {WITHOUT[rule]}" for rule, one in by_rule.items()
        )
        return f"The verdict depends on what is left out: {words}."
    if first["verdict"] == "open" and not all(part["findings"] for part in first["parts"]):
        return "The study has no cases for a part of this claim."
    return {
        "reproduced": "Every part holds, whatever is left out.",
        "not-reproduced": "The opposite of a part is significant, whatever is left out.",
        "open": "Not every part holds, and the opposite of none is significant.",
    }[verdict]


COMPARED = {
    LANDMARKS: ("landmarks placed", "landmarks"),
    COMMON: ("map RMSE of shared landmarks", "m"),
    POSITION: ("position RMSE", "m"),
    POSITION_ALIGNED: ("position RMSE, aligned", "m"),
}
"""Scores in which fused is compared with active sensing: title and unit."""


def papers_answer(
    selections: Mapping[Rule, Selection], claims: Sequence[dict[str, Any]]
) -> list[str]:
    """Answer the paper's question for each filter, then count the verdicts.

    The first line leaves out diverged worlds, as the paper does. If the rules of exclusion
    disagree, a line gives the answer under each.
    """
    by_rule = {rule: _headline(selection) for rule, selection in selections.items()}
    lines = [by_rule["world"]]
    if len(set(by_rule.values())) > 1:
        lines = ["It depends on which worlds are counted."]
        lines += [f"{WITHOUT[rule].capitalize()}: {line}" for rule, line in by_rule.items()]
    verdicts = [claim["verdict"] for claim in claims]
    words = []
    for verdict in ("reproduced", "not-reproduced", "open"):
        count = verdicts.count(verdict)
        verb = "is" if count == 1 else "are"
        words.append(f"{number_word(count)} {verb} {verdict.replace('-', ' ')}")
    counted = f"{words[0]}, {words[1]} and {words[2]}"
    return [*lines, f"Of the paper's {number_word(len(claims))} claims, {counted}."]


def _headline(selection: Selection) -> str:
    """Return for each filter whether the fused map is fuller and more accurate."""
    answers: dict[str, list[str]] = {}
    for name, title in filter_titles(selection.study).items():
        if not {(name, "fused"), (name, "active")} <= selection.study.trials.keys():
            continue
        placed, error = (
            _fused_minus_active(selection, name, score) for score in (LANDMARKS, COMMON)
        )
        if placed.n < 2 or error.n < 2:
            left = "a single world is left" if min(placed.n, error.n) else "no world is left"
            answers.setdefault(f"not decided, {left}", []).append(title)
            continue
        fuller = ("a map that is not shown to be fuller", "a fuller map", "a less full map")
        accurate = ("no difference in accuracy shown", "less accurate", "more accurate")
        words = f"{fuller[direction(placed)]}, {accurate[direction(error)]}"
        answers.setdefault(words, []).append(title)
    if not answers:
        return "Not decided: the study has no pair of active and fused."
    parts = [f"{' and '.join(titles)}: {words}" for words, titles in answers.items()]
    return f"{'; '.join(parts)}, averaged over the beamwidths."


def _fused_minus_active(selection: Selection, name: str, score: str) -> Finding:
    """Judge fused minus active sensing of a filter, averaged over the combinations."""
    numbers = range(len(selection.study.beamwidth))
    pairs = [((name, "active", i), (name, "fused", i)) for i in numbers]
    (contrast,) = compare(selection, Measure(title="", score=score, unit=""), [pairs])
    return contrast.finding


def findings(selections: Mapping[Rule, Selection]) -> list[dict[str, str]]:
    """Return the numbers of the answer in words: a row per filter and finding.

    Each row is given without diverged worlds, as the paper counts, and with everything.
    """
    both = selections["world"], selections["none"]
    rows = []
    for name, title in filter_titles(both[0].study).items():
        texts = [_texts(selection, name) for selection in both]
        for finding in dict.fromkeys(key for words in texts for key in words):
            rows.append((finding, title, *(words.get(finding, "") for words in texts)))
    keys = ("finding", "filter", "without_diverged_worlds", "with_everything")
    order = list(dict.fromkeys(row[0] for row in rows))
    rows.sort(key=lambda row: order.index(row[0]))
    return [dict(zip(keys, row, strict=True)) for row in rows]


def _texts(selection: Selection, name: str) -> dict[str, str]:
    """Return the findings of a filter under a rule, in words."""
    study, words = selection.study, {}
    if {(name, "fused"), (name, "active")} <= study.trials.keys():
        for score, digits in ((LANDMARKS, ".0f"), (POSITION_BOUND, ".3f")):
            title = COMPARED[score][0] if score in COMPARED else "position bound [m]"
            for i in dict.fromkeys((0, len(study.beamwidth) - 1)):
                active, fused = samples(selection, score, [(name, "active", i), (name, "fused", i)])
                if len(fused):
                    at = f"{title}, active → fused, at {width_name(study.beamwidth[i])}"
                    words[at] = f"{np.mean(active):{digits}} → {np.mean(fused):{digits}}"
        for score, (title, unit) in COMPARED.items():
            mean = _fused_minus_active(selection, name, score)
            text = "not decided: a single world is left" if mean.n else "no world is left"
            if mean.n > 1:
                text = ("+" if mean.mean > 0.0 else "") + amount(mean.mean, unit)
                text += f" {interval(mean.family, unit)}"
            family, fuller = gains(selection, name, score), score == LANDMARKS
            for word, holds in (("better", not fuller), ("worse", fuller)):
                beams = [at.split(", ")[-1] for at, one in family if one.holds is holds]
                if beams:
                    count = f"{len(beams)} of {len(family)} beamwidths"
                    text += f"; {word} at {count} ({', '.join(beams)})"
            words[f"{title}: fused minus active"] = text
    for way, trials in study.trials.items():
        times = [times_the_bound(selection, (*way, int(i))) for i in own_cases(trials)]
        known = [one for one in times if one is not None]
        if way[0] == name and len(known) == len(times):
            low, high = f"{min(known):.2f}", f"{max(known):.2f}"
            text = low if low == high else f"{low} to {high}"
            words[f"position RMSE over its bound, {way[1]}"] = text
    return words
