"""A study read as the question that it asks, and all that a report says of it, for programs.

A study that holds the paper's cases is asked the paper's question, and its claims are judged; any
other is asked what its variables do.
"""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from pipistrelle import __version__
from pipistrelle.report.claims.answer import answer as papers_answer
from pipistrelle.report.claims.answer import findings
from pipistrelle.report.claims.contrasts import selections
from pipistrelle.report.claims.published import papers_cases
from pipistrelle.report.claims.statements import CLAIMS, Claim
from pipistrelle.report.claims.verdicts import JudgedClaim, judge_claims, record
from pipistrelle.report.effects import comparing
from pipistrelle.report.effects.answer import HEADLINE, OTHERWISE, answer, question
from pipistrelle.report.effects.comparing import Effect, effects_of
from pipistrelle.report.page import overview
from pipistrelle.report.page.effect_tables import case_rows, effect_tables
from pipistrelle.report.studied import RULES, Rule, Selection, Study

FORMAT = 1
LIBRARIES = ("numpy", "scipy", "numba", "polars", "pydantic", "matplotlib", "jinja2")
PAPERS_QUESTION = "Does listening to someone else’s calls as well as one’s own build a better map?"


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered:
    """A study and the question that it answers."""

    study: Study
    papers: bool
    """It holds the paper's cases and is asked the paper's question."""
    question: str
    rule: Rule
    """One of `studied.RULES`. By which it is answered."""
    selections: Mapping[Rule, Selection]
    """Under each rule."""
    effects: Mapping[Rule, tuple[Effect, ...]]
    """Under each rule."""
    claims: tuple[JudgedClaim, ...]
    answer: list[str]
    """A line that stands alone, then sentences."""
    findings: list[dict[str, str]]
    """Rows below the answer to the paper's question; none of another's."""


def answered(study: Study, claims: Sequence[Claim] | None = None) -> Answered:
    """Ask a study its question.

    `claims`: as `write_report` takes them.
    """
    papers, by_rule = papers_cases(study), selections(study)
    effects = {rule: effects_of(selection) for rule, selection in by_rule.items()}
    asked = (CLAIMS if papers else ()) if claims is None else claims
    judged = judge_claims(by_rule, asked)
    lines = answer(by_rule[HEADLINE], effects[HEADLINE])
    return Answered(
        study=study,
        papers=papers,
        question=PAPERS_QUESTION if papers else question(study),
        rule="world" if papers else HEADLINE,
        selections=by_rule,
        effects=effects,
        claims=judged,
        answer=papers_answer(by_rule, judged) if papers else lines,
        findings=findings(by_rule) if papers else [],
    )


def summary(result: Answered) -> dict[str, Any]:
    """Lay out everything that the page says, for programs."""
    study, selection = result.study, result.selections[result.rule]
    return {
        "format": FORMAT,
        "version": __version__,
        "versions": {"python": platform.python_version()} | _versions(),
        "study": study.name,
        "seed": study.config.seed,
        "worlds_planned": study.planned,
        "worlds_done": len(study.worlds),
        "partial": len(study.worlds) < study.planned,
        "trials": sum(trials.failed.size for trials in study.trials.values()),
        "filters_cpu_s": study.cpu_s,
        "variables": [
            {"name": v.name, "setting": v.setting, "label": v.label, "values": [*v.words]}
            for v in study.variables
        ],
        "not_the_papers": overview.not_the_papers(study),
        "question": result.question,
        "answer": result.answer,
        "findings": result.findings,
        "answered_by": result.rule,
        "effect_tables": [] if result.papers else tables_of(result),
        "effects": comparing.record(result.effects, result.rule),
        "cases": case_rows(selection),
        "claims": [record(claim) for claim in result.claims],
        "exclusion_rules": dict(RULES),
        "exclusions": overview.exclusion_rows(study),
        "trials_failed": overview.failed_trials(study),
        "table_ii": overview.table_ii_rows(selection) if result.papers else [],
        "consistency": overview.consistency_rows(selection),
        "failed": [asdict(failure) for failure in study.errors],
    }


def tables_of(result: Answered) -> list[dict[str, Any]]:
    """Lay out what each variable changes, in words."""
    return effect_tables(
        result.selections[result.rule], result.effects[result.rule], result.effects[OTHERWISE]
    )


def _versions() -> dict[str, str]:
    """Read the versions of the libraries that numbers and pictures depend on."""
    found = {}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found
