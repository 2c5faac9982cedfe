"""Print the table of gates in `estimators.md` anew: `.venv/bin/python docs/gates.py [LONG_STEPS]`.

It solves drives that are made up here and, where `PIPISTRELLE_DATA` holds them, those of MRCLAM,
by each estimator, with the gate 0.999 and without.
"""

import os
import sys
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import pipistrelle

FILTERS = ("ekf", "fastslam", "iekf", "smoother")
HUBER = ("ekf", "iekf", "smoother")
GATES = (0.999, 1.0)
SCORES = ("position_rmse_aligned_m", "map_rmse_aligned_m")


def made_up(place, seed, steps, share):
    """Write the log of a drive by sound; of a share of its bearings each is off by 0.5 rad."""
    from pipistrelle.verbs.command_line import obey

    words = ["run", "--settings", "paper", "--strategy", "fused", "--quiet", "--seed", str(seed)]
    words += [
        "-o",
        str(place / "run"),
        "--scenario.steps",
        str(steps),
        "--filter.noise",
        "measured",
    ]
    log = place / "log"
    assert obey([*words, "--save-log", str(log)]) == 0
    settings = (log / "log.toml").read_text().splitlines()
    (log / "log.toml").write_text("\n".join(r for r in settings if not r.startswith("gate")))
    head, *rows = (log / "measurements.csv").read_text().splitlines()
    column, rng = head.split(",").index("bearing"), np.random.default_rng(seed)
    for i in np.flatnonzero(rng.random(len(rows)) < share):
        fields = rows[i].split(",")
        fields[column] = repr(float(fields[column]) + 0.5 * float(rng.choice([-1.0, 1.0])))
        rows[i] = ",".join(fields)
    (log / "measurements.csv").write_text("\n".join([head, *rows, ""]))
    return log


def errors(log, robot, name, robust, gate):
    """Return aligned errors of track and map [m], and the share that the gate rejects."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        asked = {"filters": name, "gate": gate, "filter__robust": robust}
        done = pipistrelle.slam(log, robot=robot, **asked)
    row, heard = done.summary.to_dicts()[0], done.measurements.height
    return [*(row[score] for score in SCORES), row["gated"] / heard]


def cells(logs):
    """Return two cells for each estimator: means over the logs, with the gate and without."""
    rows = {}
    for name in FILTERS:
        for robust in ("none", "huber") if name in HUBER else ("none",):
            row = rows.setdefault(name + ", Huber" * (robust == "huber"), [])
            for gate in GATES:
                found = np.array([errors(*log, name, robust, gate) for log in logs])
                track, mapped, share = found.mean(axis=0)
                row.append(f"{track:.3f} / {mapped:.3f}" + f" ({share:.1%})" * (gate < 1.0))
    return rows


def main(long=8_000):
    """Print the table."""
    columns = {}
    if data := os.environ.get("PIPISTRELLE_DATA"):
        folder = Path(data) / "mrclam" / "MRCLAM_Dataset6"
        columns["MRCLAM 6"] = cells([(folder, robot) for robot in range(1, 6)])
    for title, seeds, steps, share in (
        ("375 poses", range(1, 5), 1500, 0.0),
        ("2 % wrong", range(1, 5), 1500, 0.02),
        (f"{long // 4} poses", (1,), long, 0.0),
    ):
        with TemporaryDirectory() as place:
            rooms = {seed: Path(place) / str(seed) for seed in seeds}
            columns[title] = cells([(made_up(rooms[s], s, steps, share), None) for s in seeds])
    print("| | " + " | ".join(f"{title}: gate | none" for title in columns) + " |")
    print("|---" + "|--:" * 2 * len(columns) + "|")
    for name in next(iter(columns.values())):
        print(
            f"| {name} | " + " | ".join(c for rows in columns.values() for c in rows[name]) + " |"
        )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
