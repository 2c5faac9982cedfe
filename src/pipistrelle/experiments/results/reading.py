"""What a result folder says of itself, and what a folder is that is no such folder."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ValidationError

from pipistrelle.config import InputError, Strategy
from pipistrelle.detection.logs.readers import READERS, Robot
from pipistrelle.files import read_file
from pipistrelle.own_files import COMPARISON, RESULTS, WORLD, OwnFiles
from pipistrelle.refusals import expectation, refusal, shown

SUMMARY = "summary.json"


class RunEntry(BaseModel):
    """An estimate of the summary, under the keys of ``summary.json``.

    Attributes
    ----------
    strategy : "active", "fused" or "passive"
    filter : str
        The estimator's name.
    """

    strategy: Strategy
    filter: str


class LogEntry(BaseModel):
    """Which log was solved.

    Attributes
    ----------
    path : str
        The folder.
    robot : int or str, or None
        Whose of several.
    beamwidth_rad : [rad] or None
        Outside which ranges were hidden.
    files : dict of str to str
        The SHA-256 of each file that was read, or might have been.
    """

    path: str
    robot: Robot | None
    beamwidth_rad: float | None
    files: dict[str, str]


class Summary(BaseModel):
    """What must be known of a mission for it to be done again.

    Attributes
    ----------
    format : int
    version : str
        Of the package that wrote it.
    config_hash : str
    runs : list of RunEntry
    log : LogEntry or None
        None where the mission was simulated.
    """

    format: Literal[1]
    version: str
    config_hash: str
    runs: list[RunEntry]
    log: LogEntry | None = None


def read_summary(folder: Path) -> Summary:
    """Read what a result folder says of itself.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    Summary

    Raises
    ------
    InputError
        Where it is no folder of results, with what it is; where its summary lacks something or
        holds no estimate.

    Examples
    --------
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
    """Say what a folder is, if not that of a mission's results, and what to do."""
    expected = "the result folder of `pipistrelle run` or `pipistrelle slam`"
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        return refusal(folder, found, expected, "check the path")
    if any((folder / name).exists() for name in ("plan.toml", "trials")):
        found = "a study, which keeps many worlds and the frames of none"
        settings = f"`pipistrelle run --config {folder / 'config.toml'} -o DIR`"
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
