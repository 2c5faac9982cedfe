"""The paper's claims, each with a verdict by one rule.

*Reproduced*: every part of the claim holds, whatever is left out (`studied.RULES`). *Not
reproduced*: of some part the opposite is significant whatever is left out, and in the same
direction. *Open*: neither. The rules of exclusion are compared part by part: a claim of which one
part fails under one rule and another part under the next has not been refuted, nor has one that
fails for too much here and for too little there. Of a part that must hold everywhere, one
statement whose opposite is significant is enough; of a part that must hold at most beamwidths, it
takes more than half.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pipistrelle.evaluation.comparison import Finding, judge
from pipistrelle.report.claims.statements import CLAIMS, Claim, Part
from pipistrelle.report.effects.comparing import json_finding
from pipistrelle.report.studied import Rule, Selection

Verdict = Literal["reproduced", "not-reproduced", "open"]
WITHOUT: dict[Rule, str] = {
    "world": "without diverged worlds",
    "case": "without diverged cases",
    "none": "with everything",
}
"""The exclusion rules, for use in a sentence."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgedPart:
    """A part of a claim, and what the worlds say of each of its statements."""

    sentence: str
    unit: str
    need: str
    findings: tuple[Finding, ...]
    holds: bool | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """What one exclusion rule makes of a claim."""

    verdict: Verdict
    parts: tuple[JudgedPart, ...]
    decisive: Finding | None
    """The statement that decides: the one farthest from holding, or nearest to failing."""
    unit: str
    """Of the decisive one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgedClaim:
    """A claim, what each exclusion rule makes of it, and its verdict."""

    number: int
    """Its place in the list of claims, from 1."""
    sentence: str
    verdict: Verdict
    reason: str
    """In a sentence."""
    by_rule: dict[Rule, Judgement]
    """By the names of `studied.RULES`."""


def judge_claims(
    selections: Mapping[Rule, Selection],
    claims: Sequence[Claim] = CLAIMS,
    confidence: float = 0.95,
) -> tuple[JudgedClaim, ...]:
    """Judge claims, each as one family, under every exclusion rule.

    `selections`: as `claims.contrasts.selections` gives them. `confidence`: that all intervals of a
    claim hold.
    """
    judged = []
    for number, claim in enumerate(claims, start=1):
        by_rule = {
            rule: _judged([part for make in claim.parts for part in make(selection)], confidence)
            for rule, selection in selections.items()
        }
        parts = zip(*(judgement.parts for judgement in by_rule.values()), strict=True)
        verdict = _verdict([_holds_throughout(alike) for alike in parts])
        judged.append(
            JudgedClaim(
                number=number,
                sentence=claim.sentence,
                verdict=verdict,
                reason=_reason(verdict, by_rule),
                by_rule=by_rule,
            )
        )
    return tuple(judged)


def with_everything(claim: JudgedClaim) -> Finding | None:
    """Find the deciding statement of a claim with all worlds counted.

    Returns: none where nothing decides.
    """
    headline = claim.by_rule["world"]
    for part, same in zip(headline.parts, claim.by_rule["none"].parts, strict=True):
        for finding, twin in zip(part.findings, same.findings, strict=True):
            if finding is headline.decisive:
                return twin
    return None


def record(claim: JudgedClaim) -> dict[str, Any]:
    """Lay a claim out for ``summary.json``; what is not finite becomes None."""
    by_rule = {
        rule: {
            "verdict": judgement.verdict,
            **_statistic(judgement),
            "parts": [
                {
                    "sentence": part.sentence,
                    "unit": part.unit,
                    "need": part.need,
                    "holds": part.holds,
                    "findings": [_plain(finding) for finding in part.findings],
                }
                for part in judgement.parts
            ],
        }
        for rule, judgement in claim.by_rule.items()
    }
    return {
        "claim": claim.number,
        "sentence": claim.sentence,
        "verdict": claim.verdict,
        **_statistic(claim.by_rule["world"]),
        "with_everything": None if (twin := with_everything(claim)) is None else _plain(twin),
        "rule": claim.reason,
        "by_exclusion": by_rule,
    }


def tally(part: JudgedPart) -> tuple[int, int, int]:
    """Count the statements of a part that hold, are undecided, and are refuted."""
    found = [finding.holds for finding in part.findings]
    return found.count(True), found.count(None), found.count(False)


def _judged(parts: Sequence[Part], confidence: float) -> Judgement:
    """Judge a claim's statements as one family, then its parts, then the claim."""
    findings = iter(judge([s for part in parts for s in part.statements], confidence))
    judged = []
    for part in parts:
        of_part = tuple(next(findings) for _ in part.statements)
        judged.append(
            JudgedPart(
                sentence=part.sentence,
                unit=part.unit,
                need=part.need,
                findings=of_part,
                holds=_holds([finding.holds for finding in of_part], part.need),
            )
        )
    pairs = [(finding, part) for part in judged for finding in part.findings]
    decisive, part = min(pairs, key=_standing, default=(None, None))
    return Judgement(
        verdict=_verdict([part.holds for part in judged]),
        parts=tuple(judged),
        decisive=decisive,
        unit=part.unit if part else "",
    )


def _holds(found: Sequence[bool | None], need: str) -> bool | None:
    """Decide a part from its statements; an empty part is undecided."""
    if not found:
        return None
    enough = len(found) // 2 + 1 if need == "most" else len(found)
    refuted = len(found) // 2 + 1 if need == "most" else 1
    if list(found).count(False) >= refuted:
        return False
    return True if list(found).count(True) >= enough else None


def _verdict(parts: Sequence[bool | None]) -> Verdict:
    """Decide a claim by its parts."""
    if any(part is False for part in parts):
        return "not-reproduced"
    return "reproduced" if all(parts) else "open"


def _holds_throughout(part: Sequence[JudgedPart]) -> bool | None:
    """Decide a part over all exclusion rules; it is undecided if the rules disagree."""
    if all(judged.holds for judged in part):
        return True
    refuted = all(judged.holds is False for judged in part)
    return False if refuted and set.intersection(*map(_failings, part)) else None


def _failings(part: JudgedPart) -> set[float]:
    """Return the directions in which refuted statements miss: too low (-1) or too high (1)."""
    return {_side(finding) for finding in part.findings if finding.holds is False}


def _side(finding: Finding) -> float:
    """Return the direction in which a refuted mean misses its claim: -1 too low, 1 too high."""
    if finding.relation in ("above", "not above"):
        return -1.0 if finding.relation == "above" else 1.0
    return math.copysign(1.0, finding.mean - (finding.relation != "within") * finding.margin)


def _standing(pair: tuple[Finding, JudgedPart]) -> tuple[int, float]:
    """Order statements by the part they decide, then by how far they are from failing."""
    finding, part = pair
    order = {False: 0, None: 1, True: 2}
    if not (finding.std > 0.0):
        return order[part.holds], -math.inf
    error = finding.std / math.sqrt(finding.n)
    beyond = finding.mean - finding.margin
    distance = {
        "above": beyond,
        "not above": -beyond,
        "slightly above": -abs(beyond),
        "within": finding.margin - abs(finding.mean),
    }[finding.relation]
    return order[part.holds], distance / error


def _reason(verdict: Verdict, by_rule: dict[Rule, Judgement]) -> str:
    """Say in a sentence why the verdict is what it is."""
    headline = by_rule["world"]
    if all(not part.findings for part in headline.parts):
        return "The study has no cases for this claim."
    if verdict == "open" and {one.verdict for one in by_rule.values()} == {"not-reproduced"}:
        return "It fails whatever is left out, but for another reason each time: see its parts."
    if len({one.verdict for one in by_rule.values()}) > 1:
        words = ", ".join(
            f"{judgement.verdict.replace('-', ' ')} {WITHOUT[rule]}"
            for rule, judgement in by_rule.items()
        )
        return f"The verdict depends on what is left out: {words}."
    missing = [part for part in headline.parts if not part.findings]
    if missing and headline.verdict == "open":
        return "The study has no cases for a part of this claim."
    return {
        "reproduced": "Every part holds, whatever is left out.",
        "not-reproduced": "The opposite of a part is significant, whatever is left out.",
        "open": "Not every part holds, and the opposite of none is significant.",
    }[verdict]


def _statistic(judgement: Judgement) -> dict[str, Any]:
    """Name the number that decides."""
    finding = judgement.decisive
    if finding is None:
        return {
            "statistic": None,
            "of": None,
            "unit": "",
            "interval": None,
            "sigma": None,
            "p": None,
            "n": 0,
        }
    json_finding = _plain(finding)
    return {
        "statistic": json_finding["mean"],
        "of": finding.label,
        "unit": judgement.unit,
        "interval": json_finding["interval"],
        "sigma": json_finding["sigma"],
        "p": json_finding["p"],
        "n": finding.n,
    }


def _plain(finding: Finding) -> dict[str, Any]:
    """Return a finding and its claim as JSON values."""
    return {
        "label": finding.label,
        "relation": finding.relation,
        "margin": finding.margin if math.isfinite(finding.margin) else None,
        "sigma": finding.sigma if math.isfinite(finding.sigma) else None,
        "fitted": finding.fitted,
        **json_finding(finding),
        "holds": finding.holds,
    }
