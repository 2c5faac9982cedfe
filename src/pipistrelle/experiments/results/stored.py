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
    """A path as a folder has it.

    Attributes
    ----------
    time : (k) [s]
    pose : (k, 3) [m, m, rad]
    """

    time: Float[np.ndarray, " k"]
    pose: Float[np.ndarray, "k 3"]


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredMission:
    """What `run` or `slam` left in a folder.

    Attributes
    ----------
    folder : Path
    version : str
        Of Pipistrelle.
    settings : dict
        By their dotted names.
    scores : dict of a mapping by estimate
        Under the names of ``summary.json``; None where there is none.
    paths : dict of StoredPath by estimate
    maps : dict of (n, 2) [m] by estimate
        The landmarks that are placed.
    truth : StoredPath or None
    """

    folder: Path
    version: str
    settings: Mapping[str, Any]
    scores: Mapping[Estimate, Mapping[str, Any]]
    paths: Mapping[Estimate, StoredPath]
    maps: Mapping[Estimate, Float[np.ndarray, "n 2"]]
    truth: StoredPath | None


def read_mission(folder: Path) -> StoredMission:
    """Read what `run` or `slam` left in a folder.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    StoredMission

    Raises
    ------
    InputError
        Where the folder holds no results, not all of them, or a file that is not as it was written.

    Examples
    --------
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


def _log_settings(told: Mapping[str, Any] | None) -> dict[str, Any]:
    """Name which log was solved and how it was looked at, beside the settings."""
    if told is None:
        return {}
    asked = {f"log.{name}": told[name] for name in ("path", "robot", "beamwidth_rad")}
    sums = json.dumps(told["files"], sort_keys=True).encode()
    return {**asked, "log.files": sha256(sums).hexdigest()[:8]}


def flattened(table: Mapping[str, Any]) -> dict[str, Any]:
    """Name each value of nested tables by its dotted name.

    Parameters
    ----------
    table : mapping

    Returns
    -------
    dict

    Examples
    --------
    >>> flattened({"seed": 3, "air": {"pressure_kpa": 90.0}})
    {'seed': 3, 'air.pressure_kpa': 90.0}
    """
    return {".".join(key): value for key, value in leaves(table)}


def results_in(folder: Path) -> OwnFiles:
    """Return our files in a folder of whole results, or say what it is instead.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    OwnFiles

    Raises
    ------
    InputError
    """
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
    """Read where the landmarks of a map are that are placed."""
    rows = csv.DictReader(io.StringIO(text.decode()))
    places = [(float(row["x"]), float(row["y"])) for row in rows if row["status"] == "full"]
    return np.array(places).reshape(-1, 2)
