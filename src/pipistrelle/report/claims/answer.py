"""The answer to the paper's question: what listening to the beacon does to the map, how surely."""

from collections.abc import Mapping, Sequence

import numpy as np

from pipistrelle.evaluation.comparison import Finding
from pipistrelle.report.claims.verdicts import WITHOUT, JudgedClaim
from pipistrelle.report.effects.levels import times_by_strategy
from pipistrelle.report.numbers import number_word
from pipistrelle.report.studied import (
    COMMON,
    LANDMARKS,
    POSITION,
    POSITION_ALIGNED,
    POSITION_BOUND,
    Rule,
    Selection,
    filter_titles,
    samples,
)
from pipistrelle.report.variables import width_name

COMPARED = {
    COMMON: "map RMSE of shared landmarks",
    POSITION: "position RMSE",
    POSITION_ALIGNED: "position RMSE, aligned",
}
"""Scores in which fused sensing is held against active sensing; every strategy has placed the
shared landmarks."""


def answer(selections: Mapping[Rule, Selection], claims: Sequence[JudgedClaim]) -> list[str]:
    """Answer the question in a line, then count the verdicts on the paper's claims.

    The line leaves out diverged worlds, as the paper does. Where another exclusion rule answers
    otherwise, a sentence gives the answer under each.
    """
    by_rule = {rule: _headline(selection) for rule, selection in selections.items()}
    headline = by_rule["world"]
    if len(set(by_rule.values())) > 1:
        fuller = all(map(_fuller, selections.values()))
        headline = "It depends on which worlds are counted."
        if fuller:
            headline = "A fuller map, yes; a more accurate one depends on which worlds are counted."
    return [headline, *_otherwise(by_rule), _verdicts(claims)]


def findings(selections: Mapping[Rule, Selection]) -> list[dict[str, str]]:
    """Lay out the numbers behind the answer: a row per filter and finding, in words.

    Each row says what it is without diverged worlds, as the paper counts, and with everything.
    """
    papers, everything = selections["world"], selections["none"]
    rows = []
    for name, title in filter_titles(papers.study).items():
        if {(name, "fused"), (name, "active")} <= papers.study.trials.keys():
            both = [(_pairs(one, name), one.gains) for one in (papers, everything)]
            for finding in dict.fromkeys(key for pairs, _ in both for key in pairs):
                rows.append((finding, title, *(pairs.get(finding, "") for pairs, _ in both)))
            for score, words in COMPARED.items():
                where = [_where(gains[name, score]) for _, gains in both]
                rows.append((f"{words}: fused beside active", title, *where))
        both = [times_by_strategy(one, name) for one in (papers, everything)]
        for strategy in dict.fromkeys(strategy for times in both for strategy in times):
            times = [one.get(strategy, "") for one in both]
            rows.append((f"position RMSE over its bound, {strategy}", title, *times))
    keys = ("finding", "filter", "without_diverged_worlds", "with_everything")
    order = list(dict.fromkeys(row[0] for row in rows))
    rows.sort(key=lambda row: order.index(row[0]))
    return [dict(zip(keys, row, strict=True)) for row in rows]


def _headline(selection: Selection) -> str:
    """Answer in a line."""
    placed = [family for (_, score), family in selection.gains.items() if score == COMMON]
    decided = [finding for family in placed for finding in family if finding.n > 1]
    if not any(placed):
        return "Not decided: the study has no pair of active and fused."
    if not decided:
        return f"Not decided: {_left([finding for family in placed for finding in family])}."
    better = sum(finding.holds is True for finding in decided)
    worse = sum(finding.holds is False for finding in decided)
    fuller = _fuller(selection)
    built = "It builds a fuller map" if fuller else "It does not build a fuller map"
    if better and not worse:
        where = "where the beam is narrow" if all(map(_narrow, placed)) else "at some beamwidths"
        where = "at every beamwidth" if better == len(decided) else where
        begun = "Yes: a fuller map, and" if fuller else f"{built}, but"
        return f"{begun} a more accurate one {where}."
    if worse and not better:
        return f"{built}, {'and' if fuller else 'but'} a less accurate one."
    if better:
        begun = "It depends: a fuller map," if fuller else f"{built}; it is"
        return f"{begun} at some beamwidths more accurate, at others less."
    return f"{built}; no difference in its accuracy is significant at any beamwidth."


def _left(findings: Sequence[Finding]) -> str:
    """Say that one world or none is left for these findings."""
    one = max(finding.n for finding in findings) == 1
    return "a single world is left" if one else "no world is left"


def _narrow(findings: Sequence[Finding]) -> bool:
    """Return whether fused is better only in the narrower half of the beamwidths."""
    return all(finding.holds is not True for finding in findings[len(findings) // 2 :])


def _fuller(selection: Selection) -> bool:
    """Return whether fused places more landmarks than active, on average, in every case."""
    study = selection.study
    pairs = [
        samples(selection, "landmarks_full", [(name, "fused", i), (name, "active", i)])
        for name in filter_titles(study)
        if {(name, "fused"), (name, "active")} <= study.trials.keys()
        for i in range(len(study.beamwidth))
    ]
    more = [np.mean(a) > np.mean(b) for a, b in pairs if len(a) > 1]
    return bool(more) and all(more)


def _otherwise(by_rule: dict[Rule, str]) -> list[str]:
    """Return the answer under each exclusion rule if the rules disagree."""
    answers: dict[str, list[str]] = {}
    for rule, answer in by_rule.items():
        answers.setdefault(answer, []).append(WITHOUT[rule])
    if len(answers) == 1:
        return []
    lines = (" and ".join(rules) + f": {answer}" for answer, rules in answers.items())
    return [line[0].upper() + line[1:] for line in lines]


def _pairs(selection: Selection, name: str) -> dict[str, str]:
    """Describe the means of active and fused sensing at the narrowest and the widest beam."""
    study, words = selection.study, {}
    scores = ((LANDMARKS, "landmarks placed", ".0f"), (POSITION_BOUND, "position bound [m]", ".3f"))
    for score, title, digits in scores:
        for i in dict.fromkeys((0, len(study.beamwidth) - 1)):
            cells = [(name, "active", i), (name, "fused", i)]
            active, fused = samples(selection, score, cells)
            if len(fused):
                at = f"{title}, active → fused, at {width_name(study.beamwidth[i])}"
                words[at] = f"{np.mean(active):{digits}} → {np.mean(fused):{digits}}"
    return words


def _where(findings: Sequence[Finding]) -> str:
    """Say at which beamwidths fused is better, and at which worse."""
    if max((finding.n for finding in findings), default=0) < 2:
        return f"not decided: {_left(findings)}"
    parts = [
        f"{word} at {_beams(findings, holds)}"
        for word, holds in (("better", True), ("worse", False))
        if any(finding.holds is holds for finding in findings)
    ]
    return " and ".join(parts) or "not significantly better or worse at any beamwidth"


def _beams(findings: Sequence[Finding], holds: bool) -> str:
    """Name the beamwidths at which a statement holds, or is refuted: how many, and which."""
    names = [finding.label.split(", ")[-1] for finding in findings]
    runs: list[list[str]] = []
    for i, finding in enumerate(findings):
        if finding.holds is holds:
            if runs and i and findings[i - 1].holds is holds:
                runs[-1].append(names[i])
            else:
                runs.append([names[i]])
    count = sum(map(len, runs))
    if count == len(findings):
        return "every beamwidth"
    which = ", ".join(run[0] if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)
    return f"{count} of {len(findings)} beamwidths ({which})"


def _verdicts(claims: Sequence[JudgedClaim]) -> str:
    """Count the verdicts."""
    verdicts = [claim.verdict for claim in claims]
    words = []
    for verdict in ("reproduced", "not-reproduced", "open"):
        count = verdicts.count(verdict)
        verb = "is" if count == 1 else "are"
        words.append(f"{number_word(count)} {verb} {verdict.replace('-', ' ')}")
    return (
        f"Of the paper's {number_word(len(claims))} claims, {words[0]}, {words[1]} and {words[2]}."
    )
