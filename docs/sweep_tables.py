"""Print the tables of what sweeps change, in `calls.md`, anew.

pipistrelle study sweeps -o SWEEPS
pipistrelle study sweeps --emitter.call tone --beacon.call tone -o TONES
python docs/sweep_tables.py SWEEPS TONES

Of worlds and beams that both studies have. `python docs/sweep_tables.py WORLDS` listens to so many
of them, and prints how many rows sweeps give, and how many of these overlap.
"""

import sys
import tomllib

import numpy as np
import polars as pl
from association_tables import FILTERS, trials_of

from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.experiments.studies.plan import cases_of, find_plan, plan_of

CENTRES = {"emitter.frequency": 47.5e3, "beacon.frequency": 25e3}
TONES = {"emitter.call": "tone", "beacon.call": "tone"}
CALLS = {"tones": TONES, "tones amid the bands": TONES | CENTRES, "sweeps": {}}
LABELS = {"known": "", "marginal": ", no labels"}


def overlapping(rows, duration, speed):
    """Return a mask of the rows whose sound lasts while that of another of the same call does."""
    own = rows.caller == 0
    late = np.where(own, 2.0 * rows.range, rows.excess_path) / speed
    near = np.abs(late[:, np.newaxis] - late) < duration
    near &= rows.caller[:, np.newaxis] == rows.caller
    return near.sum(axis=1) > 1


def print_rows(worlds):
    """Print rows, overlaps and false rows of a frame, as the wider calls of the plan give them."""
    table = tomllib.loads(find_plan("sweeps").read_text(encoding="utf-8"))
    print("\n| measurements per frame | own call | beacon's | landmarks | overlapping | false |")
    print("|---|--:|--:|--:|--:|--:|")
    for name, given in CALLS.items():
        plan = plan_of(table | {"config": table["config"] | given, "grid": {"beamwidth": [33]}})
        config = cases_of(plan)[0].config
        own, others, seen, near, false, frames = 0, 0, 0, 0, 0, 0
        for world in range(worlds):
            scenario = world_of(config, world)
            (heard,) = listen(scenario, config, [config.emitter.radius], iteration=world)
            seen += len(set().union(*(frame.rows.landmark.tolist() for frame in heard)) - {0})
            for frame in heard:
                rows = frame.rows
                own, others = own + sum(rows.caller == 0), others + sum(rows.caller > 0)
                speed = config.medium.sound_speed
                near += overlapping(rows, config.emitter.call_duration, speed).sum()
                false += frame.clutter
            frames += len(heard)
        cells = own / frames, others / frames, seen / worlds, near / (own + others), false / frames
        print(f"| {name} | {cells[0]:.2f} | {cells[1]:.2f} | {cells[2]:.1f} | {cells[3]:.1%} | "
              f"{cells[4]:.2f} |")  # fmt: skip


def chosen(trials, way, beam, name, method):
    """Return the trials of one cell, by world."""
    cell = trials.filter(
        (pl.col("strategy") == way)
        & (pl.col("filter") == name)
        & (pl.col("association.method") == method)
    )
    if beam is not None:
        cell = cell.filter((pl.col("beamwidth_deg") - beam).abs() < 1.0)
    return cell.sort("iteration")


def position(cell):
    """Return the position error: root of the mean square [m], and aligned, its mean [mm]."""
    raw = np.sqrt(np.mean(cell["position_rmse_m"].to_numpy() ** 2))
    return f"{raw:.2f} ({1e3 * cell['position_rmse_aligned_m'].mean():.0f})"


def landmarks(cell):
    """Return the landmarks placed, and the aligned error of the map [mm]."""
    mapped = 1e3 * cell["map_rmse_aligned_m"].mean()
    return f"{cell['landmarks_full'].mean():.1f} ({mapped:.0f})"


def associated(cell):
    """Return the share of rows that is right; landmarks missed, false, twice."""
    counts = [cell[f"landmarks_{what}"].mean() for what in ("missed", "false", "twice")]
    return f"{cell['associated_right'].mean():.3f}; {', '.join(f'{one:.1f}' for one in counts)}"


def print_table(studies, title, cell, methods=tuple(LABELS)):
    """Print a table of both studies, all filters, with labels and without."""
    beams = studies["sweeps"]["beamwidth_deg"].drop_nulls().round().unique().sort(descending=True)
    columns = [(way, int(beam)) for way in ("active", "fused") for beam in beams] + [
        ("passive", None)
    ]
    heads = [f"{way} {beam}°" if beam else way for way, beam in columns]
    print(f"\n| {title} | {' | '.join(heads)} |")
    print("|---|" + "--:|" * len(columns))
    for name, words in FILTERS.items():
        for method in methods:
            for call, trials in studies.items():
                cells = [cell(chosen(trials, *column, name, method)) for column in columns]
                print(f"| {words}{LABELS[method]}, {call} | {' | '.join(cells)} |")


def print_gains(studies, worlds, beam=33):
    """Print the aligned error of fused relative to active sensing, and the trials that diverge."""
    print(
        f"\n| at {beam}° | fused / active, aligned | largest, fused [mm] | diverged, of {worlds} |"
    )
    print("|---|--:|--:|--:|")
    for name, words in FILTERS.items():
        for method in LABELS:
            for call, trials in studies.items():
                active, fused = (
                    chosen(trials, way, beam, name, method) for way in ("active", "fused")
                )
                error = fused["position_rmse_aligned_m"].to_numpy()
                off = np.log(error / active["position_rmse_aligned_m"].to_numpy())
                print(
                    f"| {words}{LABELS[method]}, {call} | {np.exp(off.mean()):.2f} ± "
                    f"{np.exp(off.mean()) * off.std() / off.size**0.5:.2f} | "
                    f"{1e3 * error.max():.0f} | {fused['diverged'].sum()} |"
                )


def main(*given):
    """Print all tables."""
    if len(given) == 1:
        print_rows(int(given[0]))
        return
    trials = [trials_of([one]) for one in given]
    both = set.intersection(*({*one["iteration"]} for one in trials))
    sweeps, tones = (one.filter(pl.col("iteration").is_in(list(both))) for one in trials)
    studies = {"tones": tones, "sweeps": sweeps}
    print("worlds:", len(both))
    print_table(studies, "position [m] (aligned [mm])", position)
    print_table(studies, "landmarks (map, aligned [mm])", landmarks)
    print_table(studies, "rows right; missed, false, twice", associated, ("marginal",))
    print_gains(studies, len(both))
    print("\nCPU of a world's trials [s]:")
    for call, one in studies.items():
        print(f"  {call} {one['cpu_s'].sum() / len(both):.1f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
