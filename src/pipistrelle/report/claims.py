"""Verdicts of a study on the paper's sentences and claims, and its answer to the paper's question.

Each of `sentences.SENTENCES` is judged by means, bands and intervals under every rule of exclusion;
its verdict is by intervals. *Reproduced*: every part holds under every rule. *Not reproduced*: the
opposite of some part is significant under every rule, on the same side. *Open*: neither. A claim is
a group of sentences: reproduced if all of them are, not reproduced if one of them is not.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipistrelle.evaluation.comparison import Finding, judge
from pipistrelle.evaluation.scores import POSITION, POSITION_ALIGNED
from pipistrelle.report.effects import Measure, compare, direction, json_finding
from pipistrelle.report.sentences import CLAIMS, SENTENCES, Comparison, Part, Sentence
from pipistrelle.report.study import (
    COMMON,
    LANDMARKS,
    POSITION_BOUND,
    Rule,
    Selection,
    filter_titles,
    own_cases,
    samples,
    times_the_bound,
)
from pipistrelle.report.variables import amount, interval, listed, number_word, width_name

WITHOUT: dict[Rule, str] = {
    "world": "without diverged worlds",
    "case": "without diverged cases",
    "none": "with everything",
}
"""The exclusion rules within a sentence."""
YARDSTICKS = ("means", "bands", "intervals")
VERDICTS = {False: "not-reproduced", None: "open", True: "reproduced"}
"""By whether a sentence holds; None: undecided. The first of its sentences' is a claim's."""


def judge_sentences(
    selections: Mapping[Rule, Selection], sentences: Sequence[Sentence] = SENTENCES
) -> list[dict[str, Any]]:
    """Judge sentences under every rule of exclusion: rows of ``summary.json``.

    `selections`: as `study.selections` gives them. Each yardstick has the number of comparisons
    that hold, and whether the sentence holds (None: undecided). A row has them under the paper's
    rule, and with all findings under every rule, the `decisive` being the index of the finding
    that is the farthest from holding, or the nearest to failing. Errors are medians, if all
    comparisons have one unit. Numbers that are not finite are None.
    """
    rows = []
    for sentence in sentences:
        by_rule = {rule: _judged(sentence, one) for rule, one in selections.items()}
        holds = _all([_throughout(i, [*by_rule.values()]) for i in range(len(sentence.parts))])
        papers = by_rule["world"]
        units = {one["unit"] for one in papers["findings"]}
        row: dict[str, Any] = {
            "sentence": sentence.number,
            "claim": sentence.claim,
            "section": sentence.section,
            "words": sentence.words,
            "verdict": VERDICTS[holds],
            "reason": _reason(holds, by_rule),
            **{key: value for key, value in papers.items() if key not in ("parts", "findings")},
            "unit": units.pop() if len(units) == 1 else None,
            "by_exclusion": by_rule,
        }
        for name in ("papers_error", "standard_error"):
            errors = [e for one in papers["findings"] if (e := one[name]) is not None]
            row[name] = float(np.median(errors)) if errors and row["unit"] is not None else None
        rows.append(row)
    return rows


def judge_claims(sentences: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Judge the paper's claims by their judged sentences: rows of ``summary.json``.

    Each yardstick has the number of sentences that hold under the paper's rule; `decided_by` are
    those of the claim's verdict.
    """
    claims = []
    for number in sorted({row["claim"] for row in sentences} - {None}):
        own = [row for row in sentences if row["claim"] == number]
        verdict = next(v for v in VERDICTS.values() if any(row["verdict"] == v for row in own))
        decided_by = [row["sentence"] for row in own if row["verdict"] == verdict]
        counts = {name: sum(row[f"by_{name}"] is True for row in own) for name in YARDSTICKS}
        claims.append(
            {"claim": number, "sentence": CLAIMS[number], "verdict": verdict}
            | {"sentences": [row["sentence"] for row in own], "decided_by": decided_by, **counts}
        )
    return claims


def scoreboard(sentences: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Count the sentences that hold, fail and are undecided by each yardstick.

    `verdict` counts those that hold by intervals under every rule of exclusion, the others count
    under the paper's. A sentence without comparisons counts only as `not_judged`. `errors` is the
    median over all comparisons of the paper's standard error over the study's.
    """
    judged = [row for row in sentences if row["comparisons"]]
    findings = [one for row in judged for one in row["by_exclusion"]["world"]["findings"]]
    ratios = [f["papers_error"] / f["standard_error"] for f in findings if f["standard_error"]]
    holds = {name: [VERDICTS[row[f"by_{name}"]] for row in judged] for name in YARDSTICKS}
    holds["verdict"] = [row["verdict"] for row in judged]
    board: dict[str, Any] = {"sentences": len(sentences)}
    board["not_judged"] = len(sentences) - len(judged)
    board["errors"] = float(np.median(ratios)) if ratios else None
    for name, words in holds.items():
        board[name] = {verdict: words.count(verdict) for verdict in VERDICTS.values()}
    return board


def _judged(sentence: Sentence, selection: Selection) -> dict[str, Any]:
    """Judge a sentence under a rule of exclusion.

    Its comparisons are a family, and the implied ones another, which counts only by intervals.
    """
    parts = [part if isinstance(part, Part) else Part(part, "all") for part in sentence.parts]
    made = [(i, one) for i, part in enumerate(parts) for one in part.make(selection)]
    made = [(i, one) for i, one in made if len(one.sample) > 1]
    findings: list[dict[str, Any]] = []
    for implied in (False, True):
        family = [(i, one) for i, one in made if (parts[i].need == "implied") is implied]
        tests = judge([one.statement() for _, one in family])
        for (i, one), finding in zip(family, tests, strict=True):
            findings.append(_plain(i, one, finding) | {"implied": implied})
    said = [finding for finding in findings if not finding["implied"]]
    judged: dict[str, Any] = {"comparisons": len(said)}
    for name in YARDSTICKS:
        judged["parts"] = [
            _holds([f[name] for f in findings if f["part"] == i], part.need)
            for i, part in enumerate(parts)
            if name == "intervals" or part.need != "implied"
        ]
        judged[name] = sum(one[name] is True for one in said)
        judged[f"by_{name}"] = _all(judged["parts"])
    judged["refuted"] = sum(one["intervals"] is False for one in said)
    order = [*VERDICTS].index
    ranks = [(order(judged["parts"][f["part"]]), f["surplus"] or -math.inf) for f in findings]
    decisive = ranks.index(min(ranks)) if ranks else None
    return judged | {"decisive": decisive, "findings": findings}


def _plain(part: int, one: Comparison, finding: Finding) -> dict[str, Any]:
    """Return a judged comparison as in ``summary.json``."""
    error = finding.std / math.sqrt(finding.n) if finding.std > 0.0 else None
    holds = (one.surplus() > 0.0, one.surplus(one.band) > 0.0, finding.holds)
    names = ("unit", "least", "margin", "band", "fitted", "papers_error")
    return {
        "label": one.label,
        "part": part,
        **{name: getattr(one, name) for name in names},
        **json_finding(finding),
        "standard_error": error,
        "surplus": one.surplus() / error if error else None,
        **dict(zip(YARDSTICKS, holds, strict=True)),
    }


def _holds(verdicts: Sequence[bool | None], need: str) -> bool | None:
    """Decide a part from its comparisons; without any it is undecided."""
    enough = len(verdicts) // 2 + 1 if need == "most" else len(verdicts)
    if verdicts and verdicts.count(True) >= enough:
        return True
    refuted = verdicts and verdicts.count(False) > len(verdicts) - enough
    return False if refuted and need != "implied" else None


def _all(parts: Sequence[bool | None]) -> bool | None:
    """Decide a sentence from its parts."""
    return False if False in parts else (None if None in parts else True)


def _throughout(part: int, judged: Sequence[dict[str, Any]]) -> bool | None:
    """Decide a part over all rules of exclusion; it is undecided if the rules disagree."""
    sides = []
    for one in judged:
        refuted = [f for f in one["findings"] if f["part"] == part and f["intervals"] is False]
        sides.append({f["margin"] is not None and f["mean"] > 0.0 for f in refuted})  # too high
    holds = {one["parts"][part] for one in judged}
    if holds == {False} and not set.intersection(*sides):
        return None
    return holds.pop() if len(holds) == 1 else None


def _reason(holds: bool | None, by_rule: Mapping[Rule, dict[str, Any]]) -> str:
    """Return the sentence that explains a verdict."""
    verdicts = {rule: one["by_intervals"] for rule, one in by_rule.items()}
    if not any(one["comparisons"] for one in by_rule.values()):
        return "The study has no cases for it, or too few worlds."
    if len(set(verdicts.values())) > 1:
        says = {True: "it holds", False: "it is refuted", None: "it is undecided"}
        words = listed([f"{says[one]} {WITHOUT[rule]}" for rule, one in verdicts.items()])
        return f"The verdict depends on what is left out: {words}."
    if holds is None and False in verdicts.values():
        return "It fails whatever is left out, but not each time for the same reason."
    papers = by_rule["world"]
    if holds is None and len({one["part"] for one in papers["findings"]}) < len(papers["parts"]):
        return "The study has no cases for a part of it."
    return {
        True: "Every part holds, whatever is left out.",
        False: "The opposite of a part is significant, whatever is left out.",
        None: "Not every part holds, and the opposite of none is significant.",
    }[holds]


COMPARED = {
    LANDMARKS: ("landmarks placed", "landmarks"),
    COMMON: ("map RMSE of shared landmarks", "m"),
    POSITION: ("position RMSE", "m"),
    POSITION_ALIGNED: ("position RMSE, aligned", "m"),
}
"""Scores in which fused is compared with active sensing: title and unit."""


def papers_answer(
    selections: Mapping[Rule, Selection], sentences: Sequence[dict[str, Any]]
) -> list[str]:
    """Answer the paper's question for each filter, then count its sentences and claims.

    The first line leaves out diverged worlds, as the paper does. If the rules of exclusion
    disagree, a line gives the answer under each.
    """
    by_rule = {rule: _headline(selection) for rule, selection in selections.items()}
    lines = [by_rule["world"]]
    if len(set(by_rule.values())) > 1:
        lines = ["It depends on which worlds are counted."]
        lines += [f"{WITHOUT[rule].capitalize()}: {line}" for rule, line in by_rule.items()]
    claims = judge_claims(sentences)
    lines += [_sentences_line(scoreboard(sentences))] if sentences else []
    return [*lines, _claims_line(claims)] if claims else lines


def _sentences_line(board: dict[str, Any]) -> str:
    """Count the sentences that hold and the refuted sentences."""
    means, bands, _, shown = (board[name]["reproduced"] for name in (*YARDSTICKS, "verdict"))
    refuted, left = board["verdict"]["not-reproduced"], board["not_judged"]
    return (
        f"Of the paper's {board['sentences']} sentences on results, {number_word(means)} "
        f"{'holds' if means == 1 else 'hold'} by means and {number_word(bands)} by bands of one "
        f"standard deviation. Whatever is left out, 95 % intervals show {number_word(shown)} of "
        f"them and refute {number_word(refuted)}."
    ) + f" The study has no cases, or too few worlds, for {number_word(left)}." * bool(left)


def _claims_line(claims: Sequence[dict[str, Any]]) -> str:
    """Name the claims of each verdict."""
    words = []
    for verdict in reversed(VERDICTS.values()):
        spoken = verdict.replace("-", " ")
        numbers = [str(claim["claim"]) for claim in claims if claim["verdict"] == verdict]
        if len(numbers) == len(claims):
            return f"All {number_word(len(claims))} claims are {spoken}."
        if numbers:
            claim, verb = ("claim", "is") if len(numbers) == 1 else ("claims", "are")
            words.append(f"{claim} {listed(numbers)} {verb} {spoken}")
    return f"{'; '.join(words).capitalize()}."


def _headline(selection: Selection) -> str:
    """Return for each filter whether the fused map is fuller and more accurate."""
    answers: dict[str, list[str]] = {}
    for name, title in filter_titles(selection.study).items():
        if not {(name, "fused"), (name, "active")} <= selection.study.trials.keys():
            continue
        (placed,) = _fused_minus_active(selection, name, LANDMARKS)
        (error,) = _fused_minus_active(selection, name, COMMON)
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


def _fused_minus_active(
    selection: Selection, name: str, score: str, *, each: bool = False
) -> list[Finding]:
    """Judge fused minus active sensing of a filter: averaged over the combinations, or at each."""
    numbers = range(len(selection.study.beamwidth))
    pairs = [((name, "active", i), (name, "fused", i)) for i in numbers]
    rows = [[pair] for pair in pairs] if each else [pairs]
    measure = Measure(title="", score=score, unit="")
    return [contrast.finding for contrast in compare(selection, measure, rows)]


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
            (mean,) = _fused_minus_active(selection, name, score)
            text = "not decided: a single world is left" if mean.n else "no world is left"
            if mean.n > 1:
                text = ("+" if mean.mean > 0.0 else "") + amount(mean.mean, unit)
                text += f" {interval(mean.family, unit)}"
            each = _fused_minus_active(selection, name, score, each=True)
            for word, sign in (("better", -1), ("worse", 1)):
                sign = -sign if score == LANDMARKS else sign
                beams = [i for i, one in enumerate(each) if direction(one) == sign]
                if beams:
                    names = ", ".join(width_name(study.beamwidth[i]) for i in beams)
                    text += f"; {word} at {len(beams)} of {len(each)} beamwidths ({names})"
            words[f"{title}: fused minus active"] = text
    for way, trials in study.trials.items():
        times = [times_the_bound(selection, (*way, int(i))) for i in own_cases(trials)]
        known = [one for one in times if one is not None]
        if way[0] == name and len(known) == len(times):
            low, high = f"{min(known):.2f}", f"{max(known):.2f}"
            text = low if low == high else f"{low} to {high}"
            words[f"position RMSE over its bound, {way[1]}"] = text
    return words
