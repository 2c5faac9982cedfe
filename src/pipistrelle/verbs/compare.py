"""`pipistrelle compare` and `pipistrelle report`: differences of results, a study on one page."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from pipistrelle.evaluation.scores import heading, shown_in
from pipistrelle.verbs.console import announced, command_line, number, output_to, text_table
from pipistrelle.verbs.streams import put, say


def report(
    folder: Annotated[Path, Parameter(help="A study's folder, whole or partial.")],
    /,
    *,
    output: Annotated[
        Path | None, output_to("DIR", "The page and figures.", "FOLDER/report")
    ] = None,
    quiet: Annotated[bool, Parameter(help="Print only the path of the page.")] = False,
) -> None:
    """Write a study's report: a page that answers its question and judges the paper's claims."""
    from pipistrelle.evaluation.comparison import INTERVALS
    from pipistrelle.report.claims import YARDSTICKS
    from pipistrelle.report.page import MIN_WORLDS, write_report
    from pipistrelle.report.study import read_study
    from pipistrelle.report.tables import not_the_papers_line

    target = folder / "report" if output is None else output
    study = read_study(folder)
    progress = (lambda _: None) if quiet else lambda name: say(f"Drawing {name} ...")
    summary = write_report(study, target, progress=progress)
    if not quiet:
        if summary["partial"]:
            put(f"partial: {summary['worlds_done']} of {summary['worlds_planned']} worlds")
        if count := summary["trials_failed"]:
            put(f"failed: {count} trial{'' if count == 1 else 's'}; see the page")
        if not summary["claims"]:
            for table in summary["effect_tables"]:
                put(_effects(table) + "\n")
            put(f"*: shown. {INTERVALS}")
            if (count := summary["worlds_done"]) < MIN_WORLDS:
                worlds = "1 world" if count == 1 else f"{count} worlds"
                put(f"This is of {worlds}: so few may show what others would not.")
        elif line := not_the_papers_line(summary["not_the_papers"]):
            put(line)
        for claim in summary["claims"]:
            verdict, count = claim["verdict"].replace("-", " "), len(claim["sentences"])
            put(f"{claim['claim']}  {verdict:<15} {claim['sentence']}")
            held = ", ".join(f"{claim[name]} of {count} by {name}" for name in YARDSTICKS)
            numbers = ", ".join(map(str, claim["decided_by"]))
            put(f"{'':<18} Sentences that hold: {held}; {verdict}: {numbers}.")
        put("\n" + "\n".join(summary["answer"]))
    put(target / "index.html")


_NOTHING: dict[str, Any] = {"text": "", "interval": "", "shown": False}


def _effects(table: dict[str, Any]) -> str:
    """Format an effect table as text: changes of the position RMSE, and others that are shown."""
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
    from pipistrelle.experiments.comparing import ComparedMissions, ComparedStudies


def compare(
    *folders: Annotated[
        Path, Parameter(help="Folders of `run` or `slam`, or of studies; two or more.")
    ],
    output: Annotated[Path | None, output_to("DIR", "Keep all numbers and a figure there.")] = None,
    overwrite: Annotated[bool, Parameter(help="Replace an earlier comparison in DIR.")] = False,
    drop_diverged: Annotated[
        bool, Parameter(help="Of studies: leave out worlds in which either case diverged.")
    ] = False,
    quiet: Annotated[bool, Parameter(help="Print only the result folder.")] = False,
) -> None:
    """Compare result folders in tables and a figure, each folder with the first."""
    from pipistrelle.config import InputError
    from pipistrelle.experiments import comparing
    from pipistrelle.files import COMPARISON, claim, spelt

    if output is None and (overwrite or quiet):
        flag = "--overwrite" if overwrite else "--quiet"
        raise InputError(f"{flag}: nothing is kept without -o DIR; add it, or leave the flag out")
    compared: ComparedMissions | ComparedStudies
    names = dict(zip(comparing.LETTERS, map(spelt, folders), strict=False))
    if comparing.are_studies(folders):
        compared = comparing.compare_studies(folders, drop_diverged=drop_diverged)
        from pipistrelle.report.effects import ANSWERED, headline

        cases = sum(r["score"] == comparing.POSITION and r["letter"] == "B" for r in compared.rows)
        answer = [
            headline(f"{comparing.LETTERS[one.b]} instead of A", ANSWERED[score], "m", one, cases)
            for score, one in compared.overall
        ]
        tables = _study_tables(compared)
        for letter, (done, planned) in zip(names, compared.worlds, strict=True):
            names[letter] += f": {done} worlds" + f" of {planned}" * (done < planned)
    elif drop_diverged:
        raise InputError("--drop-diverged: is for studies; a run is one world; leave it out")
    else:
        compared = comparing.compare_missions(folders)
        answer, tables = _missions_answer(compared), _mission_tables(compared)
    if output is not None:
        own = claim(output, COMPARISON, overwrite=overwrite)

        def draw(room: Path) -> None:
            from pipistrelle.figures.comparison import draw_comparison
            from pipistrelle.figures.style import save_figure

            save_figure(draw_comparison(compared), room, "comparison")

        notes = (*answer, *compared.notes)
        with announced("Drawing the comparison ...", 1e9 if quiet else 3.0):
            comparing.write_comparison(
                own, compared, command=command_line(), notes=notes, draw=draw
            )
    if not quiet:
        settings = "No setting differs."
        if compared.settings:
            rows = [
                [name, *("-" if text is None else text for text in texts)]
                for name, texts in compared.settings.items()
            ]
            settings = text_table("", [["settings that differ", *compared.folders]], rows)
        head = "\n".join(f"{letter}  {name}" for letter, name in names.items())
        blocks = [head, *tables, settings, "\n".join(compared.notes), "\n".join(answer)]
        put("\n\n".join(block for block in blocks if block))
    if output is not None:
        put(output)


def _missions_answer(compared: "ComparedMissions") -> list[str]:
    """Return sentences on the change of each position error from the first folder to each other."""
    from pipistrelle.experiments.comparing import less
    from pipistrelle.report.effects import ANSWERED
    from pipistrelle.report.variables import amount

    lines = []
    for i, letter in list(enumerate(compared.folders))[1:]:
        for score, title in ANSWERED.items():
            errors = [one.scores[score] for one in compared.estimates if score in one.scores]
            gaps = [less(error[i], error[0]) for error in errors]
            if known := [gap for gap in gaps if gap is not None]:
                mean, count = sum(known) / len(known), len(known)
                size = "+" * (mean > 0.0) + amount(mean, "m")
                mean_of = f", averaged over {count} estimates" * (count > 1)
                lines.append(f"{letter} instead of A changes the {title} by {size}{mean_of}.")
    return lines


def _mission_tables(compared: "ComparedMissions") -> Iterator[str]:
    """Yield a text table per estimate with its scores in all folders and their differences."""
    from pipistrelle.estimation.catalogue import short_name
    from pipistrelle.experiments.comparing import less

    letters = list(compared.folders)
    for estimate in compared.estimates:
        title = estimate.title.split()
        unlike = [
            " ".join(word for word in map(short_name, names) if word not in title)
            for names in estimate.estimates
        ]
        heads = [[estimate.title, *letters, *(f"{x} - A" for x in letters[1:])]]
        if any(unlike):
            heads.append(["", *unlike, *[""] * (len(letters) - 1)])
        rows = []
        for name, score in shown_in("missions").items():
            values = estimate.scores.get(name, ())
            if name in ("diverged", "gated") and not any(values):
                continue
            if name == "diverged":
                words = ("-" if v is None else "yes" if v else "no" for v in values)
                rows.append([heading(score), *words, *[""] * (len(letters) - 1)])
            elif any(value is not None for value in values):
                cells = [number(value, score.digits, "-") for value in values]
                gaps = [_signed(less(value, values[0]), score.digits) for value in values[1:]]
                rows.append([heading(score), *cells, *gaps])
        yield text_table("", heads, rows)


def _study_tables(compared: "ComparedStudies") -> Iterator[str]:
    """Yield a text table per score with its means by case and their differences."""
    from pipistrelle.experiments.comparing import SIGNIFICANCE

    several = len(compared.folders) > 2
    other = "other" if several else "B"
    for name, score in shown_in("studies").items():
        cases = [row for row in compared.rows if row["score"] == name]
        digits = score.mean_digits or score.digits
        rows = []
        for row in cases:
            low, high = row["low"], row["high"]
            known = low is not None and high is not None
            lost = row["diverged_first"], row["diverged"]
            rows.append([
                row["case"] + f", {row['letter']}" * several,
                number(row["mean_first"], digits, "-"),
                number(row["mean"], digits, "-"),
                _signed(row["difference"], digits),
                f"{_signed(low, digits)} to {_signed(high, digits)}" if known else "-",
                "*" * (row["p"] < SIGNIFICANCE) + "~" * (not row["paired"]),
                " / ".join(map(str, dict.fromkeys((row["worlds_first"], row["worlds"])))),
                " / ".join(map(str, lost)) if any(lost) else "",
            ])  # fmt: skip
        heads = [heading(score), "A", other, f"{other} - A", "95 %, all cases", "", "worlds"]
        if cases:
            yield text_table("", [[*heads, "diverged"]], rows)


def _signed(value: float | None, digits: int) -> str:
    """Format a difference with a plus or minus sign."""
    text = number(value, digits, "-")
    return text if text.startswith("-") else f"+{text}"
