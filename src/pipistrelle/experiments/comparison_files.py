"""Files of a comparison: a table of all numbers, the settings that differ, a figure, a README."""

import io
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipistrelle import __version__
from pipistrelle.estimation.catalogue import short_name
from pipistrelle.experiments.comparing import LETTERS, Compared, ComparedMissions, ComparedStudies
from pipistrelle.files import OwnFiles, drawn_files, spelt

if TYPE_CHECKING:
    import polars as pl

NOT_SCORES = ("strategy", "filter", "ignored_rows", "online")
"""Other entries of an estimate in ``summary.json``."""
README = """\
# A comparison

    {command}

Pipistrelle {version}. SI units and radians; what ends in _deg is in degrees. A difference is that
of a folder less the first, {first}.

{folders}

{notes}

| file | what it holds |
|---|---|
| comparison.csv, comparison.parquet | {table} |
| settings.csv | the settings that differ, a column for each folder; empty: it says nothing |
| comparison.png, comparison.pdf | {figure} |
| SHA256SUMS | what was written here: `--overwrite` touches nothing else (`sha256sum -c`) |
"""
MISSIONS = (
    "a row for each estimate, folder and score",
    "the paths, as they are and each after the rigid motion that brings it nearest to its truth "
    "(without one, to the first folder's path); beside them the distance from there",
)
STUDIES = (
    "a row for each case, study and score: means, their difference, its interval by itself "
    "(alone_low, alone_high) and as one of all cases (low, high), and p as one of them (Holm)",
    "the differences by case: thick by itself, thin as one of all cases; full points are "
    "significant",
)


def write_comparison(
    own: OwnFiles,
    compared: Compared,
    *,
    command: str,
    notes: Sequence[str],
    draw: Callable[[Path], None] = lambda _: None,
) -> None:
    """Write a comparison into a folder, in place of an earlier one.

    `own`: the folder, as `pipistrelle.files.claim` gives it. `command`: the command line.
    `notes`: remarks for the README. `draw`: writes the figure into a folder. Raises InputError if a
    file cannot be written, or one to be replaced was changed.
    """
    buffer, table = io.BytesIO(), comparison_table(compared)
    table.write_parquet(buffer)
    what, figure = MISSIONS if isinstance(compared, ComparedMissions) else STUDIES
    text = README.format(
        command=command,
        version=__version__,
        first=LETTERS[0],
        folders="\n".join(f"- {x}: {_quoted(spelt(f))}" for x, f in lettered(compared.folders)),
        notes="\n".join(f"- {note}" for note in notes),
        table=what,
        figure=figure,
    )
    own.replace(
        {
            "comparison.parquet": buffer.getvalue(),
            "comparison.csv": table.write_csv(),
            "settings.csv": settings_table(compared).write_csv(),
            **drawn_files(draw),
            "README.md": text,
        }
    )


def _quoted(text: str) -> str:
    """Return text as Markdown code, whatever backticks it contains."""
    ticks = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    pad = " " if "`" in text else ""
    return f"{ticks}{pad}{text}{pad}{ticks}"


def lettered(folders: Sequence[Path]) -> list[tuple[str, Path]]:
    """Give each folder its letter.

    Examples
    --------
    >>> [letter for letter, _ in lettered([Path("one"), Path("two")])]
    ['A', 'B']
    """
    return list(zip(LETTERS, folders, strict=False))


def scores_of(run: Mapping[str, Any]) -> dict[str, float | None]:
    """Return all scores of an estimate's entry of ``summary.json``, with its online path's.

    Examples
    --------
    >>> scores_of({"filter": "ekf", "gated": 3, "diverged": False, "nees_max": None})
    {'gated': 3.0, 'diverged': 0.0, 'nees_max': None}
    """
    numbers = {name: value for name, value in run.items() if name not in NOT_SCORES}
    numbers |= {f"online_{name}": value for name, value in (run.get("online") or {}).items()}
    return {name: None if value is None else float(value) for name, value in numbers.items()}


def less(value: float | None, first: float | None) -> float | None:
    """Return the difference of two values; None if any is missing.

    Examples
    --------
    >>> less(3.0, 1.0), less(3.0, None)
    (2.0, None)
    """
    return None if value is None or first is None else value - first


def comparison_table(compared: Compared) -> "pl.DataFrame":
    """Return all numbers of a comparison as a table; null for missing numbers."""
    import polars as pl

    missions = isinstance(compared, ComparedMissions)
    rows = _mission_rows(compared) if missions else _study_rows(compared)
    return pl.DataFrame(rows, infer_schema_length=None).with_columns(
        pl.selectors.float().fill_nan(None)
    )


def settings_table(compared: Compared) -> "pl.DataFrame":
    """Return the settings that differ, a row each, with a column for each folder."""
    import polars as pl

    letters = [letter for letter, _ in lettered(compared.folders)]
    rows = [dict(zip(("setting", *letters), row, strict=True)) for row in settings_rows(compared)]
    return pl.DataFrame(rows, schema=dict.fromkeys(("setting", *letters), pl.String))


def settings_rows(compared: Compared) -> list[tuple[str | None, ...]]:
    """Return the settings and versions that differ: name, then the value in each folder or None."""
    unlike: dict[str, tuple[Any, ...]] = {}
    if len(set(compared.versions)) > 1:
        unlike["version of Pipistrelle"] = tuple(version or None for version in compared.versions)
    return [
        (name, *(v if v is None or isinstance(v, str) else json.dumps(v) for v in values))
        for name, values in (unlike | {**compared.settings}).items()
    ]


def _mission_rows(compared: ComparedMissions) -> list[dict[str, Any]]:
    """Return a row for each estimate, score and folder."""
    rows = []
    for estimate in compared.compared:
        by_folder = [scores_of(scores) for scores in estimate.scores]
        for score in dict.fromkeys(name for scores in by_folder for name in scores):
            for (letter, folder), (strategy, name), scores in zip(
                lettered(compared.folders), estimate.estimates, by_folder, strict=True
            ):
                value = scores.get(score)
                rows.append(
                    {
                        "estimate": estimate.title,
                        "score": score,
                        "letter": letter,
                        "folder": spelt(folder),
                        "strategy": strategy,
                        "filter": short_name(name),
                        "value": value,
                        "difference": less(value, by_folder[0].get(score)),
                    }
                )
    return rows


def _study_rows(compared: ComparedStudies) -> list[dict[str, Any]]:
    """Return a row for each score, case and other study."""
    rows = []
    for case in compared.cases:
        contrast, finding = case.contrast, case.contrast.finding
        bounds = (*finding.family, *finding.alone)
        low, high, alone_low, alone_high = (x if math.isfinite(x) else None for x in bounds)
        values = {
            name: value
            if value is None or isinstance(value, (int, float, str))
            else json.dumps(value)
            for name, value in case.values.items()
        }
        rows.append(
            {
                "case": case.label,
                "strategy": case.strategies[1],
                "filter": short_name(case.filters[1]),
                **values,
                "beamwidth_deg": case.beamwidth_deg,
                "score": case.score,
                "letter": LETTERS[case.other],
                "folder": spelt(compared.folders[case.other]),
                "paired": contrast.paired,
                "worlds_first": contrast.worlds[0],
                "worlds": contrast.worlds[1],
                "mean_first": contrast.means[0],
                "mean": contrast.means[1],
                "difference": finding.mean,
                "low": low,
                "high": high,
                "alone_low": alone_low,
                "alone_high": alone_high,
                "p": finding.p,
                "diverged_first": case.diverged[0],
                "diverged": case.diverged[1],
            }
        )
    return rows
