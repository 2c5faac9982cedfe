"""`pipistrelle report`: a study on one page."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter


def report(
    folder: Annotated[Path, Parameter(help="A study's folder, whole or partial.")],
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
    """Judge the paper's claims by a study, and put it on one page with its figures."""
    from pipistrelle.report.page.overview import failed_trials, not_the_papers, not_the_papers_line
    from pipistrelle.report.page.page import write_report
    from pipistrelle.report.reading import read_study
    from pipistrelle.verbs.streams import put, say

    target = folder / "report" if output is None else output
    studies = read_study(folder)
    claims = write_report(
        studies, target, progress=lambda name: None if quiet else say(f"Drawing {name} ...")
    )
    if not quiet:
        done, planned = len(studies[0].worlds), studies[0].planned
        if done < planned:
            put(f"partial: {done} of {planned} worlds")
        if count := sum(map(failed_trials, studies)):
            put(f"failed: {count} trial{'' if count == 1 else 's'}; see the page")
        if line := not_the_papers_line(not_the_papers(studies[0])):
            put(line)
        for claim in claims:
            put(f"{claim.number}  {claim.verdict.replace('-', ' '):<15} {claim.sentence}")
    put(target / "index.html")
