"""A folder for results: made, refused or emptied; and files that are whole or not there."""

import contextlib
import json
import os
from datetime import datetime
from itertools import count
from pathlib import Path

from pipistrelle.config import InputError

CONTENTS = (
    "config.toml",
    "README.md",
    "track_*.tum",
    "map_*.csv",
    "truth.tum",
    "steps.parquet",
    "landmarks.parquet",
    "measurements.parquet",
    "mission.*",
    "*.partial",
    "summary.json",
)
"""What a result folder holds, and all that overwriting one removes, in this order."""


def prepare_folder(path: Path | None, name: str, overwrite: bool) -> Path:
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
        Accept a folder of earlier results: one that holds the ``summary.json`` of such. They stay
        until `clear_results` makes way for the new ones.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        Where the folder is not empty, is not a folder or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as parent:
    ...     prepare_folder(Path(parent) / "one" / "two", "run", overwrite=False).is_dir()
    True
    """
    try:
        folder = _new_folder(name) if path is None else _chosen_folder(path, overwrite)
        probe = folder / "probe.partial"
        probe.touch()
        probe.unlink()
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


def _chosen_folder(folder: Path, overwrite: bool) -> Path:
    """Make a folder, or accept one of earlier results."""
    folder.mkdir(parents=True, exist_ok=True)
    if not any(folder.iterdir()):
        return folder
    if not overwrite:
        raise InputError(
            f"{folder}: is not empty; name a new folder with -o DIR, or add --overwrite "
            "to replace earlier results"
        )
    if not _holds_results(folder):
        raise InputError(
            f"{folder}: is not empty and holds no summary.json of Pipistrelle, so nothing in it "
            "was overwritten; name another folder with -o DIR"
        )
    return folder


def clear_results(folder: Path) -> None:
    """Remove earlier results from a folder: `CONTENTS` and nothing else.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    InputError
        Where a file cannot be removed.
    """
    for pattern in CONTENTS:
        for old in sorted(folder.glob(pattern)):
            try:
                if old.is_file():
                    old.unlink()
            except OSError as error:
                raise InputError(
                    f"{old}: could not be replaced ({error.strerror}); "
                    "choose another folder with -o DIR"
                ) from error


def _holds_results(folder: Path) -> bool:
    """Tell whether a folder's summary is one of ours."""
    try:
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(summary, dict) and {"format", "config_hash", "runs"} <= summary.keys()


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file under another name and rename it when it is whole.

    Parameters
    ----------
    path : Path
        What stood there is replaced.
    content : str or bytes

    Raises
    ------
    InputError
        Where it cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as parent:
    ...     write_file(Path(parent) / "one.txt", "word")
    ...     [path.name for path in Path(parent).iterdir()]
    ['one.txt']
    """
    try:
        write_whole(path, content.encode() if isinstance(content, str) else content)
    except OSError as error:
        raise InputError(
            f"{path}: could not be written ({error.strerror}); "
            "make room or choose another folder with -o DIR"
        ) from error


def write_whole(path: Path, data: bytes, writer: str = "") -> None:
    """Write a file that is whole or not there, whatever stops the writing.

    Parameters
    ----------
    path : Path
        What stood there is replaced.
    data : bytes
    writer : str
        Tells those apart who may write the same file at the same time.

    Raises
    ------
    OSError
        Where it cannot be written; what stood there is then as it was.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as parent:
    ...     write_whole(Path(parent) / "one.txt", b"word", writer=".7")
    ...     [path.name for path in Path(parent).iterdir()]
    ['one.txt']
    """
    partial = path.with_name(f"{path.name}{writer}.partial")
    try:
        write_down(partial, data)
        put_in_place(partial, path)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


def write_down(path: Path, data: bytes) -> None:
    """Write a file down to the disk, so that a rename cannot outlive its content.

    Parameters
    ----------
    path : Path
        What stood there is replaced.
    data : bytes

    Raises
    ------
    OSError
        Where it cannot be written.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as place:
    ...     write_down(Path(place) / "one.partial", b"word")
    ...     (Path(place) / "one.partial").read_bytes()
    b'word'
    """
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def put_in_place(partial: Path, path: Path) -> None:
    """Rename a file that is whole, unless another process did so, and swept ours away.

    Parameters
    ----------
    partial, path : Path
        Its name so far, and the one that it is to have; what stood there is replaced.

    Raises
    ------
    OSError
        Where it cannot be renamed; also where neither of the two is there.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as place:
    ...     partial, whole = Path(place) / "one.partial", Path(place) / "one"
    ...     write_down(partial, b"word")
    ...     put_in_place(partial, whole)
    ...     put_in_place(partial, whole)  # by another process, after this one
    ...     partial.exists(), whole.exists()
    (False, True)
    """
    try:
        partial.replace(path)
    except FileNotFoundError:
        if not path.exists():
            raise
