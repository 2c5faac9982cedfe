"""The summary of a result folder, read and checked; any other folder is refused."""

import os
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field, ValidationError

from pipistrelle.config import InputError, Strategy
from pipistrelle.detection.logs.readers import READERS, Robot
from pipistrelle.files import read_file
from pipistrelle.own_files import COMPARISON, RESULTS, WORLD, OwnFiles
from pipistrelle.refusals import expectation, refusal, shown

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
