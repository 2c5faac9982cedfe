"""Results that are made once per session, shared by all workers and changed by no test."""

import os
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

from pipistrelle.verbs.command_line import obey
from reference.command_line import SHORT
from reference.pictures import without_picture
from reference.sounds import record
from reference.studies import SMALL

CHORUS = (
    "[{}, {frequency = 25e3}, {name = 'boat', frequency = 20e3, course = 'circle', radius = 10}]"
)
"""Three callers: the beacon, one more at rest, and one that moves."""
TIMED = ("--callers", CHORUS, "--listening.excess-paths", "true", "--strategy", "fused")
PATIENCE = 600.0
"""Longest time to wait for another worker [s]; kernels may have to be compiled."""


def _run(folder: Path) -> None:
    _command("run", *SHORT, "-o", "run", "--save-log", "log", "--save-world", "world")


def _timed(folder: Path) -> None:
    _command("run", *SHORT, *TIMED, "--filter", "all", "-o", "run", "--save-log", "log")


def _tape(folder: Path) -> None:
    record(folder / "tape")


def _study(folder: Path) -> None:
    (folder / "small.toml").write_text(SMALL)
    _command("study", "small.toml", "--workers", "1", "-o", "study")


def _command(*words: str) -> None:
    assert obey([*words, "--quiet"]) == 0


MAKERS: dict[str, Callable[[Path], None]] = {
    "run": _run,
    "timed": _timed,
    "tape": _tape,
    "study": _study,
}


class Gallery:
    """Folders in a place that the workers of a session share, each made when it is first needed."""

    def __init__(self, base: Path) -> None:
        self.base, self.seen = base / "gallery", {}
        self.base.mkdir(exist_ok=True)

    def __call__(self, name: str) -> Path:
        """Return the folder of a piece; the first worker that needs it makes it."""
        folder, end = self.base / name, self.base / f"{name}.end"
        try:
            folder.mkdir()
        except FileExistsError:
            limit = time.monotonic() + PATIENCE
            while not end.exists() and time.monotonic() < limit:
                time.sleep(0.05)
        else:
            try:
                _make(MAKERS[name], folder)
            finally:
                end.touch()
        self.seen.setdefault(name, _state(folder))
        return folder

    def check(self) -> None:
        """Assert that no test changed a piece."""
        for name, state in self.seen.items():
            assert _state(self.base / name) == state, f"a test changed the {name} of the gallery"


def _make(maker: Callable[[Path], None], folder: Path) -> None:
    """Make a piece in its folder, without output and without a picture."""
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()), without_picture() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["pipistrelle"])
        maker(folder)


def _state(folder: Path) -> dict[str, tuple[int, int]]:
    """Return size and time of change of each file."""
    paths = [Path(place, name) for place, _, names in os.walk(folder) for name in names]
    return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in paths}
