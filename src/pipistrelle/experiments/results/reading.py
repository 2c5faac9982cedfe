"""The summary of a result folder, read and checked; any other folder is refused.

A folder of results read back: scores, settings, paths and maps.

What a folder holds is `writing`'s business; a file that is not as it was written is refused.
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
from pipistrelle.detection.logs.readers import READERS, Robot
from pipistrelle.estimation.catalogue import short_name
from pipistrelle.files import COMPARISON, RESULTS, SUMS, WORLD, OwnFiles, read_file
from pipistrelle.refusals import expectation, refusal, shown
from pipistrelle.settings import leaves

SUMMARY = "summary.json"


class RunEntry(BaseModel):
    """An estimate of the summary, under the keys of ``summary.json``."""

    strategy: Strategy
    filter: str
    """The estimator's name."""


class LogEntry(BaseModel):
    """The recorded log that was solved."""

    path: str
    """The folder; bytes that are no text are escaped."""
    path_bytes: str | None = Field(None, pattern=r"^([0-9a-f]{2})+$")
    """The bytes of the folder's name in hexadecimal digits, where they are no text."""
    robot: Robot | None
    """The robot, where the log is of several."""
    beamwidth_rad: float | None
    """Ranges outside a beam of this width were hidden [rad]."""
    files: dict[str, str]
    """The SHA-256 of each file that was read, or might have been."""

    @property
    def place(self) -> Path:
        """The folder's path."""
        if self.path_bytes is None:
            return Path(self.path)
        return Path(os.fsdecode(bytes.fromhex(self.path_bytes)))


class Summary(BaseModel):
    """What ``summary.json`` says that is needed to do a mission again."""

    format: Literal[1]
    version: str
    """The version of the package that wrote it."""
    config_hash: str
    runs: list[RunEntry]
    log: LogEntry | None = None
    """None where the mission was simulated."""


def read_summary(folder: Path) -> Summary:
    """Read the summary of a result folder; refuse a folder that is none, and say what it is.

    >>> read_summary(Path("nowhere"))
    Traceback (most recent call last):
    pipistrelle.config.InputError: nowhere: found no such folder, expected the result folder of
    `pipistrelle run` or `pipistrelle slam`; check the path
    """
    path = folder / SUMMARY
    if not path.exists() or (folder / "plan.toml").exists():
        raise _no_results(folder)
    try:
        summary = Summary.model_validate_json(read_file(path))
    except ValidationError as refused:
        faults = refused.errors(include_url=False)
        if any(fault["loc"] == ("runs",) and fault["type"] == "missing" for fault in faults):
            raise _no_results(folder) from None
        key = ".".join(map(str, faults[0]["loc"]))
        where = f"{path}: {key}" if key else path
        missing = faults[0]["type"] == "missing"
        found = "nothing" if missing else shown(faults[0]["input"])
        expected = "a value" if missing else expectation(faults[0])
        if faults[0]["type"] == "json_invalid":
            found, expected = "text that is no JSON", "a mission's summary"
        raise refusal(where, found, expected, "run or solve it anew with --overwrite") from None
    if not summary.runs:
        raise refusal(f"{path}: runs", "none", "an estimate", "run or solve it anew")
    return summary


def _no_results(folder: Path) -> InputError:
    """Return the refusal of a folder without results: what it is, and what to do."""
    expected = "the result folder of `pipistrelle run` or `pipistrelle slam`"
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        return refusal(folder, found, expected, "check the path")
    if any((folder / name).exists() for name in ("plan.toml", "trials")):
        found = "a study, which keeps many worlds and the frames of none"
        settings = f"`pipistrelle run --settings {folder / 'config.toml'} -o DIR`"
        fix = f"`pipistrelle report` puts it on a page; {settings} makes a mission of its settings"
        return refusal(folder, found, expected, fix)
    there = OwnFiles(folder, RESULTS).there
    if there in (COMPARISON.title, WORLD.title):
        return refusal(folder, f"{there} of Pipistrelle", expected, "name the folder of a run")
    if (folder / "index.html").exists():
        fix = "open its index.html, or name the folder of a run"
        return refusal(folder, "a report", expected, fix)
    if any(reader.recognises(folder) for reader in READERS):
        fix = f"solve it first, `pipistrelle slam {folder} -o DIR`, and name DIR"
        return refusal(folder, "a recorded log", expected, fix)
    if (folder / "config.toml").exists():
        fix = "it was stopped before it was whole: run or solve it anew with --overwrite"
        return refusal(folder, f"no {SUMMARY}", expected, fix)
    return refusal(folder, f"no {SUMMARY}", expected, "name another folder")


Estimate = tuple[str, str]
"""Strategy and filter."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredPath:
    """A path as it was read from a result folder."""

    time: Float[np.ndarray, " k"]
    """Seconds."""
    pose: Float[np.ndarray, "k 3"]
    """Position and heading [m, m, rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredMission:
    """What `run` or `slam` wrote into a folder, as `compare` reads it, without doing it again."""

    folder: Path
    version: str
    """The version of Pipistrelle that wrote it."""
    settings: Mapping[str, Any]
    """All settings, by their dotted names."""
    scores: Mapping[Estimate, Mapping[str, Any]]
    """Scores under the names of ``summary.json``; None where there is none."""
    paths: Mapping[Estimate, StoredPath]
    maps: Mapping[Estimate, Float[np.ndarray, "n 2"]]
    """Positions of the landmarks that are placed [m]."""
    truth: StoredPath | None


def read_mission(folder: Path) -> StoredMission:
    """Read the results in a folder; refuse a file that is not as it was written.

    >>> read_mission(Path("nowhere"))
    Traceback (most recent call last):
    pipistrelle.config.InputError: nowhere: found no such folder, expected the result folder of
    `pipistrelle run` or `pipistrelle slam`; check the path
    """
    own = results_in(folder)
    try:
        summary = json.loads(own.read(SUMMARY))
        scores = {(run["strategy"], run["filter"]): run for run in summary["runs"]}
        names = {estimate: f"{estimate[0]}_{short_name(estimate[1])}" for estimate in scores}
        return StoredMission(
            folder=folder,
            version=str(summary["version"]),
            settings=flattened(tomllib.loads(own.read("config.toml").decode()))
            | _log_settings(summary.get("log")),
            scores=scores,
            paths={key: _path(own.read(f"track_{name}.tum")) for key, name in names.items()},
            maps={key: _placed(own.read(f"map_{name}.csv")) for key, name in names.items()},
            truth=_path(own.read("truth.tum")) if "truth.tum" in own else None,
        )
    except InputError:
        raise
    except (ValueError, LookupError, TypeError, AttributeError) as error:  # sums of its own
        found = f"files that Pipistrelle would not write ({error})"
        raise refusal(folder, found, "results of it", "run again what wrote them") from error


def _log_settings(log: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the log that was solved and the options it was solved with, as settings."""
    if log is None:
        return {}
    asked = {f"log.{name}": log[name] for name in ("path", "robot", "beamwidth_rad")}
    sums = json.dumps(log["files"], sort_keys=True).encode()
    return {**asked, "log.files": sha256(sums).hexdigest()[:8]}


def flattened(table: Mapping[str, Any]) -> dict[str, Any]:
    """Name each value of nested tables by its dotted name.

    >>> flattened({"seed": 3, "air": {"pressure_kpa": 90.0}})
    {'seed': 3, 'air.pressure_kpa': 90.0}
    """
    return {".".join(key): value for key, value in leaves(table)}


def results_in(folder: Path) -> OwnFiles:
    """Return the files of a result folder; refuse a folder without whole results."""
    own = OwnFiles(folder, RESULTS)
    if own.there == RESULTS.title and (folder / SUMMARY).exists() and SUMMARY in own:
        own.read(SUMMARY)
    read_summary(folder)
    if SUMMARY not in own:
        found = f"a {SUMMARY} that {SUMS} does not name"
        raise refusal(folder, found, "results as they were written", "run or solve it anew")
    return own


def _path(text: bytes) -> StoredPath:
    """Read a path of the TUM format."""
    rows = np.loadtxt(io.BytesIO(text), ndmin=2).reshape(-1, 8)
    heading = 2.0 * np.arctan2(rows[:, 6], rows[:, 7])
    return StoredPath(time=rows[:, 0], pose=np.column_stack([rows[:, 1:3], heading]))


def _placed(text: bytes) -> Float[np.ndarray, "n 2"]:
    """Read the positions of the fully initialised landmarks of a map [m]."""
    rows = csv.DictReader(io.StringIO(text.decode()))
    places = [(float(row["x"]), float(row["y"])) for row in rows if row["status"] == "full"]
    return np.array(places).reshape(-1, 2)
