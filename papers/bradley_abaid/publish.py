"""What the pages show of the whole studies, taken from their folders.

    python papers/bradley_abaid/publish.py STUDY...

Of each study it writes ``study_NAME.json`` beside this file, NAME being the folder's name: what
``summary.json`` of a report has, with the findings of a sentence that decide it alone, and the
worlds in which any case diverges. Then it fills the tables of the pages (`pages`).
"""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pages

from pipistrelle.config import InputError
from pipistrelle.files import write_whole
from pipistrelle.report.claims import judge_claims, judge_sentences, papers_answer, scoreboard
from pipistrelle.report.sentences import FILTERS
from pipistrelle.report.study import (
    POSITION,
    Rule,
    Selection,
    Study,
    mean_std,
    read_study,
    samples,
    selections,
)
from pipistrelle.report.tables import consistency_rows, exclusion_rows, table_ii_rows

MEASURES = ("by_means", "by_bands", "by_intervals", "means", "bands", "intervals", "refuted")
KEPT = ("sentence", "claim", "section", "words", "verdict", "unit", "comparisons", *MEASURES)
BEAMS = (180.0, 41.6, 33.2, 11.4)
"""Beamwidths at which the gain of fused over active sensing is shown [deg]."""
WAYS = ("active", "fused")
ERRORS = ("papers_error", "standard_error")


def main() -> None:
    """Read each study, write what is shown of it, and fill the pages."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("studies", type=Path, nargs="+", help="folders of `pipistrelle study`")
    try:
        for folder in options.parse_args().studies:
            text = json.dumps(shown(read_study(folder)), ensure_ascii=False)
            write_whole(pages.summary_file(folder.name), f"{text}\n".encode())
        pages.fill()
    except InputError as mistake:
        sys.exit(str(mistake))


def shown(study: Study) -> dict[str, Any]:
    """Return what the pages show of a study."""
    by_rule = selections(study)
    sentences = judge_sentences(by_rule)
    return {
        "study": study.name,
        "seed": study.config.seed,
        "worlds_planned": study.planned,
        "worlds_done": len(study.worlds),
        "trials": sum(trials.failed.size for trials in study.trials.values()),
        "answer": papers_answer(by_rule, sentences),
        "scoreboard": scoreboard(sentences),
        "claims": judge_claims(sentences),
        "sentences": [deciding(row) for row in sentences],
        "exclusions": [row | any_diverged(study, row["filter"]) for row in exclusion_rows(study)],
        "table_ii": table_ii_rows(by_rule["world"]),
        "consistency": consistency_rows(by_rule["world"]),
        "gains": [gain(by_rule, name, beam) for name in FILTERS for beam in BEAMS],
    }


def gain(by_rule: Mapping[Rule, Selection], name: str, beam: float) -> dict[str, Any]:
    """Return mean and standard error of active less fused in position [m], at a beamwidth."""
    row: dict[str, Any] = {"filter": name, "beamwidth": beam}
    for rule in ("world", "none"):
        selection = by_rule[rule]
        near = int(np.abs(selection.study.beamwidth - beam).argmin())
        active, fused = samples(selection, POSITION, [(name, way, near) for way in WAYS])
        mean, std = mean_std(active - fused)
        row[rule] = [mean, std / len(active) ** 0.5]
    return row


def deciding(row: dict[str, Any]) -> dict[str, Any]:
    """Return a judged sentence with its decisive finding, and the same one with everything."""
    papers, everything = (row["by_exclusion"][rule] for rule in ("world", "none"))
    found: dict[str, Any] = {"decisive": None, "with_everything": None}
    if papers["decisive"] is not None:
        one = papers["findings"][papers["decisive"]]
        same = (f for f in everything["findings"] if f["label"] == one["label"])
        found = {"decisive": one, "with_everything": next(same, None)}
    return {key: row[key] for key in (*KEPT, *ERRORS)} | found


def any_diverged(study: Study, name: str) -> dict[str, int]:
    """Count the worlds in which any case of a filter diverges."""
    of_filter = [trials for (other, _), trials in study.trials.items() if other == name]
    lost = np.any([trials.diverged.any(axis=1) for trials in of_filter], axis=0)
    return {"any_diverged": int(lost.sum())}


if __name__ == "__main__":
    main()
