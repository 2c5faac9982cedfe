"""A planar set of ranges of libRSF as a log, and the error of its solution.

    python examples/adapters/librsf.py log FILE LOG
    pipistrelle slam LOG -o RESULT
    python examples/adapters/librsf.py score FILE RESULT

FILE ends in ``_Input.txt`` and lies beside its truth, as in the folders of
https://github.com/TUC-ProAut/libRSF/tree/master/datasets:

- ``Indoor_UWB``: the Labyrinth, a small robot among walls and four ultra-wideband modules, 30 s;
- ``Ranging_Simulation``: M3500 and W3500, two simulated drives among eight modules, with errors of
  ranges that are skewed, multimodal or have heavy tails.

Noise is as the authors state it in each file. In the Labyrinth they give the speeds of the left and
the right wheel, in this order, and half the distance between the wheels: so their code reads them
(``OdometryFactor2DDifferential.h``), and so they fit the truth.
"""

import sys
from pathlib import Path

import numpy as np
from scoring import print_score

from pipistrelle.detection.logs.folder import write_log
from pipistrelle.detection.logs.recording import Log
from pipistrelle.detection.scans import make_scan
from pipistrelle.experiments.drives import Truth
from pipistrelle.experiments.runs.truth_files import write_truth

Rows = dict[str, np.ndarray]


def log(file: Path, folder: Path) -> None:
    """Write the log, with its truth beside it if that has headings."""
    given, true = rows(file), rows(truth_beside(file))
    seen = given["range2"][given["range2"][:, 1] > 0.0]  # heavy tails go below zero
    wheels = "odom2diff" in given
    driven = given["odom2diff" if wheels else "odom2"]
    time = true["point2"][:, 0]
    step = np.diff(time)
    rate = driven[np.isin(driven[:, 0], time[1:]), 1:]  # a row is the motion up to its time
    if wheels:
        half, variance = rate[0, 3], rate[0, 4:]
        speed, turn = rate[:, :2].mean(axis=1), np.diff(rate[:, :2], axis=1)[:, 0] / (2.0 * half)
        spread = np.sqrt(variance[:2].sum()) / np.array([2.0, 2.0 * half])
        motion = {"motion": "unicycle", "controls": np.column_stack((speed, turn))}
    else:
        spread = np.sqrt(rate[0, 3:6])
        motion = {"motion": "poses", "controls": rate[:, :3] * step[:, None]}
    heading = true["angle"][:, 1] if "angle" in true else np.zeros(time.size)
    path = np.column_stack((true["point2"][:, 1:3], heading))
    scans = [
        make_scan(float(at), now[:, 5].astype(int), np.full(len(now), np.nan), range=now[:, 1])
        for at in time
        if len(now := seen[seen[:, 0] == at])
    ]
    made = Log(
        name=file.stem.removesuffix("_Input").lower(),
        time=time,
        dt=step,
        scans=tuple(scans),
        control_std=tuple(spread.tolist()),
        initial_pose=tuple(path[0].tolist()),
        initial_pose_std=(0.0, 0.0, 0.0),
        range_std=float(np.sqrt(seen[0, 2])),
        bearing_std=1.0,
        range_bounds=(0.1, float(1.5 * np.quantile(seen[:, 1], 0.9))),
        ignored_rows={},
        **motion,
    )
    write_log(folder, made)
    if "angle" in true:
        places = modules(seen)
        posts = np.array([*places]), np.array([*places.values()])
        write_truth(folder, Truth(time=time, path=path, landmarks=posts))


def rows(file: Path) -> Rows:
    """Return the rows of each kind in a file of libRSF, as numbers."""
    kinds: dict[str, list[list[float]]] = {}
    for line in file.read_text().splitlines():
        if line.strip():
            kind, *fields = line.split()
            kinds.setdefault(kind, []).append([float(field) for field in fields])
    return {kind: np.array(fields) for kind, fields in kinds.items()}


def truth_beside(file: Path) -> Path:
    """Return the file of the truth: of the Labyrinth, M3500 or W3500."""
    named = [file.name.replace("_Input", "_GT"), file.name.split("_")[0] + "_GT.txt"]
    return next(path for name in named if (path := file.with_name(name)).exists())


def modules(seen: np.ndarray) -> dict[int, np.ndarray]:
    """Return the true position of each module by its number."""
    return {int(row[5]): row[3:5] for row in seen}


def score(file: Path, result: Path) -> None:
    """Print the errors of a result."""
    true = rows(truth_beside(file))["point2"]
    print_score(result, true[:, 0], true[:, 1:3], modules(rows(file)["range2"]))


if __name__ == "__main__":
    if len(sys.argv) != 4 or sys.argv[1] not in ("log", "score"):
        sys.exit(__doc__)
    {"log": log, "score": score}[sys.argv[1]](*map(Path, sys.argv[2:]))
