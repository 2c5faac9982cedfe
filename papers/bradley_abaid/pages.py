"""The tables of docs/findings.md and readings.md, made from what is kept of the whole studies.

    python papers/bradley_abaid/pages.py

A table stands between ``<!-- begin: NAME -->`` and ``<!-- end: NAME -->``, and is written anew from
the files ``study_*.json`` beside this one (`publish`). What stands outside is left as it is.
"""

import json
import re
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import polars as pl

from pipistrelle.report.sentences import FILTERS, FITTED, TABLE_II
from pipistrelle.report.variables import amount

ROOT = Path(__file__).parents[2]
PAGES = ("docs/findings.md", "papers/bradley_abaid/readings.md")
STUDIES = {"paper": "`paper`", "least": "least misfit", "physics": "`physics`"}
"""The whole studies, and how the tables call them."""
ANSWER = {True: "yes", False: "no", None: "open"}
VERDICT = {"reproduced": "shown", "not-reproduced": "refuted", "open": "open"}
CHOICES = {
    "layout": ("disc", "annulus", "annulus by area"),
    "labels": ("0.1 rad", "0.2 rad", "0.3 rad", "0.5 rad", "cause", "nearest"),
    "cap": ("capped", "uncapped"),
    "front_end": ("paper", "physics"),
    "ranged": ("bearing", "anew", "moved"),
    "weighed": ("all", "initialised", "initialised, restart"),
    "exclusions": ("union", "average"),
}
"""The levels of `second_readings`, those of the plan `paper` as it was first."""
DAGGER = "†"
"""Marks a number that settings were fitted to."""


def main() -> None:
    """Fill the tables of all pages."""
    for path in fill():
        print(path)


def fill() -> list[Path]:
    """Write the tables of all pages anew; return the pages."""
    paths = [ROOT / page for page in PAGES]
    for path in paths:
        path.write_text(filled(path.read_text(encoding="utf-8")), encoding="utf-8")
    return paths


def filled(text: str) -> str:
    """Return a page with its tables written anew."""

    def block(found: re.Match[str]) -> str:
        begin, name, end = found.groups()
        return f"{begin}\n\n{TABLES[name]()}\n\n{end}"

    return re.sub(r"(<!-- begin: (\w+) -->).*?(<!-- end: \2 -->)", block, text, flags=re.DOTALL)


def summary_file(name: str) -> Path:
    """Return the file that keeps what is shown of a study."""
    return Path(__file__).with_name(f"study_{name}.json")


@cache
def summary(name: str) -> dict[str, Any]:
    """Read what is shown of a study."""
    found: dict[str, Any] = json.loads(summary_file(name).read_text(encoding="utf-8"))
    return found


def table(head: list[str], rows: list[list[str]]) -> str:
    """Lay out a table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def scoreboard() -> str:
    """Count the sentences that hold in each study, by each yardstick, and the worlds lost."""
    boards = [summary(name)["scoreboard"] for name in STUDIES]
    rows = []
    for title, key in {"means": "means", "bands of one σ": "bands"}.items():
        counts = [board[key] for board in boards]
        rows.append([f"hold by {title}", *(f"{one['reproduced']} of 26" for one in counts)])
    rows.append(
        [
            "shown, refuted and open by 95 % intervals, whatever is left out",
            *(", ".join(str(board["verdict"][key]) for key in VERDICT) for board in boards),
        ]
    )
    for words, key in {
        "worlds lost by the mean NEES of a strategy": "excluded",
        "worlds in which any case diverges": "any_diverged",
    }.items():
        cells = [
            " and ".join(str(row[key]) for row in summary(name)["exclusions"]) for name in STUDIES
        ]
        rows.append([f"{words}, EKF-SLAM and FastSLAM (paper: 8 and 15)", *cells])
    return table(["of the paper's 26 sentences", *STUDIES.values()], rows)


def claims() -> str:
    """Give of each claim the verdict by intervals, and how many of its sentences hold by bands."""
    rows = []
    for group in zip(*(summary(name)["claims"] for name in STUDIES), strict=True):
        cells = [
            f"{VERDICT[claim['verdict']]}; {claim['bands']} of {len(claim['sentences'])} by bands"
            for claim in group
        ]
        rows.append([str(group[0]["claim"]), group[0]["sentence"], *cells])
    return table(["", "claim", *STUDIES.values()], rows)


def sentences() -> str:
    """Judge each sentence: by means, bands and intervals, and the finding that decides."""
    rows = []
    for group in zip(*(summary(name)["sentences"] for name in STUDIES), strict=True):
        first = group[0]
        cells = [
            f"{ANSWER[row['by_means']]}, {ANSWER[row['by_bands']]}, {VERDICT[row['verdict']]}"
            for row in group
        ]
        words = f"{first['words']} ({first['section']})"
        rows.append([str(first["sentence"]), words, *cells, decided(first)])
    head = ["", "sentence", *STUDIES.values(), "what decides in `paper` (paper's standard error)"]
    return table(head, rows)


def decided(row: dict[str, Any]) -> str:
    """Word the finding that decides a sentence."""
    one, other = row["decisive"], row["with_everything"]
    if one is None:
        return ""
    unit = one["unit"]
    text = f"{one['label']}: {amount(one['mean'], unit)}".replace("|", r"\|")
    if other is not None:
        text += f" (with everything {amount(other['mean'], unit)})"
    return f"{text}; ± {amount(one['papers_error'], unit)}"


def table_ii() -> str:
    """Lay Table II beside the studies: mean and standard deviation of the landmarks."""
    rows = []
    for i, printed in enumerate(TABLE_II):
        beam = f"fused {printed.beamwidth:.0f}°" if printed.beamwidth else "passive"
        for kind, title in (("full", "placed"), ("total", "seen")):
            mark = DAGGER if (printed.filter, kind, printed.beamwidth) in FITTED else ""
            mean, sigma = getattr(printed, kind)
            cells = []
            for name in STUDIES:
                ours, spread = summary(name)["table_ii"][i][kind]
                near = abs(ours - mean) <= sigma
                cells.append(
                    f"**{ours:.1f} ± {spread:.1f}**" if near else f"{ours:.1f} ± {spread:.1f}"
                )
            row = [FILTERS[printed.filter], beam, title, f"{mean} ± {sigma}{mark}"]
            rows.append([*row, *cells])
    return table(["filter", "case", "landmarks", "paper", *STUDIES.values()], rows)


def consistency() -> str:
    """Give the mean NEES of each filter and strategy, the least and the largest beamwidth's."""
    rows = []
    for name, title in FILTERS.items():
        for strategy in ("active", "fused", "passive"):
            cells = []
            for study in STUDIES:
                found = [
                    row["anees"]
                    for row in summary(study)["consistency"]
                    if (row["filter"], row["strategy"]) == (name, strategy)
                ]
                low, high = f"{min(found):.3g}", f"{max(found):.3g}"
                cells.append(low if low == high else f"{low} to {high}")
            rows.append([title, strategy, *cells])
    return table(["filter", "sensing", *STUDIES.values()], rows)


def gains() -> str:
    """Give the gain of fused over active sensing in position, with its standard error."""
    rows = []
    for group in zip(*(summary(name)["gains"] for name in STUDIES), strict=True):
        cells = []
        for row in group:
            (mean, error), (everything, _) = row["world"], row["none"]
            cells.append(f"{mean:+.2f} ± {error:.2f} ({everything:+.2f})".replace("-", "−"))
        rows.append([f"{FILTERS[group[0]['filter']]}, {group[0]['beamwidth']:.0f}°", *cells])
    return table(["gain in position [m] (everything counted)", *STUDIES.values()], rows)


def readings() -> str:
    """Give of each level of each choice the reading with the least misfit."""
    found = pl.read_csv(Path(__file__).with_name("second_readings.csv")).sort("misfit")
    plan = {name: levels[0] for name, levels in CHOICES.items()}
    rows = [
        _reading("all", "the least", found),
        _reading("", "`paper` as it was", _with(found, plan)),
    ]
    for name, levels in CHOICES.items():
        for level in levels:
            rows.append(_reading(name, level, _with(found, {name: level})))
    columns = ["landmarks", "spread", "lost", "gap", "misfit", "above the least", "features"]
    return table(["choice", "level", *columns], rows)


def _with(found: pl.DataFrame, levels: Mapping[str, str]) -> pl.DataFrame:
    """Keep the readings with some levels."""
    return found.filter(*(pl.col(name) == level for name, level in levels.items()))


def _reading(choice: str, level: str, found: pl.DataFrame) -> list[str]:
    """Lay out the first of some readings."""
    row = found.row(0, named=True)
    above = "in twelve worlds"
    if row["above_best"] is not None:
        above = f"{row['above_best']:.2f} ± {row['above_best_error']:.2f}"
    parts = [f"{row[name]:.2f}" for name in ("landmarks", "spread", "left_out", "gap", "misfit")]
    return [choice.replace("_", " "), level, *parts, above, str(row["features"])]


TABLES: dict[str, Callable[[], str]] = {
    "scoreboard": scoreboard,
    "claims": claims,
    "sentences": sentences,
    "table_ii": table_ii,
    "consistency": consistency,
    "gains": gains,
    "readings": readings,
}

if __name__ == "__main__":
    main()
