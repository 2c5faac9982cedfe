"""Log folders: read and write this project's format, and read UTIAS MRCLAM data sets.

A log folder is plain text: ``log.toml``, ``odometry.csv`` and ``measurements.csv``; the truth is
never read here. Errors name the line or key. `recording` makes steps and scans of the rows.

MRCLAM (Leung, Halpern, Barfoot and Liu, "The UTIAS multi-robot cooperative localization and mapping
dataset", IJRR 30(8), 2011): five robots with a camera among fifteen barcoded posts, at ranges from
0.9 m to 8.6 m. The sets do not state their noise, so it is chosen here; the standard deviation of
the initial pose (Table I) and the range bounds of rays are the paper's.
"""

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipistrelle.config import STEEPEST
from pipistrelle.detection.logs.poses import MOTION_COVARIANCE, POSE, poses_along
from pipistrelle.detection.logs.recording import CALLER, MEASUREMENTS, STATED, Log, assemble
from pipistrelle.detection.logs.vehicle import (
    KINDS,
    NOISY,
    ODOMETRY,
    SHARED,
    read_vehicle,
    vehicle_of,
)
from pipistrelle.detection.scans import UNLABELLED, Scan, columns_of
from pipistrelle.files import LOG, OwnFiles, read_text, shipped_text
from pipistrelle.refusals import refusal
from pipistrelle.text_tables import Table, check_unique, place_of, read_table, rows_kept, table_text

ROBOTS = range(1, 6)
LANDMARKS = range(6, 21)
_UNKNOWN_MAX = 0.05


def read_mrclam(folder: Path, robot: int, span: tuple[float, float] = (-math.inf, math.inf)) -> Log:
    """Read the log of one robot of a MRCLAM set; landmark labels are the subjects 6 to 20.

    Odometry is merged into steps of 0.1 s. Measurements of another robot (subjects 1 to 5) or of a
    barcode without a subject are dropped and counted. The log is cut to `span` [s], the times of
    the truth. The initial pose is the origin, as these files do not contain it.

    Format and robots: Leung et al., IJRR 30(8), 2011.
    """
    columns = ("time", "velocity", "angular_rate")
    odometry = read_table(folder / f"Robot{robot}_Odometry.dat", columns, separator=None)
    columns = ("time", "barcode", "range", "bearing")
    seen = read_table(folder / f"Robot{robot}_Measurement.dat", columns, separator=None)
    barcode = seen.column["barcode"]
    known = read_table(folder / "Barcodes.dat", ("subject", "barcode"), separator=None)
    check_unique(known, "barcode")
    subjects = dict(zip(known.column["barcode"].tolist(), known.column["subject"], strict=True))
    subject = np.array([subjects.get(worn, 0) for worn in barcode.tolist()])
    landmark, robots = np.isin(subject, LANDMARKS), np.isin(subject, ROBOTS)
    unknown = ~(landmark | robots)
    if unknown.mean() > _UNKNOWN_MAX:
        row = int(np.argmax(unknown))
        rows = f"{unknown.sum()} unknown barcodes in {unknown.size} rows"
        expected = f"at most {_UNKNOWN_MAX:.0%} that Barcodes.dat does not know"
        fix = "use the Barcodes.dat of this set"
        raise refusal(place_of(seen, row), f"barcode {barcode[row]}, and {rows}", expected, fix)
    ignored = {"unknown_barcode": int(unknown.sum()), "robot_seen": int(robots.sum())}
    labelled = replace(seen, column=seen.column | {"landmark": subject})
    measurements = rows_kept(labelled, landmark)
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


def read_log(folder: Path) -> Log:
    r"""Read a log folder: ``log.toml``, ``odometry.csv`` and ``measurements.csv``.

    With a ``step``, the rows of odometry are merged into steps of that length (the last may be
    shorter), each with the time-weighted mean of its controls; for poses, with the motion from its
    start to its end. Times are then compared to 1e-6 s, otherwise exactly.

    Raises InputError with the file and the line or key.

    >>> from tempfile import TemporaryDirectory
    >>> settings = '''
    ... format = 1
    ... motion = "unicycle"
    ... initial_pose = [0.0, 0.0, 0.0]
    ... initial_pose_std = [0.05, 0.05, 0.0436]
    ... velocity_std = 0.1
    ... angular_rate_std = 0.15
    ... range_std = 0.2
    ... bearing_std = 0.06
    ... range_bounds = [0.5, 20.0]
    ... step = 0.5
    ... '''
    >>> odometry = "time,velocity,angular_rate\n0,1,0\n0.2,2,0\n0.6,0,0"
    >>> with TemporaryDirectory() as place:
    ...     folder = Path(place)
    ...     _ = (folder / "log.toml").write_text(settings)
    ...     _ = (folder / "odometry.csv").write_text(odometry)
    ...     _ = (folder / "measurements.csv").write_text("time,landmark,bearing,range\n0.3,7,1,")
    ...     log = read_log(folder)
    >>> log.time, log.controls[:, 0].round(12)
    (array([0. , 0.5, 0.6]), array([1.6, 2. ]))
    >>> log.scans[0].time, log.scans[0].landmark, log.scans[0].range
    (0.3, array([7]), array([nan]))
    """
    vehicle = read_vehicle(folder / "log.toml")
    names = [caller.name for caller in vehicle.callers]
    known = names or ["a name that [[callers]] of log.toml have"]
    measured = MEASUREMENTS.read(folder / MEASUREMENTS.file, words={CALLER: known})
    whose = measured.column[CALLER].tolist()
    numbers = [1.0 + names.index(name) if name else math.nan for name in whose]
    measured.column[CALLER] = np.array(numbers)
    odometry = read_odometry(folder, vehicle.motion)
    return assemble(
        odometry,
        measured,
        step=vehicle.step,
        time_offset=vehicle.time_offset,
        name=folder.resolve().name,
        **vehicle.told(),
    )


def read_odometry(folder: Path, motion: str) -> Table:
    """Read the table in ``odometry.csv``, with the columns of a motion model."""
    schema = ODOMETRY[motion]
    odometry = schema.read(folder / schema.file)
    if motion == "ackermann":
        steering = odometry.column["steering"]
        if (wrong := np.abs(steering) > STEEPEST).any():
            row = int(np.argmax(wrong))
            found = f"steering {steering[row].item()!r}"
            expected = f"an angle from -{STEEPEST:g} to {STEEPEST:g} rad"
            raise refusal(place_of(odometry, row), found, expected, "is it in radians?")
    return odometry


def write_log(folder: Path, log: Log) -> None:
    """Write a log folder; `read_log` reads it back exactly, motions of poses up to rounding.

    Steps become rows; poses begin at the origin. Scans that share a step are spread over it in
    their order; empty scans have no row. Standard deviations are columns if any measurement states
    them. An earlier log that this function wrote is replaced and its truth removed
    (`pipistrelle.files`); ``log.toml`` is written last.

    Raises InputError if a file cannot be written, or a file there was not written by this package.

    >>> from tempfile import TemporaryDirectory
    >>> log = Log(
    ...     name="short", time=np.array([0.0, 0.1]), controls=np.array([[1.0, 0.2]]),
    ...     dt=np.array([0.1]), scans=(), motion="unicycle", control_std=(0.1, 0.15),
    ...     initial_pose=(0.0, 0.0, 0.0), initial_pose_std=(0.05, 0.05, 0.04), range_std=0.2,
    ...     bearing_std=0.06, range_bounds=(0.5, 20.0), ignored_rows={},
    ... )
    >>> with TemporaryDirectory() as place:
    ...     write_log(Path(place), log)
    ...     print((Path(place) / "odometry.csv").read_text())
    time,velocity,angular_rate
    0.0,1.0,0.2
    0.1,0.0,0.0
    """
    OwnFiles(folder, LOG).replace(log_files(log))


def log_files(log: Log) -> dict[str, str]:
    """Return the text of each file of a log folder, by file name; ``log.toml`` is last."""
    settings: dict[str, Any] = {"format": 1} | {name: getattr(log, name) for name in SHARED}
    settings["callers"] = [caller.model_dump() for caller in log.callers]
    stds = zip(NOISY[log.motion], log.control_std, strict=True)
    settings |= {f"{name}_std": std for name, std in stds}
    if log.motion in ("bicycle", "ackermann"):
        settings["wheelbase"] = log.wheelbase
    if log.motion == "ackermann":
        settings["speed_offset"] = log.speed_offset
    settings["association"] = dict(log.association)
    model = KINDS[log.motion].model_validate(settings)
    driven = _odometry_columns(log)
    measured = _measurement_columns(log)
    return {
        "odometry.csv": table_text(driven),
        "measurements.csv": table_text(measured),
        "README.md": _readme(log.motion, driven, measured),
        "log.toml": model.text(),
    }


def _readme(motion: str, driven: Iterable[str], measured: Iterable[str]) -> str:
    """Return the text of a log folder's ``README.md``, with the columns of its tables."""
    tables = ODOMETRY[motion].readme([*driven]), MEASUREMENTS.readme([*measured])
    return shipped_text("detection/logs/readme.md") + "\n".join(tables)


def as_logged(scan: Scan, name: str) -> np.ndarray:
    """Return a scan's column as written in a log, where a direct call has an excess path of 0."""
    values = getattr(scan, name)
    if name == "excess_path" and scan.direct.size:
        values, straight = values.copy(), scan.direct[scan.direct >= 0]
        values[straight[scan.landmark[straight] == UNLABELLED]] = 0.0
    return values


def _odometry_columns(log: Log) -> dict[str, np.ndarray]:
    """Return the columns of ``odometry.csv``: controls, or poses with their covariance."""
    if log.motion != "poses":
        rows = np.vstack((log.controls, np.zeros(2)))
        return {"time": log.time} | dict(zip(NOISY[log.motion], rows.T, strict=True))
    column = dict(zip(POSE, poses_along(log.controls).T, strict=True))
    stated = log.controls[:, len(POSE) :]
    rows = np.vstack((np.full(stated.shape[1], np.nan), stated))
    return {"time": log.time} | column | dict(zip(MOTION_COVARIANCE, rows.T, strict=False))


def _measurement_columns(log: Log) -> dict[str, np.ndarray]:
    """Return the columns of ``measurements.csv``."""
    rows = columns_of(log.scans)
    direct = [as_logged(scan, "excess_path") for scan in log.scans]
    rows["excess_path"] = np.concatenate([np.empty(0), *direct])
    labelled = rows["landmark"] != UNLABELLED
    column = {name: rows[name] for name in MEASUREMENTS.columns}
    for name in STATED:
        if not ((name == "level_db" and labelled.any()) or np.isnan(rows[name]).all()):
            column[name] = rows[name]
    if log.callers and rows["caller"].any():
        column[CALLER] = np.array(["", *(caller.name for caller in log.callers)])[rows["caller"]]
    if labelled.any():
        column["landmark"] = np.where(labelled, rows["landmark"].astype(str), "")
    return column


class RowsHeard:
    """Text of a log of unlabelled scans, made scan by scan for existing odometry.

    `folder` contains ``odometry.csv`` and ``recording.toml``; `about` is the table ``log`` of the
    latter, and `callers` have the keys of ``log.toml``. Raises InputError if a table is invalid.
    """

    columns = (*MEASUREMENTS.columns, *MEASUREMENTS.optional)
    """Columns of ``measurements.csv``."""

    def __init__(self, folder: Path, about: dict[str, Any], callers: list[dict[str, Any]]) -> None:
        table = about | {"format": 1, "callers": callers}
        self._vehicle = vehicle_of(table, f"{folder / 'recording.toml'}, table 'log'")
        self._names = np.array(["", *(caller.name for caller in self._vehicle.callers)])
        self._odometry = folder / "odometry.csv"
        odometry = read_odometry(folder, self._vehicle.motion)
        begin = {"time": odometry.column["time"][:1], "landmark": np.array([UNLABELLED])}
        nothing = dict.fromkeys(("range", *STATED, CALLER), np.full(1, np.nan))
        column = begin | {"bearing": np.zeros(1)} | nothing
        one = Table(path=self._odometry, line=np.ones(1, dtype=np.int64), column=column)
        step, told = self._vehicle.step, self._vehicle.told()
        log = assemble(odometry, one, step=step, name="", **told)  # may raise
        self.time = log.time
        self.rows = self.inside = 0
        """Rows written, and rows within the time span of the odometry."""

    def text(self, scan: Scan) -> str:
        """Return the rows of a scan as lines of ``measurements.csv``, without the header."""
        time = np.full(len(scan.bearing), scan.time)
        column = [as_logged(scan, name) for name in self.columns[1:-1]]
        self.rows += time.size
        self.inside += time.size * bool(self.time[0] <= scan.time <= self.time[-1])
        values = (time, *column, self._names[scan.caller])
        return table_text(dict(zip(self.columns, values, strict=True))).split("\n", 1)[1]

    def files(self) -> dict[str, str]:
        """Return the log's other files by name; raise if no echo is in the odometry's time span."""
        if not self.inside:
            begin, end = self.time[[0, -1]].tolist()
            found = f"{self.rows} echoes, none between {begin!r} s and {end!r} s"
            fix = "use the odometry's clock ('start' of recording.toml), or a lower threshold"
            raise refusal(self._odometry, found, "echoes while it drives", fix)
        motion = self._vehicle.motion
        return {
            "odometry.csv": read_text(self._odometry),
            "README.md": _readme(motion, ODOMETRY[motion].columns, self.columns),
            "log.toml": self._vehicle.text(),
        }
