"""A robot's log of the UTIAS multi-robot cooperative localization and mapping data sets (MRCLAM).

Leung, Halpern, Barfoot and Liu, "The UTIAS multi-robot cooperative localization and mapping
dataset", IJRR 30(8), 2011: five robots with a camera among fifteen barcoded posts. A folder is
read as it is; its noise, which the sets do not state, is chosen here. The spread of the start is
the paper's (Table I). Ranges lie between 0.9 m and 8.6 m; the bounds for rays are the paper's too.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Int

from pipistrelle.detection.logs.recording import Log, assemble
from pipistrelle.detection.logs.text_tables import (
    Table,
    check_unique,
    place_of,
    read_table,
    rows_kept,
)
from pipistrelle.refusals import refusal

ROBOTS = range(1, 6)
LANDMARKS = range(6, 21)

_UNKNOWN_MAX = 0.05


def read_mrclam(folder: Path, robot: int, span: tuple[float, float] = (-math.inf, math.inf)) -> Log:
    """Read what one robot drove and saw; the labels of landmarks are their subjects, 6 to 20.

    Odometry is merged into steps of 0.1 s. Rows that show another robot (subjects 1 to 5) or a
    barcode that no subject wears are dropped and counted.

    `span` [s]: the log is cut to it: where the truth begins and ends. Returns it
    starts at the origin: these files do not say where the robot stood.

    Format and robots: Leung et al., IJRR 30(8), 2011.
    """
    columns = ("time", "velocity", "angular_rate")
    odometry = read_table(folder / f"Robot{robot}_Odometry.dat", columns, separator=None)
    measurements, ignored = _seen_landmarks(folder, robot)
    return assemble(
        odometry,
        measurements,
        step=0.1,
        span=span,
        ignored_rows=ignored,
        name=f"{folder.resolve().name}_robot{robot}",
        motion="unicycle",
        control_std=(0.10, 0.15),
        noise_at_rest=False,
        initial_pose=(0.0, 0.0, 0.0),
        initial_pose_std=(0.05, 0.05, 0.0436),
        range_std=0.2,
        bearing_std=0.06,
        range_bounds=(0.5, 20.0),
    )


def _seen_landmarks(folder: Path, robot: int) -> tuple[Table, dict[str, int]]:
    """Return the measurements of landmarks, labelled by their subjects, and the rows dropped."""
    columns = ("time", "barcode", "range", "bearing")
    table = read_table(folder / f"Robot{robot}_Measurement.dat", columns, separator=None)
    subject = _subjects(folder / "Barcodes.dat", table.column["barcode"])
    landmark, seen = np.isin(subject, LANDMARKS), np.isin(subject, ROBOTS)
    unknown = ~(landmark | seen)
    if unknown.mean() > _UNKNOWN_MAX:
        first = int(np.argmax(unknown))
        raise refusal(
            place_of(table, first),
            f"barcode {table.column['barcode'][first]}, and {unknown.sum()} unknown barcodes "
            f"in {len(unknown)} rows",
            f"at most {_UNKNOWN_MAX:.0%} that Barcodes.dat does not know",
            "use the Barcodes.dat of this set",
        )
    ignored = {"unknown_barcode": int(unknown.sum()), "robot_seen": int(seen.sum())}
    named = replace(table, column=table.column | {"landmark": subject})
    return rows_kept(named, landmark), ignored


def _subjects(path: Path, barcode: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Return the subjects that wear the barcodes, 0 for an unknown one."""
    table = read_table(path, ("subject", "barcode"), separator=None)
    check_unique(table, "barcode")
    subject = dict(zip(table.column["barcode"].tolist(), table.column["subject"], strict=True))
    return np.array([subject.get(worn, 0) for worn in barcode.tolist()])
