"""Where compiled kernels are kept: a folder of one's own, one per state of the sources.

Beside each source, Numba's own choice, an update of one file would leave the kernels of another as
they were. Whatever lies in the folder is run, so it is trusted only where no other user can write:
it and all that is made in it are this user's and closed to others, and nobody can put another
folder in its place. Where there is none, a temporary one takes its place, and a line says so. Of
other states of the sources, the kernels that were used last are kept and the rest are removed.

One process compiles a kernel; another that needs it waits, and loads what the first has kept.

A process that compiles holds a lock on one byte of a file in the folder of kernels, and the system
lets go of it when the process ends, however it ends. Where files cannot be locked, or a process
that was stopped holds on to its turn, each compiles for itself.
"""

import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from zlib import crc32

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None

_LONGEST_S = 60.0
"""For how long to wait: several times what the largest kernel takes [s]."""
_PAUSE_S = 0.02
"""Time between two tries [s]."""


class Turn:
    """The turn of this process to compile a kernel; it has one at a time."""

    def __init__(self) -> None:
        self._file: int | None = None

    def take(self, kernel: Path) -> None:
        """Wait until no other process compiles what is kept in a file, and let none do so."""
        self.end()
        if fcntl is None:
            return
        byte, until = crc32(bytes(kernel)) & 0x7FFFFFFF, time.monotonic() + _LONGEST_S
        with suppress(OSError):
            self._file = os.open(kernel.parent / "compiling.lock", os.O_RDWR | os.O_CREAT, 0o600)
            while time.monotonic() < until:
                try:
                    fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, byte)
                except (BlockingIOError, PermissionError):  # another process has it
                    time.sleep(_PAUSE_S)
                else:
                    return

    def end(self) -> None:
        """Let others have their turn."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


TURN = Turn()


try:
    import grp
    import pwd
except ImportError:  # on Windows
    grp = pwd = None

_MAX_STATES = 3
"""How many states of the sources keep their kernels."""
_KEY = "[0-9a-f]{16}"
"""How the name of a state's folder looks (`sources_key`)."""
_NO_CODE = re.compile(rb'^ *r?"{3}[^"]*(?:"{1,2}[^"]+)*"{3}\n|^ *#.*\n|^ *\n', re.MULTILINE)
"""Docstrings, lines of comments and empty lines."""
_MIN_ROOM = 64_000_000
"""Bytes that all kernels of a state have room in, several times over."""


def place_kernels(*, plain: bool = False) -> bool:
    """Tell Numba where to keep compiled kernels, by ``NUMBA_CACHE_DIR``, below which a user may.

    Processes that are started by this one keep theirs there, too; whether one that has started this
    did so is returned. ``plain``: whether Numba compiles and keeps kernels in its own way.
    """
    told = os.environ.get("NUMBA_CACHE_DIR")
    folder = wanted = _wanted(plain)
    if why := _unfit(wanted):
        folder = _temporary() / wanted.name
        with suppress(OSError, AttributeError):  # there is no reader
            print(
                f"pipistrelle: {wanted} {why}: compiled kernels are kept in {folder}; set "
                "NUMBA_CACHE_DIR to a folder of your own that lasts",
                file=sys.stderr,
            )
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    _drop_old(folder)
    if "numba" in sys.modules:  # it looked when it was imported
        sys.modules["numba"].core.config.reload_config()
    return told == str(folder)


def sources_key(plain: bool = False) -> str:
    """Hash the interpreter's version and the code of every source that compiles a kernel.

    Docstrings and lines of comments are left out: kernels do not depend on them. Returns sixteen
    hexadecimal digits, others where kernels are compiled by plain Numba.
    """
    digest = sha256(sys.version.encode() + b"plain" * plain)
    for source in sorted(Path(__file__).parent.rglob("*.py")):
        text = source.read_bytes()
        if b"jit" in text:
            digest.update(source.name.encode() + _NO_CODE.sub(b"", text))
    return digest.hexdigest()[:16]


def close_to_others(folder: Path) -> None:
    """Let no other user into a folder that was made as the process makes any."""
    if os.name == "posix" and folder.stat().st_mode & 0o077:
        folder.chmod(0o700)


def _unfit(folder: Path) -> str | None:
    """Make a folder for kernels; return the reason if they cannot be kept there."""
    try:
        for one in (*reversed(folder.parents), folder):
            if not one.exists():
                one.mkdir(mode=0o700, exist_ok=True)
        if _is_mine(folder.parent, writable=True):  # of this package, as it is made above
            close_to_others(folder.parent)
        with tempfile.TemporaryFile(dir=folder):
            pass
        empty = not any(folder.iterdir())
        free = shutil.disk_usage(folder).free
        if fault := _open_to_others(folder):
            return fault
    except OSError:
        return "cannot be written"
    return "has too little room" if empty and free < _MIN_ROOM else None


def _open_to_others(folder: Path) -> str | None:
    """Return how another user could put kernels into a folder; None if none can."""
    if os.name != "posix":
        return None
    inside = (one for one in folder.iterdir() if one.is_dir())
    own: Iterable[Path] = (folder.parent, folder, *inside)
    if not all(map(_is_mine, own)):
        return "can be written by others, or is a link"
    for parent in folder.parent.parents:
        state = parent.stat()
        group = state.st_mode & 0o020 and not _is_private(state.st_gid)
        if state.st_uid not in (0, os.getuid()):
            return f"is in {parent}, which is another user's"
        if (group or state.st_mode & 0o002) and not state.st_mode & stat.S_ISVTX:
            return f"is in {parent}, which can be written by others"
    return None


def _is_mine(folder: Path, *, writable: bool = False) -> bool:
    """Tell whether a folder is this user's, no link, and no other can write to it.

    ``writable``: whether others may be able to.
    """
    if os.name != "posix":
        return True
    state = folder.lstat()
    shut = writable or not state.st_mode & 0o022
    return stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and shut


def _is_private(group: int) -> bool:
    """Tell whether a group is this user's alone, by its name, as many systems make one for each."""
    if pwd is None or grp is None:
        return False
    try:
        user, found = pwd.getpwuid(os.getuid()).pw_name, grp.getgrgid(group)
    except KeyError:
        return False
    return found.gr_name == user and not {*found.gr_mem} - {user}


def _temporary() -> Path:
    """Make a temporary folder that no other user can write to, as its files are executed."""
    folder = Path(tempfile.gettempdir()).resolve() / _of_user()
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        own = _is_mine(folder)
    except OSError:
        own = False
    if not own:
        folder = Path(tempfile.mkdtemp()) / _of_user()
        folder.mkdir(mode=0o700)
    return folder


def _of_user() -> str:
    """Return the name of a folder of this user's among those of others."""
    return f"pipistrelle-{os.getuid() if hasattr(os, 'getuid') else ''}"


def _wanted(plain: bool) -> Path:
    """Return where compiled kernels should be kept."""
    key = sources_key(plain)
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        folder = Path(chosen).absolute()
        ours = folder.parent.name in ("pipistrelle", _of_user())
        if ours and re.fullmatch(_KEY, folder.name):  # by the process that has started this one
            return folder.with_name(key)
        return Path(os.path.realpath(folder)) / _of_user() / key
    cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not cache.is_absolute():  # as the specification wants it
        try:
            cache = Path("~/.cache").expanduser()
        except RuntimeError:  # a user without a home
            cache = Path(os.devnull)
    return Path(os.path.realpath(cache)) / "pipistrelle" / key


def _drop_old(folder: Path) -> None:
    """Mark a state's kernels as used, and remove those of the states used longest ago."""
    try:
        os.utime(folder)
        states = [other for other in folder.parent.iterdir() if re.fullmatch(_KEY, other.name)]
        states.sort(key=lambda state: state.stat().st_mtime)
    except OSError:  # another process removes them just now
        return
    for old in states[:-_MAX_STATES]:
        shutil.rmtree(old, ignore_errors=True)
