"""A study that takes a second, its results without their timings, and tasks that do not survive."""

import os
import signal
from pathlib import Path

import polars as pl

from pipistrelle.experiments.studies.plan import read_plan
from pipistrelle.experiments.studies.store import load_study
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
"""One world of two frames, one case in it."""
TIMINGS = ("wall_s", "cpu_s")


def plan_of(folder, text=SMALL, **given):
    """Read a plan from its text."""
    path = Path(folder) / "small.toml"
    path.write_text(text)
    return read_plan(path, **given)


def results(folder):
    """All that a study found, but for the time that it took, in one order."""
    study = load_study(Path(folder))
    found = {name: getattr(study, name).collect() for name in TABLES}
    found["trials"] = found["trials"].drop(TIMINGS)
    return {
        name: table.sort([*table.columns[:2], *table.columns[2:4]]) for name, table in found.items()
    }


def assert_same(one, other):
    """Every value of two studies is the same; not a number equals itself."""
    for name in TABLES:
        assert one[name].schema == other[name].schema
        assert len(one[name]) > 0
        assert one[name].equals(other[name], null_equal=True), name


def contents(folder):
    """Every file of a folder and what is in it."""
    return {p.relative_to(folder): p.read_bytes() for p in Path(folder).rglob("*") if p.is_file()}


def leftovers(folder):
    """Files that were never put in place."""
    return sorted(Path(folder).rglob("*.partial"))


def fatal(worlds, iteration):
    """Do a world's work, unless it is one that takes its process with it."""
    if iteration in worlds:
        os.kill(os.getpid(), signal.SIGKILL)
    return [(f"world {iteration}", None)]


def lost(iteration):
    """Record a world that cannot be had."""
    return [(f"world {iteration}", "lost")]


def as_rows(table: pl.DataFrame):
    """A table's rows as dictionaries."""
    return table.rows(named=True)
