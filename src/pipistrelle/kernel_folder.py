"""Where compiled kernels are kept: a folder of the user's cache, one per state of the sources.

Beside each source, Numba's own choice, an update of one file would leave the kernels of another as
they were. What lies in the folder is run, so one that others can write is not trusted: where the
user's cannot be had, a temporary one takes its place, and a line says so. Of other states of the
sources, the kernels that were used last are kept and the rest are removed.
"""

import os
import re
import shutil
import sys
import tempfile
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

_MAX_STATES = 3
"""How many states of the sources keep their kernels."""
_MIN_ROOM = 64_000_000
"""Bytes that all kernels of a state have room in, several times over."""


def place_kernels() -> None:
    """Tell Numba where to keep compiled kernels, by ``NUMBA_CACHE_DIR``, which a user may set.

    Processes that are started by this one keep theirs there, too.
    """
    chosen = bool(os.environ.get("NUMBA_CACHE_DIR"))
    folder = wanted = _wanted()
    if why := _unfit(wanted):
        folder = _temporary() / sources_key()
        with suppress(OSError, AttributeError):  # there is no reader
            print(
                f"pipistrelle: {wanted} {why}: compiled kernels are kept in {folder}; set "
                "NUMBA_CACHE_DIR to a folder of your own that lasts",
                file=sys.stderr,
            )
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if not chosen:
        _drop_old(folder)
    if "numba" in sys.modules:  # it looked when it was imported
        sys.modules["numba"].core.config.reload_config()


def sources_key() -> str:
    """Hash the interpreter's version and every source that compiles a kernel.

    Returns sixteen hexadecimal digits.
    """
    digest = sha256(sys.version.encode())
    for source in sorted(Path(__file__).parent.rglob("*.py")):
        text = source.read_bytes()
        if b"jit" in text:
            digest.update(source.name.encode() + text)
    return digest.hexdigest()[:16]


def _unfit(folder: Path) -> str | None:
    """Make a folder for kernels; return the reason if they cannot be kept there."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        empty = not any(folder.iterdir())
        free = shutil.disk_usage(folder).free
    except OSError:
        return "cannot be written"
    if not _is_mine(folder):
        return "can be written by others"
    return "has too little room" if empty and free < _MIN_ROOM else None


def _is_mine(folder: Path) -> bool:
    """Tell whether no other user can write to a folder."""
    state = folder.stat()
    mine = not hasattr(os, "getuid") or state.st_uid == os.getuid()
    return mine and not (os.name == "posix" and state.st_mode & 0o022)


def _temporary() -> Path:
    """Make a temporary folder that no other user can write to, as its files are executed."""
    user = os.getuid() if hasattr(os, "getuid") else ""
    folder = Path(tempfile.gettempdir()) / f"pipistrelle-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        state = folder.lstat()
        own = user in ("", state.st_uid) and not state.st_mode & 0o022
    except OSError:
        own = False
    return folder if own and not folder.is_symlink() else Path(tempfile.mkdtemp())


def _wanted() -> Path:
    """Return where compiled kernels should be kept."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not cache.is_absolute():  # as the specification wants it
        try:
            cache = Path("~/.cache").expanduser()
        except RuntimeError:  # a user without a home
            cache = Path(os.devnull)
    return cache / "pipistrelle" / sources_key()


def _drop_old(folder: Path) -> None:
    """Mark a state's kernels as used, and remove those of the states used longest ago."""
    try:
        os.utime(folder)
        states = [
            other for other in folder.parent.iterdir() if re.fullmatch("[0-9a-f]{16}", other.name)
        ]
        states.sort(key=lambda state: state.stat().st_mtime)
    except OSError:  # another process removes them just now
        return
    for old in states[:-_MAX_STATES]:
        shutil.rmtree(old, ignore_errors=True)
