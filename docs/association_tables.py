"""Print the tables of what it costs that nobody tells who is who, in `association.md`, anew.

pipistrelle study association -o STUDY
python docs/association_tables.py STUDY [STUDY ...]

Of several folders, each of some methods, the trials are taken together; a method is held against
labels in the worlds that it has.
"""

import sys
import tomllib
from pathlib import Path

import numpy as np
import polars as pl

from pipistrelle.experiments.studies.plan import find_plan, plan_of

BEAMS = {"180°": 0.0025, "33°": 0.0088, "11°": 0.025}
COLUMNS = [(f"{strategy} {beam}", strategy, radius)
           for strategy in ("active", "fused") for beam, radius in BEAMS.items()]  # fmt: skip
COLUMNS += [("passive", "passive", min(BEAMS.values()))]
FILTERS = {"iekf": "invariant EKF", "smoother": "smoother, at the end"}
METHODS = ("marginal", "nearest")
LOST_M, LOST_TIMES = 0.25, 5.0
"""A world is lost if its aligned error is above this and so many times that with labels."""


def planned(grid, **config):
    """Return the study `association` with excess paths, another grid and settings more."""
    table = tomllib.loads(find_plan("association").read_text(encoding="utf-8"))
    table["config"] |= {"listening.excess_paths": True, **config}
    return table | {"filters": ["iekf"], "grid": grid}


def settings_of(name, **config):
    """Return its settings for one filter."""
    table = planned({})
    table["config"] |= table.pop("own").get(name, {}) | config
    return plan_of(table | {"filters": [name]}).config


def trials_of(studies):
    """Return the trials of studies, one row each."""
    return pl.concat([pl.read_parquet(Path(one) / "trials" / "*.parquet") for one in studies])


def chosen(trials, strategy, radius, name, method, timing):
    """Return the trials of one cell, by world."""
    cell = trials.filter(
        (pl.col("strategy") == strategy)
        & (pl.col("filter") == name)
        & (pl.col("association.method") == method)
        & (pl.col("listening.excess_paths").cast(pl.Float64) == timing)
    )
    if strategy != "passive":
        cell = cell.filter(pl.col("emitter.radius") == radius)
    return cell.sort("iteration")


def error_cell(known, unlabelled):
    """Return the ratios of position errors over those with labels, aligned in brackets."""
    raw = [np.sqrt(np.mean(one["position_rmse_m"].to_numpy() ** 2)) for one in (unlabelled, known)]
    aligned = [one["position_rmse_aligned_m"].mean() for one in (unlabelled, known)]
    return f"{raw[0] / raw[1]:.2f} ({aligned[0] / aligned[1]:.2f})"


def worlds_lost(labelled, error):
    """Return how many worlds are lost, of aligned errors with labels and without."""
    return np.count_nonzero((error > LOST_M) & (error > LOST_TIMES * labelled))


def score_cell(known, unlabelled):
    """Return the share of rows that is right; landmarks missed, false, twice; and worlds lost."""
    error, labelled = (one["position_rmse_aligned_m"].to_numpy() for one in (unlabelled, known))
    lost = worlds_lost(labelled, error)
    share = unlabelled["associated_right"].drop_nulls().mean()
    counts = [unlabelled[f"landmarks_{what}"].mean() for what in ("missed", "false", "twice")]
    right = "-" if share is None else f"{share:.3f}"
    return f"{right}; {', '.join(f'{count:.1f}' for count in counts)}; {lost}"


def print_table(trials, cell):
    """Print a table of all methods that are there, and filters."""
    there = {*trials["association.method"].unique()}
    timings = trials["listening.excess_paths"].cast(pl.Float64).unique().sort(descending=True)
    print("\n| | " + " | ".join(name for name, *_ in COLUMNS) + " |")
    print("|---|" + "--:|" * len(COLUMNS))
    for timing in timings:
        for name, words in FILTERS.items():
            for method in (one for one in METHODS if one in there):
                cells = []
                for _, strategy, radius in COLUMNS:
                    same = strategy == "active" and not timing
                    known, found = (chosen(trials, strategy, radius, name, which, timing)
                                    for which in ("known", method))  # fmt: skip
                    known = known.filter(pl.col("iteration").is_in(found["iteration"].to_list()))
                    told = "-" if found.is_empty() else cell(known, found)
                    cells.append("as above" if same else told)
                first = "" if timing else "bearings only, "
                print(f"| {first}{words}, `{method}` | " + " | ".join(cells) + " |")


def main(*studies):
    """Print both tables, and what a trial takes."""
    trials = trials_of(studies)
    worlds = trials.group_by("association.method").agg(pl.col("iteration").n_unique())
    print("worlds:", dict(sorted(worlds.iter_rows())))
    print_table(trials, error_cell)
    print_table(trials, score_cell)
    with_timing = trials.filter(pl.col("listening.excess_paths").cast(pl.Float64) == 1.0)
    cpu = with_timing.group_by("filter", "association.method").agg(pl.col("cpu_s").median())
    print("\nCPU of a trial, median [s]:")
    for name, method, seconds in cpu.sort("filter", "association.method").iter_rows():
        print(f"  {name} {method} {seconds:.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
