"""A folder for results: made, or refused."""

import contextlib
from collections.abc import Sequence
from datetime import datetime
from itertools import count
from pathlib import Path
from tempfile import TemporaryFile
from typing import get_args

from pipistrelle.config import InputError, Strategy
from pipistrelle.files import RESULTS, OwnFiles

RESERVED = (
    "config.toml",
    "README.md",
    *(f"track_{strategy}_*.tum" for strategy in get_args(Strategy)),
    *(f"map_{strategy}_*.csv" for strategy in get_args(Strategy)),
    "caller_*.tum",
    "truth.tum",
    "truth_*.tum",
    "steps.parquet",
    "landmarks.parquet",
    "measurements.parquet",
    *(f"mission.{ending}" for ending in ("png", "pdf", "gif", "mp4")),
    "summary.json",
)
"""What a result folder may hold: another's file of such a name is in the way."""


def prepare_folder(
    path: Path | None,
    name: str,
    overwrite: bool,
    *,
    kind: str = RESULTS,
    reserved: Sequence[str] = RESERVED,
) -> Path:
    """Make the folder that the results go to, and see that it can be written.

    Without a path it is ``runs/<time>-<name>``, and ``runs/latest`` comes to point at it where
    the file system has symbolic links.

    Parameters
    ----------
    path : Path, optional
        The folder itself.
    name : str
        What ran.
    overwrite : bool
        Accept a folder of earlier results, by their ``SHA256SUMS`` (`pipistrelle.files`). They
        stay until `write_results` makes way for the new ones.
    kind : str
        What is to stand there, as `pipistrelle.files` has it.
    reserved : sequence of str
        Patterns of names that it may use.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        Where the folder is not empty, is not a folder or cannot be written; where what would be
        replaced is not as we wrote it.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as parent:
    ...     prepare_folder(Path(parent) / "one" / "two", "run", overwrite=False).is_dir()
    True
    """
    try:
        folder = (
            _new_folder(name) if path is None else _chosen_folder(path, overwrite, kind, reserved)
        )
        TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InputError(
            f"{path or 'runs'}: cannot be used as a result folder ({error.strerror}); "
            "name a folder that can be written with -o DIR"
        ) from error
    return folder


def _new_folder(name: str) -> Path:
    """Make ``runs/<time>-<name>`` and point ``runs/latest`` at it."""
    runs = Path("runs")
    runs.mkdir(exist_ok=True)
    stem = f"{datetime.now():%Y%m%d-%H%M%S}-{name}"
    for attempt in count(1):
        folder = runs / (stem if attempt == 1 else f"{stem}-{attempt}")
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            break
    link = runs / f"{folder.name}.partial"
    with contextlib.suppress(OSError):
        link.symlink_to(folder.name, target_is_directory=True)
        try:
            link.replace(runs / "latest")
        finally:
            link.unlink(missing_ok=True)
    return folder


def _chosen_folder(folder: Path, overwrite: bool, kind: str, reserved: Sequence[str]) -> Path:
    """Make a folder, or accept one of earlier results."""
    folder.mkdir(parents=True, exist_ok=True)
    if not any(folder.iterdir()):
        return folder
    word = kind.removeprefix("a ")
    if not overwrite:
        raise InputError(
            f"{folder}: is not empty; name a new folder with -o DIR, or add --overwrite "
            f"to replace the {word} there"
        )
    own = OwnFiles(folder, kind)
    if not own:
        raise InputError(
            f"{folder}: is not empty and holds no {word} of Pipistrelle's (its SHA256SUMS would "
            "name them), so nothing in it was overwritten; name another folder with -o DIR"
        )
    own.check(path.name for pattern in reserved for path in folder.glob(pattern))
    return folder
