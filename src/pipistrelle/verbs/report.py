"""`pipistrelle report`: a study on one page."""

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from pipistrelle.verbs.console import text_table


def report(
    folder: Annotated[Path, Parameter(help="A study's folder, whole or partial.")],
    /,
    *,
    output: Annotated[
        Path | None,
        Parameter(
            name=("--output", "-o"),
            metavar="DIR",
            help="Where index.html, summary.json and the figures go. [default: FOLDER/report]",
        ),
    ] = None,
    quiet: Annotated[bool, Parameter(negative=(), help="Print the page's path alone.")] = False,
) -> None:
    """Answer a study's question on one page, with its figures; judge the paper's claims by it."""
    from pipistrelle.evaluation.comparison import INTERVALS
    from pipistrelle.report.page import MIN_WORLDS, write_report
    from pipistrelle.report.study import read_study
    from pipistrelle.report.tables import not_the_papers_line
    from pipistrelle.verbs.streams import put, say

    target = folder / "report" if output is None else output
    study = read_study(folder)
    summary = write_report(
        study, target, progress=lambda name: None if quiet else say(f"Drawing {name} ...")
    )
    if not quiet:
        if summary["partial"]:
            put(f"partial: {summary['worlds_done']} of {summary['worlds_planned']} worlds")
        if count := summary["trials_failed"]:
            put(f"failed: {count} trial{'' if count == 1 else 's'}; see the page")
        if not summary["claims"]:
            for sentence in summary["answer"]:
                put(sentence)
            for table in summary["effect_tables"]:
                put("\n" + _effects(table))
            put(f"\n*: shown. {INTERVALS}")
            if (count := summary["worlds_done"]) < MIN_WORLDS:
                worlds = "1 world" if count == 1 else f"{count} worlds"
                put(f"This is of {worlds}: so few may show what others would not.")
        elif line := not_the_papers_line(summary["not_the_papers"]):
            put(line)
        for claim in summary["claims"]:
            put(f"{claim['claim']}  {claim['verdict'].replace('-', ' '):<15} {claim['sentence']}")
            if claim["verdict"] == "open":
                parts = claim["by_exclusion"]["world"]["parts"]
                holds = [finding["holds"] for part in parts for finding in part["findings"]]
                undecided = f"{holds.count(None)} of {len(holds)} statements"
                put(f"{'':<18} {claim['rule']} Undecided: {undecided}.")
    put(target / "index.html")


_NOTHING: dict[str, Any] = {"text": "", "interval": "", "shown": False}


def _effects(table: dict[str, Any]) -> str:
    """Format the table of a variable: the change of the position RMSE, and others shown."""
    first, *others = table["measures"]
    rows = []
    for row in table["rows"]:
        if not row["end"] or (row["below"] and not row["contrary"]):
            continue
        main, *rest = (cell or _NOTHING for cell in row["cells"])
        also = [
            f"{name} {cell['text']}"
            for name, cell in zip(others, rest, strict=True)
            if cell["shown"]
        ]

        rows.append([
            "  " * row["below"] + row["label"], main["text"] + "*" * main["shown"],
            main["interval"], "; ".join(also[:3]) + "; ..." * (len(also) > 3),
        ])  # fmt: skip
    return text_table("", [[table["title"], first, "95 %", "also shown"]], rows)
