"""The answer in plain words: what listening to the beacon does to the map, and how surely."""

from collections.abc import Sequence

import numpy as np

from pipistrelle.evaluation.comparison import Finding, judge
from pipistrelle.figures.style import FILTER_NAMES
from pipistrelle.report.claims import Claim
from pipistrelle.report.contrasts import differences
from pipistrelle.report.outcomes import COMMON, Study, samples
from pipistrelle.report.published import beam_name

NUMBERS = ("none", "one", "two", "three", "four", "five", "six", "seven", "eight")


def answer(study: Study, claims: Sequence[Claim]) -> list[str]:
    """Answer the question, then say what of the paper's claims is left.

    Parameters
    ----------
    study : Study
    claims : sequence of Claim

    Returns
    -------
    list of str
        A line that stands alone, then sentences.
    """
    placed = {name: _findings(study, COMMON, name) for name in FILTER_NAMES}
    located = {name: _findings(study, "position_rmse_m", name) for name in FILTER_NAMES}
    sentences = (
        _counted(study),
        _compared("The landmarks that every strategy places are placed", placed),
        _compared("The vehicle is located", located),
        _tally(claims),
    )
    return [_headline(study, placed), *(sentence for sentence in sentences if sentence)]


def _findings(study: Study, score: str, name: str) -> list[Finding]:
    """Judge active minus fused at each beamwidth, as a family of its own."""
    pair = (name, "active"), (name, "fused")
    return list(judge(differences(study, "world", score, *pair, name=name)))


def _headline(study: Study, placed: dict[str, list[Finding]]) -> str:
    """Answer in a line."""
    decided = [finding for mine in placed.values() for finding in mine if finding.n > 1]
    if not decided:
        return "Not decided yet: there are too few worlds, or no pair of active and fused."
    better = sum(finding.holds is True for finding in decided)
    worse = sum(finding.holds is False for finding in decided)
    fuller = "a fuller map" if _fuller(study) else "not a fuller map"
    if better and not worse:
        narrow = all(_narrow(mine) for mine in placed.values())
        where = "where the beam is narrow" if narrow else "at some beamwidths"
        where = "at every beamwidth" if better == len(decided) else where
        return f"Yes: {fuller}, and a more accurate one {where}."
    if worse and not better:
        return f"It builds {fuller}, and a less accurate one."
    if better:
        return f"It depends: {fuller}, at some beamwidths more accurate, at others less."
    return f"It builds {fuller}; that it is more accurate, or less, is not seen."


def _narrow(findings: Sequence[Finding]) -> bool:
    """Tell whether what is better, if anything, is so in the narrower half of the beams alone."""
    return all(finding.holds is not True for finding in findings[len(findings) // 2 :])


def _fuller(study: Study) -> bool:
    """Tell whether fused places more landmarks than active on average at every beamwidth."""
    pairs = [
        samples(study, "world", "landmarks_full", [(name, "fused", i), (name, "active", i)])
        for name in FILTER_NAMES
        if {(name, "fused"), (name, "active")} <= study.outcomes.keys()
        for i in range(len(study.beamwidth))
    ]
    return all(len(a) and np.mean(a) > np.mean(b) for a, b in pairs)


def _counted(study: Study) -> str:
    """Say how many landmarks fused and active place, at the narrowest and at the widest beam."""
    for name, label in FILTER_NAMES.items():
        if not {(name, "fused"), (name, "active")} <= study.outcomes.keys():
            continue
        said = []
        for i in dict.fromkeys((0, len(study.beamwidth) - 1)):
            cells = [(name, "fused", i), (name, "active", i)]
            fused, active = samples(study, "world", "landmarks_full", cells)
            if len(fused):
                beam = beam_name(study.beamwidth[i])
                said.append(f"{np.mean(fused):.0f} instead of {np.mean(active):.0f} at {beam}")
        if said:
            return (
                "Hearing the beacon as well as its own calls, the vehicle fully places, of "
                f"{study.config.scenario.landmarks + 1} landmarks, {' and '.join(said)} ({label})."
            )
    return ""


def _compared(subject: str, found: dict[str, list[Finding]]) -> str:
    """Say where fused is better than active, and where worse, with each filter."""
    said = []
    for name, findings in found.items():
        if not findings:
            continue
        parts = [
            f"{word} at {_beams(findings, outcome)}"
            for word, outcome in (("better", True), ("worse", False))
            if any(finding.holds is outcome for finding in findings)
        ]
        words = " and ".join(parts) or "no better and no worse at any beamwidth"
        said.append(f"with {FILTER_NAMES[name]} {words}")
    return f"{subject} {'; '.join(said)}." if said else ""


def _beams(findings: Sequence[Finding], outcome: bool) -> str:
    """Name the beamwidths of an outcome: how many, and which, in runs."""
    names = [finding.label.split(", ")[-1] for finding in findings]
    runs: list[list[str]] = []
    for i, finding in enumerate(findings):
        if finding.holds is outcome:
            if runs and i and findings[i - 1].holds is outcome:
                runs[-1].append(names[i])
            else:
                runs.append([names[i]])
    count = sum(map(len, runs))
    if count == len(findings):
        return "every beamwidth"
    which = ", ".join(run[0] if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)
    return f"{count} of {len(findings)} beamwidths ({which})"


def _tally(claims: Sequence[Claim]) -> str:
    """Count the verdicts."""
    verdicts = [claim.verdict for claim in claims]
    words = []
    for verdict in ("reproduced", "not-reproduced", "open"):
        count = verdicts.count(verdict)
        verb = "is" if count == 1 else "are"
        words.append(f"{NUMBERS[count]} {verb} {verdict.replace('-', ' ')}")
    return f"Of the paper's eight claims, {words[0]}, {words[1]} and {words[2]}."
