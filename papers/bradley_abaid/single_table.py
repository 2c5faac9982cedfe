"""The table of `single_readings`: a row per reading, from the trials of all worlds."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl

from pipistrelle.report.sentences import EXCLUDED

BASE = "base"
SAME = "own filter, nothing changed"
NEAR = {"passive": ("passive", 0)} | {f"fused {b}": ("fused", b) for b in (180, 33, 11)}
"""Table II's cases."""


def table_of(trials: pl.DataFrame, order: Sequence[str]) -> pl.DataFrame:
    """Sum up all readings that were run, in an order, then the others by name."""
    found = trials["reading"].unique().to_list()
    names = [*order, *sorted(name for name in found if name not in order)]
    rows = [row_of(name, trials) for name in dict.fromkeys(names) if name in found]
    return pl.DataFrame(rows, infer_schema_length=None)


def row_of(reading: str, trials: pl.DataFrame) -> dict[str, Any]:
    """Sum a reading up: its own trials, and the base's where it changes nothing."""
    row: dict[str, Any] = {"reading": reading, "worlds": 0}
    for slam in EXCLUDED:
        of_filter = trials.filter(pl.col("filter") == slam)
        worlds = of_filter.filter(pl.col("reading") == reading)["world"].unique()
        same = of_filter.filter(pl.col("world").is_in(worlds.implode()))
        if mine := _cases(reading, same):
            base = _cases(BASE, same)
            row["worlds"] = min(row["worlds"] or len(worlds), len(worlds))
            found = _summary(base | mine, base)
            row |= {f"{key}_{slam}": value for key, value in found.items()}
    return row


Cases = dict[tuple[str, int], pl.DataFrame]


def _cases(reading: str, trials: pl.DataFrame) -> Cases:
    """Return a filter's trials of a reading by strategy and beam, sorted by world."""
    chosen = trials.filter(pl.col("reading") == reading)
    return {
        (str(way), int(beam)): part.sort("world")
        for (way, beam), part in chosen.group_by("strategy", "beam")
    }


def _summary(mine: Cases, base: Cases) -> dict[str, float]:
    """Return the columns of a filter."""
    lost = {
        rule: np.any([part[column].to_numpy() for part in mine.values()], axis=0)
        for rule, column in (("union", "diverged"), ("average", "average"))
    }
    kept = ~lost["average"] if not lost["average"].all() else np.ones(len(lost["average"]), bool)
    found: dict[str, float] = {rule: int(worlds.sum()) for rule, worlds in lost.items()}
    for name, case in NEAR.items():
        for score_of in ("full", "total"):
            values = mine[case][score_of].to_numpy()[kept]
            found[f"{score_of}_{name}"] = float(values.mean())
            found[f"{score_of}_{name}_sigma"] = float(values.std(ddof=1)) if kept.sum() > 1 else 0.0
    for title, column in (("gain", "position"), ("turn", "heading")):
        for beam in (180, 33, 11):
            gain, old = _gain(mine, column, beam), _gain(base, column, beam)
            found |= _mean(f"{title}_{beam}", gain[kept])
            found |= _mean(f"d_{title}_{beam}", gain - old)
    for way in ("active", "fused", "passive"):
        cases = [case for case in mine if case[0] == way]
        series = [np.array(mine[case]["frames"].to_list())[kept].mean(axis=0) for case in cases]
        found[f"anees_{way}"] = float(np.max(series))
        level, old = (_log_nees(part, cases) for part in (mine, base))
        found[f"nees_{way}"] = float(10 ** level.mean())
        found |= _mean(f"d_nees_{way}", level - old)
        error = np.mean([mine[case]["position"].to_numpy()[kept] for case in cases], axis=0)
        found[f"position_{way}"] = float(error.mean())
    errors = {case: float(part["position"].to_numpy()[kept].mean()) for case, part in mine.items()}
    beams = [beam for way, beam in mine if way == "fused"]
    found["never"] = sum(errors["fused", beam] >= errors["active", beam] for beam in beams)
    found["worst"] = sum(errors["passive", 0] > error for error in errors.values())
    full = mine["passive", 0]["full"].to_numpy()
    return found | _mean("d_full_passive", full - base["passive", 0]["full"].to_numpy())


def _gain(cases: Cases, column: str, beam: int) -> np.ndarray:
    """Return the error of active sensing less that of fused, by world."""
    active, fused = (cases[way, beam][column].to_numpy() for way in ("active", "fused"))
    return active - fused


def _log_nees(cases: Cases, of: list[tuple[str, int]]) -> np.ndarray:
    """Return log10 of the NEES averaged over time and beams, by world."""
    mean = np.mean([cases[case]["nees"].to_numpy() for case in of], axis=0)
    return np.log10(np.minimum(mean, 1e12))


def _mean(name: str, values: np.ndarray) -> dict[str, float]:
    """Return a mean over worlds and its standard error."""
    error = float(values.std(ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return {name: float(values.mean()), f"{name}_se": error}
