"""The folder for results: the one that the user named, or a new one under ``runs``."""

import contextlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from itertools import count
from pathlib import Path

from pipistrelle.config import InputError
from pipistrelle.files import partial_of
from pipistrelle.own_files import COMMAND_LINE, RESULTS, OwnFiles, claim, make_folder, remove_empty

_OURS = re.compile(r"\d{8}-\d{6}-(run|slam)(-\d+)?")
"""Names that `result_folder` gives."""


@contextmanager
def result_folder(
    path: Path | None, name: str, *, overwrite: bool, flags: tuple[str, str] = COMMAND_LINE
) -> Iterator[OwnFiles]:
    """Lend the folder for the results; if there are none in the end, nothing is left of it.

    Without a path it is ``runs/<time>-<name>``, and once it is whole ``runs/latest`` points at it,
    where the file system has symbolic links and no other file has that name. Earlier results stay
    until the new ones are whole.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as parent:
    ...     with result_folder(Path(parent) / "one", "run", overwrite=False) as own:
    ...         own.replace({"summary.json": "{}"})
    ...     own.folder.is_dir()
    True
    """
    if path is not None:
        yield claim(path, RESULTS, overwrite=overwrite, flags=flags)
        return
    made = _new_folder(name)
    try:
        yield claim(made[0], RESULTS, overwrite=False)
        _point_latest_at(made[0])
    finally:
        remove_empty(made)


def _new_folder(name: str) -> list[Path]:
    """Make ``runs/<time>-<name>``; return it, and ``runs`` if that was missing."""
    runs = Path("runs")
    try:
        made = make_folder(runs)[:1]
        stem = f"{datetime.now():%Y%m%d-%H%M%S}-{name}"
        for attempt in count(1):
            folder = runs / (stem if attempt == 1 else f"{stem}-{attempt}")
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                break
        return [folder, *made]
    except OSError as error:
        raise InputError(
            f"{runs}: cannot be used as a folder for results ({error.strerror}); name one that "
            f"can be written with {COMMAND_LINE[0]}"
        ) from error


def _point_latest_at(folder: Path) -> None:
    """Let ``runs/latest`` point at a folder, unless a file that is not ours has that name."""
    latest = folder.parent / "latest"
    if os.path.lexists(latest) and not (
        latest.is_symlink() and _OURS.fullmatch(str(latest.readlink()))
    ):
        return
    link = partial_of(latest)
    with contextlib.suppress(OSError):
        link.symlink_to(folder.name, target_is_directory=True)
        try:
            link.replace(latest)
        finally:
            link.unlink(missing_ok=True)
