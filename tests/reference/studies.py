"""A study that takes a second, its results without their timings, and tasks that are killed."""

import os
import signal
from pathlib import Path

import polars as pl

from pipistrelle.experiments.studies.plan import read_plan
from pipistrelle.experiments.studies.study import load_study
from pipistrelle.experiments.studies.world import TABLES

SMALL = """\
format = 1
name = "small"
iterations = 3
[config.scenario]
steps = 40
landmarks = 12
[grid]
"emitter.radius" = [0.0025, 0.025]
"""
"""Three worlds of ten frames, ten cases in each."""
TINY = """\
format = 1
name = "tiny"
iterations = 1
strategies = ["fused"]
filters = ["ekf"]
[config.scenario]
steps = 8
landmarks = 5
"""
"""A world of two frames with a single case."""
TIMINGS = ("wall_s", "cpu_s")


def plan_of(folder, text=SMALL, **given):
    """Read a plan from its text."""
    path = Path(folder) / "small.toml"
    path.write_text(text)
    return read_plan(path, **given)


def results(folder):
    """Return all results of a study, sorted, without run times."""
    study = load_study(Path(folder))
    found = {name: getattr(study, name).collect() for name in TABLES}
    found["trials"] = found["trials"].drop(TIMINGS)
    return {
        name: table.sort([*table.columns[:2], *table.columns[2:4]]) for name, table in found.items()
    }


def assert_same(one, other):
    """Assert that all values of two studies are equal, with NaN equal to NaN."""
    for name in TABLES:
        assert one[name].schema == other[name].schema
        assert len(one[name]) > 0
        assert one[name].equals(other[name], null_equal=True), name


def contents(folder):
    """Return the bytes of every file in a folder, by relative path."""
    return {p.relative_to(folder): p.read_bytes() for p in Path(folder).rglob("*") if p.is_file()}


def leftovers(folder):
    """Return the temporary files that were never renamed."""
    return sorted(Path(folder).rglob("*.partial"))


def fatal(worlds, iteration):
    """Compute a world, or kill the process if the world is in `worlds`."""
    if iteration in worlds:
        os.kill(os.getpid(), signal.SIGKILL)
    return [(f"world {iteration}", None)]


def lost(iteration):
    """Return the failed trial of a world."""
    return [(f"world {iteration}", "lost")]


def as_rows(table: pl.DataFrame):
    """Return a table's rows as dictionaries."""
    return table.rows(named=True)
