"""`pipistrelle compare` and `pipistrelle report`: differences of results, a study on one page."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from pipistrelle.evaluation.scores import heading, shown_in
from pipistrelle.verbs.console import announced, text_table
from pipistrelle.verbs.streams import put, say


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
    quiet: Annotated[bool, Parameter(negative=(), help="Print only the path of the page.")] = False,
) -> None:
    """Answer a study's question on one page, with its figures; judge the paper's claims by it."""
    from pipistrelle.evaluation.comparison import INTERVALS
    from pipistrelle.report.page import MIN_WORLDS, write_report
    from pipistrelle.report.study import read_study
    from pipistrelle.report.tables import not_the_papers_line

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


if TYPE_CHECKING:
    from pipistrelle.experiments.comparing import (
        Compared,
        ComparedCase,
        ComparedEstimate,
        ComparedMissions,
        ComparedStudies,
    )

SIGNIFICANCE = 0.05
"""Differences with a smaller p, corrected for all cases, are marked."""


def compare(
    *folders: Annotated[
        Path, Parameter(help="Folders of `run` or `slam`, or of studies; two or more.")
    ],
    output: Annotated[
        Path | None,
        Parameter(
            name=("--output", "-o"),
            metavar="DIR",
            help="Keep all numbers and a figure there. [default: print the tables alone]",
        ),
    ] = None,
    overwrite: Annotated[
        bool, Parameter(negative=(), help="Replace an earlier comparison in DIR.")
    ] = False,
    drop_diverged: Annotated[
        bool,
        Parameter(negative=(), help="Of studies: leave out worlds in which either case diverged."),
    ] = False,
    quiet: Annotated[bool, Parameter(negative=(), help="Print the result folder alone.")] = False,
) -> None:
    """Put results side by side, the first of them held against each other one."""
    from pipistrelle.config import InputError
    from pipistrelle.experiments import comparing

    if output is None and (overwrite or quiet):
        flag = "--overwrite" if overwrite else "--quiet"
        raise InputError(f"{flag}: nothing is kept without -o DIR; add it, or leave the flag out")
    compared: Compared
    if comparing.kind_of(folders) == "studies":
        compared = comparing.compare_studies(folders, drop_diverged=drop_diverged)
        shown = _study_tables(compared)
    elif drop_diverged:
        raise InputError("--drop-diverged: is for studies; a run is one world; leave it out")
    else:
        compared = comparing.compare_missions(folders)
        shown = _mission_tables(compared)
    answer, notes = _answer(compared), comparing.notes_of(compared)
    if output is not None:
        _keep(output, compared, (*answer, *notes), overwrite=overwrite, quiet=quiet)
    if not quiet:
        blocks = [_names(compared), "\n".join(answer), *shown, _settings(compared)]
        put("\n\n".join(block for block in [*blocks, "\n".join(notes)] if block))
    if output is not None:
        put(output)


def _answer(compared: "Compared") -> list[str]:
    """Return a sentence for each other folder: its position RMSE, averaged over the grid."""
    from pipistrelle.experiments.comparing import LETTERS, POSITION, ComparedStudies
    from pipistrelle.experiments.comparison_files import less
    from pipistrelle.report.effects import headline
    from pipistrelle.report.variables import amount

    title, first = "position RMSE", LETTERS[0]
    if isinstance(compared, ComparedStudies):
        cases = sum(c.score == POSITION and c.other == 1 for c in compared.cases)
        return [
            headline(f"{LETTERS[one.b]} instead of {first}", title, "m", one, cases)
            for one in compared.overall
        ]
    lines = []
    for letter, i in zip(LETTERS[1:], range(1, len(compared.folders)), strict=False):
        errors = [[one.scores[k].get(POSITION) for k in (0, i)] for one in compared.compared]
        gaps = [gap for a, b in errors if (gap := less(b, a)) is not None]
        if gaps:
            mean, count = sum(gaps) / len(gaps), len(gaps)
            size = "+" * (mean > 0.0) + amount(mean, "m")
            mean_of = f", averaged over {count} estimates" * (count > 1)
            lines.append(f"{letter} instead of {first} changes the {title} by {size}{mean_of}.")
    return lines


def _keep(
    output: Path, compared: "Compared", notes: Sequence[str], *, overwrite: bool, quiet: bool
) -> None:
    """Write the comparison into its folder."""
    from pipistrelle.experiments.comparison_files import write_comparison
    from pipistrelle.figures.comparison import draw_comparison
    from pipistrelle.figures.style import save_figure
    from pipistrelle.files import COMPARISON, claim
    from pipistrelle.verbs.console import command_line

    own = claim(output, COMPARISON, overwrite=overwrite)

    def draw(room: Path) -> None:
        save_figure(draw_comparison(compared), room, "comparison")

    with announced("Drawing the comparison ...", 1e9 if quiet else 3.0):
        write_comparison(own, compared, command=command_line(), notes=notes, draw=draw)


def _names(compared: "Compared") -> str:
    """Return the letter and path of each folder, and the worlds of studies."""
    from pipistrelle.experiments.comparing import ComparedStudies
    from pipistrelle.experiments.comparison_files import lettered
    from pipistrelle.files import spelt

    lines = [f"{letter}  {spelt(folder)}" for letter, folder in lettered(compared.folders)]
    if isinstance(compared, ComparedStudies):
        counts = zip(compared.done, compared.planned, strict=True)
        lines = [
            f"{line}: {done} worlds" + f" of {planned}" * (done < planned)
            for line, (done, planned) in zip(lines, counts, strict=True)
        ]
    return "\n".join(lines)


def _settings(compared: "Compared") -> str:
    """Format the settings that differ."""
    from pipistrelle.experiments.comparison_files import lettered, settings_rows

    rows = settings_rows(compared)
    if not rows:
        return "No setting differs."
    heads = [["settings that differ", *(letter for letter, _ in lettered(compared.folders))]]
    return text_table("", heads, [["-" if cell is None else cell for cell in row] for row in rows])


def _mission_tables(compared: "ComparedMissions") -> Iterator[str]:
    """Format the scores of each estimate and their differences."""
    from pipistrelle.experiments.comparison_files import lettered

    letters = [letter for letter, _ in lettered(compared.folders)]
    for estimate in compared.compared:
        words = [_unlike(estimate, i) for i in range(len(letters))]
        heads = [[estimate.title, *letters, *(f"{x} - {letters[0]}" for x in letters[1:])]]
        if any(words):
            heads.append(["", *words, *[""] * (len(letters) - 1)])
        yield text_table("", heads, list(_score_rows(estimate)))


def _unlike(estimate: "ComparedEstimate", i: int) -> str:
    """Return the parts of an estimate's name that the title lacks."""
    from pipistrelle.estimation.catalogue import short_name

    title = estimate.title.split()
    words = map(short_name, estimate.estimates[i])
    return " ".join(word for word in words if word not in title)


def _score_rows(estimate: "ComparedEstimate") -> Iterator[list[str]]:
    """Yield the rows of the scores that any folder has."""
    from pipistrelle.experiments.comparison_files import less, scores_of

    folders = [scores_of(scores) for scores in estimate.scores]
    for name, score in shown_in("missions").items():
        title, digits = heading(score), score.digits
        values = [scores.get(name) for scores in folders]
        if name == "diverged":
            if any(values):
                words = ("-" if v is None else "yes" if v else "no" for v in values)
                yield [title, *words, *[""] * (len(values) - 1)]
        elif any(value is not None for value in values) and (name != "gated" or any(values)):
            gaps = [_signed(less(value, values[0]), digits) for value in values[1:]]
            yield [title, *(_number(value, digits) for value in values), *gaps]


def _study_tables(compared: "ComparedStudies") -> Iterator[str]:
    """Format the means of each score by case, and their differences with intervals."""
    several = len(compared.folders) > 2
    for name, score in shown_in("studies").items():
        cases = [case for case in compared.cases if case.score == name]
        if not cases:
            continue
        title, digits = heading(score), score.mean_digits or score.digits
        rows = [_case_row(case, digits, several) for case in cases]
        other = "other" if several else "B"
        heads = [[title, "A", other, f"{other} - A", "95 %, all cases", "", "worlds", "diverged"]]
        yield text_table("", heads, rows)


def _case_row(case: "ComparedCase", digits: int, several: bool) -> list[str]:
    """Return the row of a case for a score."""
    from pipistrelle.experiments.comparing import LETTERS

    contrast, finding = case.contrast, case.contrast.finding
    low, high = (_signed(bound, digits) for bound in finding.family)
    known = all(abs(bound) < float("inf") for bound in finding.family)
    worlds = dict.fromkeys(contrast.worlds)
    return [
        case.label + f", {LETTERS[case.other]}" * several,
        *(_number(mean, digits) for mean in contrast.means),
        _signed(finding.mean, digits),
        f"{low} to {high}" if known else "-",
        "*" * (finding.p < SIGNIFICANCE) + "~" * (not contrast.paired),
        " / ".join(map(str, worlds)),
        " / ".join(map(str, case.diverged)) if any(case.diverged) else "",
    ]


def _number(value: Any, digits: int) -> str:
    """Format a number, a huge one in few digits; a dash without one."""
    if value is None or value != value:
        return "-"
    return f"{value:.{digits}f}" if abs(value) < 1e5 else f"{value:.3g}"


def _signed(value: float | None, digits: int) -> str:
    """Format a difference with its sign."""
    text = _number(value, digits)
    return text if text.startswith("-") else f"+{text}"
