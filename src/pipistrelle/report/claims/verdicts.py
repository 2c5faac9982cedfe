"""The paper's claims, each with a verdict by one rule.

*Reproduced*: every part of the claim holds. *Not reproduced*: of some part, the opposite is
significant. *Open*: neither, or the verdict changes with what is left out (`studied.RULES`). Of a
part that must hold everywhere, one statement whose opposite is significant is enough; of a part
that must hold at most beamwidths, it takes more than half.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pipistrelle.evaluation.comparison import Finding, judge
from pipistrelle.report.claims.statements import CLAIMS, Claim, Part
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
    """A part of a claim, and what the worlds say of each of its statements.

    Attributes
    ----------
    sentence, unit, need : of the part
    findings : tuple of Finding
    holds : True, False (the opposite is significant) or None (undecided)
    """

    sentence: str
    unit: str
    need: str
    findings: tuple[Finding, ...]
    holds: bool | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """What one exclusion rule makes of a claim.

    Attributes
    ----------
    verdict : str
    parts : tuple of JudgedPart
    decisive : Finding or None
        The statement that decides: the one farthest from holding, or nearest to failing.
    unit : str
        Of the decisive one.
    """

    verdict: Verdict
    parts: tuple[JudgedPart, ...]
    decisive: Finding | None
    unit: str


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgedClaim:
    """A claim, what each exclusion rule makes of it, and its verdict.

    Attributes
    ----------
    number : int
        Its place in the list of claims, from 1.
    sentence : str
    verdict : str
    reason : str
        In a sentence.
    by_rule : dict of Judgement
        By the names of `studied.RULES`.
    """

    number: int
    sentence: str
    verdict: Verdict
    reason: str
    by_rule: dict[Rule, Judgement]


def judge_claims(
    selections: Mapping[Rule, Selection],
    claims: Sequence[Claim] = CLAIMS,
    confidence: float = 0.95,
) -> tuple[JudgedClaim, ...]:
    """Judge claims, each as one family, under every exclusion rule.

    Parameters
    ----------
    selections : dict of Selection
        As `claims.contrasts.selections` gives them.
    claims : sequence of Claim
    confidence : between 0 and 1
        That all intervals of a claim hold.

    Returns
    -------
    tuple of JudgedClaim, one per claim
    """
    judged = []
    for number, claim in enumerate(claims, start=1):
        by_rule = {
            rule: _judged(claim.parts(selection), confidence)
            for rule, selection in selections.items()
        }
        verdicts = {rule: judgement.verdict for rule, judgement in by_rule.items()}
        agreed = len(set(verdicts.values())) == 1
        judged.append(
            JudgedClaim(
                number=number,
                sentence=claim.sentence,
                verdict=by_rule["world"].verdict if agreed else "open",
                reason=_reason(by_rule, agreed),
                by_rule=by_rule,
            )
        )
    return tuple(judged)


def record(claim: JudgedClaim) -> dict[str, Any]:
    """Lay a claim out for ``summary.json``; what is not finite becomes None.

    Parameters
    ----------
    claim : JudgedClaim

    Returns
    -------
    dict
    """
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
        "rule": claim.reason,
        "by_exclusion": by_rule,
    }


def tally(part: JudgedPart) -> tuple[int, int, int]:
    """Count the statements of a part that hold, are undecided, and are refuted.

    Parameters
    ----------
    part : JudgedPart

    Returns
    -------
    int, int, int
    """
    found = [finding.holds for finding in part.findings]
    return found.count(True), found.count(None), found.count(False)


def _judged(parts: Sequence[Part], confidence: float) -> Judgement:
    """Judge a claim's statements as one family, then its parts, then the claim."""
    findings = iter(judge([s for part in parts for s in part.statements], confidence))
    judged = []
    for part in parts:
        mine = tuple(next(findings) for _ in part.statements)
        judged.append(
            JudgedPart(
                sentence=part.sentence,
                unit=part.unit,
                need=part.need,
                findings=mine,
                holds=_holds([finding.holds for finding in mine], part.need),
            )
        )
    verdict: Verdict = "open"
    if any(part.holds is False for part in judged):
        verdict = "not-reproduced"
    elif all(part.holds for part in judged):
        verdict = "reproduced"
    pairs = [(finding, part) for part in judged for finding in part.findings]
    decisive, part = min(pairs, key=_standing, default=(None, None))
    return Judgement(
        verdict=verdict,
        parts=tuple(judged),
        decisive=decisive,
        unit=part.unit if part else "",
    )


def _holds(found: Sequence[bool | None], need: str) -> bool | None:
    """Decide a part; of nothing, nothing."""
    if not found:
        return None
    enough = len(found) // 2 + 1 if need == "most" else len(found)
    refuted = len(found) // 2 + 1 if need == "most" else 1
    if list(found).count(False) >= refuted:
        return False
    return True if list(found).count(True) >= enough else None


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


def _reason(by_rule: dict[Rule, Judgement], agreed: bool) -> str:
    """Say in a sentence why the verdict is what it is."""
    headline = by_rule["world"]
    if all(not part.findings for part in headline.parts):
        return "The study has no cases for this claim."
    if not agreed:
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
    }[headline.verdict]


def _statistic(judgement: Judgement) -> dict[str, Any]:
    """Name the number that decides."""
    finding = judgement.decisive
    if finding is None:
        return {"statistic": None, "of": None, "unit": "", "interval": None, "p": None, "n": 0}
    plain = _plain(finding)
    return {
        "statistic": plain["mean"],
        "of": finding.label,
        "unit": judgement.unit,
        "interval": plain["interval"],
        "p": plain["p"],
        "n": finding.n,
    }


def _plain(finding: Finding) -> dict[str, Any]:
    """Lay a finding out as JSON can hold it."""

    def finite(value: float) -> float | None:
        return value if math.isfinite(value) else None

    return {
        "label": finding.label,
        "relation": finding.relation,
        "margin": finite(finding.margin),
        "n": finding.n,
        "mean": finite(finding.mean),
        "std": finite(finding.std),
        "alone": [finite(bound) for bound in finding.alone],
        "interval": [finite(bound) for bound in finding.interval],
        "p": finite(finding.p),
        "holds": finding.holds,
    }
