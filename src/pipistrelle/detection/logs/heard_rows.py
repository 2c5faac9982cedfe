"""A log whose rows are written as they are heard, scan by scan, beside odometry that is there."""

from pathlib import Path
from typing import Any

import numpy as np

from pipistrelle.detection.logs.folder import as_logged, log_readme, read_odometry
from pipistrelle.detection.logs.recording import CALLER, MEASUREMENT, STATED, assemble
from pipistrelle.detection.logs.text_tables import Table, table_text
from pipistrelle.detection.logs.vehicle import ODOMETRY, vehicle_of
from pipistrelle.detection.scans import UNLABELLED, Scan
from pipistrelle.files import read_text
from pipistrelle.refusals import refusal


class RowsHeard:
    """A log of scans without labels.

    Parameters
    ----------
    folder : Path
        Holds ``odometry.csv``, and a ``recording.toml`` that was read.
    about : dict
        Its table ``log``: keys of ``log.toml``.
    callers : list of dict
        As ``log.toml`` lists them.

    Raises
    ------
    InputError
        Where the table or the odometry are not as those of a log.
    """

    columns = ("time", *MEASUREMENT[1:], *STATED, CALLER)
    """Of ``measurements.csv``."""

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
        log = assemble(odometry, one, step=step, name="", former_names=(), **told)  # may refuse
        self.time = log.time
        self.rows = self.inside = 0
        """Rows that were heard, and those of them that the odometry's times hold."""

    def text(self, scan: Scan) -> str:
        """Return the rows of a scan, as ``measurements.csv`` has them, without the header."""
        time = np.full(len(scan.bearing), scan.time)
        column = [as_logged(scan, name) for name in self.columns[1:-1]]
        self.rows += time.size
        self.inside += time.size * bool(self.time[0] <= scan.time <= self.time[-1])
        text = table_text(self.columns, time, *column, self._names[scan.caller])
        return text.split("\n", 1)[1]

    def files(self) -> dict[str, str]:
        """Return the log's other files; refuse a log of which no row can be used."""
        if not self.inside:
            begin, end = self.time[[0, -1]].tolist()
            found = f"{self.rows} echoes, none between {begin!r} s and {end!r} s"
            fix = "use the odometry's clock ('start' of recording.toml), or a lower threshold"
            raise refusal(self._odometry, found, "echoes while it drives", fix)
        motion = self._vehicle.motion
        return {
            "odometry.csv": read_text(self._odometry),
            "README.md": log_readme(("time", *ODOMETRY[motion]), self.columns, motion),
            "log.toml": self._vehicle.text(),
        }
