"""What the pages show of the whole studies, taken from their folders.

    python papers/bradley_abaid/publish.py STUDY...

Of each study it writes ``study_NAME.json`` beside this file, NAME being the folder's name: what
``summary.json`` of a report has, with the findings of a sentence that decide it alone, and the
worlds that are lost if the NEES is averaged over the beamwidths of a strategy first. Then it fills
the tables of the pages (`pages`).
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pages

from pipistrelle.config import InputError
from pipistrelle.estimation.catalogue import entry
from pipistrelle.evaluation.consistency import diverged
from pipistrelle.files import write_whole
from pipistrelle.report.claims import judge_claims, judge_sentences, papers_answer, scoreboard
from pipistrelle.report.study import Study, read_study, selections
from pipistrelle.report.tables import consistency_rows, exclusion_rows, table_ii_rows

MEASURES = ("by_means", "by_bands", "by_intervals", "means", "bands", "intervals", "refuted")
KEPT = ("sentence", "claim", "section", "words", "verdict", "unit", "comparisons", *MEASURES)
ERRORS = ("papers_error", "standard_error")


def main() -> None:
    """Read each study, write what is shown of it, and fill the pages."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("studies", type=Path, nargs="+", help="folders of `pipistrelle study`")
    try:
        for folder in options.parse_args().studies:
            text = json.dumps(shown(read_study(folder)), indent=1, ensure_ascii=False)
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
        "exclusions": [row | averaged(study, row["filter"]) for row in exclusion_rows(study)],
        "table_ii": table_ii_rows(by_rule["world"]),
        "consistency": consistency_rows(by_rule["world"]),
    }


def deciding(row: dict[str, Any]) -> dict[str, Any]:
    """Return a judged sentence with its decisive finding, and the same one with everything."""
    papers, everything = (row["by_exclusion"][rule] for rule in ("world", "none"))
    found: dict[str, Any] = {"decisive": None, "with_everything": None}
    if papers["decisive"] is not None:
        one = papers["findings"][papers["decisive"]]
        same = (f for f in everything["findings"] if f["label"] == one["label"])
        found = {"decisive": one, "with_everything": next(same, None)}
    return {key: row[key] for key in (*KEPT, *ERRORS)} | found


def averaged(study: Study, name: str) -> dict[str, int]:
    """Count the worlds in which the NEES, averaged over a strategy's beamwidths, diverges."""
    lost = np.zeros(len(study.worlds), dtype=bool)
    for (other, _), trials in study.trials.items():
        if other == name:
            mean = trials.nees.mean(axis=1)
            lost |= np.array([diverged(one, entry(name).nees_limit) for one in mean])
    return {"excluded_by_average": int(lost.sum())}


if __name__ == "__main__":
    main()
