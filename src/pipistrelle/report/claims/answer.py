"""The answer to the paper's question: what listening to the beacon does to the map, how surely."""

from collections.abc import Mapping, Sequence

import numpy as np

from pipistrelle.evaluation.bound import IN_ONE_WORLD
from pipistrelle.evaluation.comparison import Finding
from pipistrelle.experiments.hearing.scenario import landmark_count
from pipistrelle.report.claims.verdicts import WITHOUT, JudgedClaim
from pipistrelle.report.effects.levels import diverged, times_the_bound
from pipistrelle.report.numbers import number_word
from pipistrelle.report.studied import (
    COMMON,
    POSITION,
    POSITION_ALIGNED,
    POSITION_BOUND,
    Rule,
    Selection,
    Study,
    filter_titles,
    mean_std,
    samples,
)
from pipistrelle.report.variables import width_name


def answer(selections: Mapping[Rule, Selection], claims: Sequence[JudgedClaim]) -> list[str]:
    """Answer the question, then say what of the paper's claims is left.

    Numbers leave diverged worlds out, as the paper does, and beside each stands what it is with
    everything counted; where that bears on the answer, it is given under every exclusion rule.

    Parameters
    ----------
    selections : dict of Selection
        Under each exclusion rule.
    claims : sequence of JudgedClaim

    Returns
    -------
    list of str
        A line that stands alone, then sentences.
    """
    papers, everything = selections["world"], selections["none"]
    by_rule = {rule: _headline(selection) for rule, selection in selections.items()}
    sentences = (
        *_otherwise(by_rule),
        _counted(papers, everything),
        _compared(
            "The landmarks that every strategy places are placed", papers, everything, COMMON
        ),
        _compared("The vehicle is located", papers, everything, POSITION),
        _compared("After alignment its path is", papers, everything, POSITION_ALIGNED),
        _allowed(everything),
        *_reached(everything),
        diverged(papers.study),
        _verdicts(claims),
    )
    headline = by_rule["world"]
    if len(set(by_rule.values())) > 1:
        fuller = all(map(_fuller, selections.values()))
        headline = "It depends on which worlds are counted."
        if fuller:
            headline = "A fuller map, yes; a more accurate one depends on which worlds are counted."
    return [headline, *(sentence for sentence in sentences if sentence)]


def _headline(selection: Selection) -> str:
    """Answer in a line."""
    placed = [mine for (_, score), mine in selection.gains.items() if score == COMMON]
    decided = [finding for mine in placed for finding in mine if finding.n > 1]
    if not any(placed):
        return "Not decided: the study has no pair of active and fused."
    if not decided:
        return f"Not decided: {_left([finding for mine in placed for finding in mine])}."
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
    """Say how few worlds there are, where too few for any of these."""
    one = max(finding.n for finding in findings) == 1
    return "a single world is left" if one else "no world is left"


def _narrow(findings: Sequence[Finding]) -> bool:
    """Tell whether what is better, if anything, is so in the narrower half of the beams alone."""
    return all(finding.holds is not True for finding in findings[len(findings) // 2 :])


def _fuller(selection: Selection) -> bool:
    """Tell whether fused places more landmarks than active on average wherever worlds are left."""
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
    """Give the answers under all exclusion rules, where they are not one."""
    answers: dict[str, list[str]] = {}
    for rule, answer in by_rule.items():
        answers.setdefault(answer, []).append(WITHOUT[rule])
    if len(answers) == 1:
        return []
    said = (" and ".join(rules) + f": {answer}" for answer, rules in answers.items())
    return [line[0].upper() + line[1:] for line in said]


def _counted(selection: Selection, everything: Selection) -> str:
    """Say how many landmarks fused and active place, at the narrowest and at the widest beam."""
    study = selection.study
    for name, title in filter_titles(study).items():
        if not {(name, "fused"), (name, "active")} <= study.trials.keys():
            continue
        if said := _placed(selection, name):
            beside = _beside(study, said, _placed(everything, name))
            return (
                "Hearing the beacon as well as its own calls, the vehicle fully places"
                f"{_of_all(study)} {said}{beside} ({title})."
            )
    return ""


def _of_all(study: Study) -> str:
    """Say how many landmarks there are, if that is known."""
    return f", of {landmark_count(study.example)} landmarks," if study.example else ""


def _placed(selection: Selection, name: str) -> str:
    """Give the counts of fused and of active sensing with a filter, in words."""
    said, study = [], selection.study
    for i in dict.fromkeys((0, len(study.beamwidth) - 1)):
        cells = [(name, "fused", i), (name, "active", i)]
        fused, active = samples(selection, "landmarks_full", cells)
        if len(fused):
            beam = width_name(study.beamwidth[i])
            said.append(f"{np.mean(fused):.0f} instead of {np.mean(active):.0f} at {beam}")
    return " and ".join(said)


def _beside(study: Study, said: str, counted: str) -> str:
    """Put beside what was said what it is with everything counted, where anything diverged."""
    diverged = any(trials.diverged.any() for trials in study.trials.values())
    told = "the same" if said == counted else counted
    return f" (with everything counted: {told})" if diverged else ""


def _compared(subject: str, selection: Selection, everything: Selection, score: str) -> str:
    """Say where fused is better than active, and where worse, with each filter."""
    said, undecided = [], []
    for name, title in filter_titles(selection.study).items():
        findings = selection.gains[name, score]
        if findings and max(finding.n for finding in findings) < 2:
            what = subject[0].lower() + subject[1:]
            undecided.append(
                f"Whether {what} better or worse with {title} is not decided: {_left(findings)}."
            )
        elif findings:
            here, there = _where(findings), _where(everything.gains[name, score])
            said.append(f"with {title} {here}{_beside(selection.study, here, there)}")
    return " ".join([f"{subject} {'; '.join(said)}."] * bool(said) + undecided)


def _where(findings: Sequence[Finding]) -> str:
    """Say at which beamwidths fused is better, and at which worse."""
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


def _allowed(everything: Selection) -> str:
    """Say what the bound makes of the question, whatever the estimator."""
    study = everything.study
    for name in filter_titles(study):
        if not {(name, "fused"), (name, "active")} <= study.trials.keys():
            continue
        said = []
        for i in dict.fromkeys((len(study.beamwidth) - 1, len(study.beamwidth) // 2, 0)):
            cells = [(name, "active", i), (name, "fused", i)]
            alone, both = (mean_std(one)[0] for one in samples(everything, POSITION_BOUND, cells))
            if not both > 0.0:
                return ""
            beam = width_name(study.beamwidth[i])
            said.append(f"{alone:.3f} m to {both:.3f} m at {beam} ({1.0 - both / alone:.0%})")
        return (
            "Whatever the estimator, listening may lower the least error that the sound leaves "
            f"from {', '.join(said)}, in the mean over all worlds. {IN_ONE_WORLD}"
        )
    return ""


def _reached(everything: Selection) -> list[str]:
    """Say of each filter how near it comes to the least error that the sound leaves."""
    sentences = []
    for name, title in filter_titles(everything.study).items():
        times, online = times_the_bound(everything, name)
        if times:
            beside = ", of the path as it was believed at each time" if online else ""
            sentences.append(
                f"{title[0].upper()}{title[1:]} has of that least error, root mean squares with "
                f"everything counted{beside}, by strategy and over the beamwidths, {times} times."
            )
    return sentences


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
