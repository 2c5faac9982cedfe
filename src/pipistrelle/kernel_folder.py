"""The cache folder of compiled kernels: one per state of the sources, private to the user.

With Numba's default, beside each source, an update of one file would leave outdated kernels of
others. Files in the folder are executed, so it is used only if no other user can write to it or
replace it: the folder and its content belong to this user and are closed to others. Otherwise a
temporary folder is used, and a message printed. The kernels of the most recently used states are
kept, the others removed.

A process that compiles a kernel holds a lock on one byte of a file in the folder; another that
needs the kernel waits, and loads it then. The system releases the lock when the process ends. If
files cannot be locked, or a stopped process holds its lock too long, each process compiles.
"""

import os
import re
import shutil
import stat
import sys
import tempfile
import time
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from zlib import crc32

try:
    import fcntl
    import grp
    import pwd
except ImportError:  # on Windows
    fcntl = grp = pwd = None

_LONGEST_S = 60.0
"""Longest wait for a lock [s]: several times the compilation of the largest kernel."""
_KEY = "[0-9a-f]{16}"
"""Pattern of the name of a state's folder (`sources_key`)."""
_NO_CODE = re.compile(rb'^ *r?"{3}[^"]*(?:"{1,2}[^"]+)*"{3}\n|^ *#.*\n|^ *\n', re.MULTILINE)
"""Docstrings, lines of comments and empty lines."""
_said: set[str] = set()


def say(line: str) -> None:
    """Print a message to standard error, each only once."""
    if line not in _said and sys.stderr is not None:
        _said.add(line)
        with suppress(OSError, AttributeError):
            print(f"pipistrelle: {line}", file=sys.stderr)


class Turn:
    """File lock that lets only one process at a time compile a kernel."""

    def __init__(self) -> None:
        self._file: int | None = None

    def take(self, kernel: Path) -> None:
        """Wait for the lock on compiling a kernel, and take it."""
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
                    time.sleep(0.02)
                else:
                    return

    def end(self) -> None:
        """Release the lock on compiling a kernel, if it is held."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


TURN = Turn()


def place_kernels(*, plain: bool = False) -> bool:
    """Set ``NUMBA_CACHE_DIR`` to the kernels' cache folder; return whether it was inherited.

    Processes started by this one inherit it; returns whether this process has inherited it.
    ``plain``: whether Numba compiles and caches kernels in its own way.
    """
    told = os.environ.get("NUMBA_CACHE_DIR")
    folder = wanted = _wanted(plain)
    if why := _unfit(wanted):
        folder = _temporary() / wanted.name
        say(
            f"{wanted} {why}: compiled kernels are kept in {folder}; set NUMBA_CACHE_DIR to a "
            "folder of your own that lasts"
        )
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    _drop_old(folder)
    if "numba" in sys.modules:  # it has already read its configuration
        sys.modules["numba"].core.config.reload_config()
    return told == str(folder)


def sources_key(plain: bool = False) -> str:
    """Hash the interpreter's version and the code of every source that compiles a kernel.

    Docstrings and lines of comments are excluded, as kernels do not depend on them. Returns sixteen
    hexadecimal digits, different ones for plain Numba.
    """
    digest = sha256(sys.version.encode() + b"plain" * plain)
    for source in sorted(Path(__file__).parent.rglob("*.py")):
        text = source.read_bytes()
        if re.search(rb"jit\b", text):
            digest.update(source.name.encode() + _NO_CODE.sub(b"", text))
    return digest.hexdigest()[:16]


def _unfit(folder: Path) -> str | None:
    """Create the cache folder of kernels; return the reason if it cannot be used."""
    try:
        for one in (*reversed(folder.parents), folder):
            if not one.exists():
                one.mkdir(mode=0o700, exist_ok=True)
        ours = folder.parent  # the package's folder, made above
        if os.name == "posix" and _is_mine(ours, writable=True) and ours.stat().st_mode & 0o077:
            ours.chmod(0o700)
        with tempfile.TemporaryFile(dir=folder):
            pass
        empty = not any(folder.iterdir())
        free = shutil.disk_usage(folder).free
        if fault := _open_to_others(folder):
            return fault
    except OSError:
        return "cannot be written"
    # 64 MB hold all kernels of a state, several times over
    return "has too little room" if empty and free < 64_000_000 else None


def _open_to_others(folder: Path) -> str | None:
    """Return how another user could put kernels into a folder; None if impossible."""
    if os.name != "posix":
        return None
    inside = (path for path in folder.iterdir() if path.is_dir())
    if not all(map(_is_mine, (folder.parent, folder, *inside))):
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
    """Return whether a folder is this user's, no link, and closed to others unless `writable`."""
    if os.name != "posix":
        return True
    try:
        state = folder.lstat()
    except FileNotFoundError:
        return True  # another process has just removed it
    shut = writable or not state.st_mode & 0o022
    return stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and shut


def _is_private(group: int) -> bool:
    """Return whether a Unix group has this user's name and no other member."""
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
    """Return the name of this user's cache folder within a shared folder."""
    return f"pipistrelle-{os.getuid() if hasattr(os, 'getuid') else ''}"


def _wanted(plain: bool) -> Path:
    """Return the preferred cache folder of kernels, by the environment and a hash of sources."""
    key = sources_key(plain)
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        folder = Path(chosen).absolute()
        ours = folder.parent.name in ("pipistrelle", _of_user())
        if ours and re.fullmatch(_KEY, folder.name):  # set by a parent process
            return folder.with_name(key)
        return Path(os.path.realpath(folder)) / _of_user() / key
    cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not cache.is_absolute():  # as the specification requires
        try:
            cache = Path("~/.cache").expanduser()
        except RuntimeError:  # a user without a home
            cache = Path(os.devnull)
    return Path(os.path.realpath(cache)) / "pipistrelle" / key


def _drop_old(folder: Path) -> None:
    """Mark a cache folder as used; remove all but the three most recently used in its parent."""
    try:
        os.utime(folder)
        states = [other for other in folder.parent.iterdir() if re.fullmatch(_KEY, other.name)]
        states.sort(key=lambda state: state.stat().st_mtime)
    except OSError:  # another process is removing them
        return
    for old in states[:-3]:
        shutil.rmtree(old, ignore_errors=True)
