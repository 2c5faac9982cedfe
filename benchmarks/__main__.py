"""Run all benchmarks and compare them with their targets: `./dev bench`."""

import sys
from datetime import UTC, datetime
from math import inf
from pathlib import Path
from statistics import median
from typing import Annotated, Literal

from cyclopts import App, Parameter
from cyclopts.types import ExistingFile
from cyclopts.validators import Number

from benchmarks import callers, peer, programs, robot, stages, study
from benchmarks.machine import ROOT, facts
from benchmarks.promises import PROMISES
from benchmarks.table import Row, grown, read, rows_of, show, write

LATEST, HISTORY = ROOT / "benchmarks" / "latest.json", ROOT / "benchmarks" / "history"
WORSE = 1.25
"""Factor of growth above which a row is reported."""

Part = Literal["stages", "study", "programs", "peer", "callers", "robot", "growth"]
app = App(
    name="./dev bench",
    help="Time what was promised; targets, ratios, floors.",
    version_flags=(),
    default_parameter=Parameter(negative=()),
)


@app.default
def bench(
    *,
    only: Annotated[tuple[Part, ...], Parameter(consume_multiple=True)] = (),
    k: Annotated[str | None, Parameter(name="-k")] = None,
    quick: bool = False,
    worlds: Annotated[int, Parameter(validator=Number(gt=2))] = 8,
    scaling: bool = False,
    save: bool = False,
    against: ExistingFile | None = None,
) -> None:
    """Measure, print the table, write benchmarks/latest.json.

    Parameters
    ----------
    only
        Measure only these parts, and write nothing.
    k
        Only time the stages whose names match this pytest expression.
    quick
        Run three worlds, and each program once, to test the benchmarks; write nothing.
    worlds
        Number of worlds of the study, at least 3.
    scaling
        Also measure how cost grows with size.
    save
        Keep a dated copy under benchmarks/history.
    against
        File to compare with; by default the newest in benchmarks/history.
    """
    if k is not None:
        show(list(stages.rows(stages.timed_stages("-k", k))))
        return
    path = against or newest(HISTORY)
    before = None if path is None else rows_of(read(path))
    machine = facts()
    rows, yardsticks = measured(only, 3 if quick else worlds, 1 if quick else 5, scaling)
    machine["calibration_ms"] = round(1e3 * median(yardsticks), 4) if yardsticks else None
    rows.sort(key=lambda row: list(PROMISES).index(row.name))
    print(", ".join(f"{key} {value}" for key, value in machine.items()))
    show(rows)
    if path is not None and before is not None:
        compare(rows, before, path.name)
    if only or quick:
        print("Nothing written: this was not the whole bench.")
        return
    kept = [HISTORY / f"{datetime.now(UTC):%Y-%m-%d_%H%M}.json"] if save else []
    for path in (LATEST, *kept):
        write(path, machine, rows)
        print(path.relative_to(ROOT))


def measured(
    only: tuple[Part, ...], worlds: int, rounds: int, scaling: bool
) -> tuple[list[Row], list[float]]:
    """Measure the selected parts in sequence; return their rows and calibration times [s]."""
    parts = {
        "stages": stages.measure,
        "study": lambda: study.measure(worlds),
        "programs": lambda: programs.measure(rounds),
        "peer": lambda: peer.measure(rounds),
        "callers": callers.measure,
        "robot": robot.measure,
    }
    if scaling or "growth" in only:
        from benchmarks import growth

        parts["growth"] = growth.measure
    rows, yardsticks = [], []
    for name, part in parts.items():
        if not only or name in only:
            print(f"Measuring {name} ...", file=sys.stderr, flush=True)
            found, took = part()
            rows += found
            yardsticks += took
    return rows, yardsticks


def newest(folder: Path) -> Path | None:
    """Return the newest JSON file of a folder, if any."""
    return max(folder.glob("*.json"), default=None)


def compare(rows: list[Row], before: list[Row], name: str) -> None:
    """Print the rows that became worse than in an earlier run."""
    worse = grown(rows, before, WORSE)
    for row, factor in worse:
        told = "kept its promise" if factor == inf else f"was {factor:.2f} times better"
        print(f"{row}: {told} in {name}")
    if not worse:
        print(f"No row is worse than {WORSE} times what it was in {name}.")


if __name__ == "__main__":
    app()
