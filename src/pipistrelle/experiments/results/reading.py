"""Result folders read back: the summary, and the scores, settings, tracks and maps of a mission.

Any other folder, or a file that does not match its sum, raises an InputError.
"""

import csv
import io
import json
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, Field, ValidationError

from pipistrelle.config import InputError, Strategy
from pipistrelle.detection.logs.readers import Robot, kind_of, wrong_kind
from pipistrelle.estimation.catalogue import short_name
from pipistrelle.files import RESULTS, SUMS, OwnFiles, read_file
from pipistrelle.refusals import refusal, table_refusal
from pipistrelle.settings import leaves

SUMMARY = "summary.json"


class RunEntry(BaseModel, extra="allow"):
    """Entry of an estimate in ``summary.json``: strategy, filter and scores."""

    strategy: Strategy
    filter: str


class LogEntry(BaseModel):
    """Entry of a recorded log in ``summary.json``: path, robot, beamwidth, SHA-256 sums."""

    path: str
    """The folder; bytes that are not valid text are escaped."""
    path_bytes: str | None = Field(None, pattern=r"^([0-9a-f]{2})+$")
    """Bytes of the path in hexadecimal digits, if they are not valid text."""
    robot: Robot | None
    beamwidth_rad: float | None
    """Full beamwidth outside which ranges were hidden [rad]."""
    files: dict[str, str]
    """SHA-256 of each file that the reader may use."""

    @property
    def place(self) -> Path:
        """Path of the log's folder, also if its name is not valid text."""
        if self.path_bytes is None:
            return Path(self.path)
        return Path(os.fsdecode(bytes.fromhex(self.path_bytes)))


class Summary(BaseModel):
    """Content of ``summary.json``; `log` is None if the mission was simulated."""

    format: Literal[1]
    version: str
    config_hash: str
    runs: list[RunEntry]
    log: LogEntry | None = None


def read_summary(folder: Path) -> Summary:
    """Read ``summary.json`` of a result folder; raise for another kind of folder."""
    path = folder / SUMMARY
    if kind_of(folder) != RESULTS.title:
        expected = "the result folder of `pipistrelle run` or `pipistrelle slam`"
        raise wrong_kind(folder, expected, SUMMARY)
    try:
        summary = Summary.model_validate_json(read_file(path))
    except ValidationError as refused:
        raise table_refusal(path, refused, Summary) from None
    if not summary.runs:
        raise refusal(f"{path}: runs", "none", "an estimate", "run or solve it again")
    return summary


Estimate = tuple[str, str]
"""Strategy and filter."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredPath:
    """A path read from a TUM file: times [s] and poses [m, m, rad]."""

    time: Float[np.ndarray, " k"]
    pose: Float[np.ndarray, "k 3"]


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredMission:
    """The results of `run` or `slam`, read from their folder."""

    folder: Path
    version: str
    settings: Mapping[str, Any]
    """All settings, by dotted name."""
    scores: Mapping[Estimate, Mapping[str, Any]]
    """Scores by their names in ``summary.json``, or None."""
    paths: Mapping[Estimate, StoredPath]
    maps: Mapping[Estimate, Float[np.ndarray, "n 2"]]
    """Positions of the fully initialised landmarks [m]."""
    truth: StoredPath | None


def read_mission(folder: Path) -> StoredMission:
    """Read a mission's results from a folder; raise if a file was changed since."""
    own, summary = results_in(folder), read_summary(folder)
    runs: dict[Estimate, Any] = {(run.strategy, run.filter): run for run in summary.runs}
    scores = {estimate: run.model_dump() for estimate, run in runs.items()}
    names = {estimate: f"{estimate[0]}_{short_name(estimate[1])}" for estimate in scores}
    log = {} if summary.log is None else summary.log.model_dump(exclude={"path_bytes"})
    if log:
        log["files"] = sha256(json.dumps(log["files"], sort_keys=True).encode()).hexdigest()[:8]
    try:
        settings = leaves(tomllib.loads(own.read("config.toml").decode()))
        return StoredMission(
            folder=folder,
            version=summary.version,
            settings={".".join(key): value for key, value in settings}
            | {f"log.{name}": value for name, value in log.items()},
            scores=scores,
            paths={key: _path(own.read(f"track_{name}.tum")) for key, name in names.items()},
            maps={key: _placed(own.read(f"map_{name}.csv")) for key, name in names.items()},
            truth=_path(own.read("truth.tum")) if "truth.tum" in own else None,
        )
    except InputError:
        raise
    except (ValueError, LookupError, TypeError, AttributeError) as error:  # valid sums, not ours
        found = f"files that Pipistrelle would not write ({error})"
        raise refusal(folder, found, "results of it", "run again what wrote them") from error


def results_in(folder: Path) -> OwnFiles:
    """Return the files of a result folder; raise if the results are incomplete."""
    own = OwnFiles(folder, RESULTS)
    if own.there == RESULTS.title and (folder / SUMMARY).exists() and SUMMARY in own:
        own.read(SUMMARY)
    read_summary(folder)
    if SUMMARY not in own:
        found = f"a {SUMMARY} that {SUMS} does not name"
        raise refusal(folder, found, "results as they were written", "run or solve it again")
    return own


def _path(text: bytes) -> StoredPath:
    """Parse the text of a TUM file into times and poses."""
    rows = np.loadtxt(io.BytesIO(text), ndmin=2).reshape(-1, 8)
    heading = 2.0 * np.arctan2(rows[:, 6], rows[:, 7])
    return StoredPath(time=rows[:, 0], pose=np.column_stack([rows[:, 1:3], heading]))


def _placed(text: bytes) -> Float[np.ndarray, "n 2"]:
    """Parse a map's CSV text; return the positions [m] of its fully initialised landmarks."""
    rows = csv.DictReader(io.StringIO(text.decode()))
    places = [(float(row["x"]), float(row["y"])) for row in rows if row["status"] == "full"]
    return np.array(places).reshape(-1, 2)
