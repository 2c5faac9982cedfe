"""A folder of results read back: scores, settings, paths and maps.

What a folder holds is `writing`'s business; a file that is not as it was written is refused.
"""

import csv
import io
import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipistrelle.config import InputError
from pipistrelle.estimation.catalogue import short_name
from pipistrelle.experiments.results.reading import SUMMARY, read_summary
from pipistrelle.own_files import RESULTS, SUMS, OwnFiles
from pipistrelle.refusals import refusal
from pipistrelle.settings import leaves

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
