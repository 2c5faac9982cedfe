"""One file: only an ordinary one is read, and what is written is whole or not there.

A pipe or a device may never end, so neither is read. A file is written beside its place, under a
new name that no link can have, and renamed when it is whole.
"""

import contextlib
import os
import re
from hashlib import file_digest, sha256
from pathlib import Path
from unicodedata import bidirectional
from uuid import uuid4

from pipistrelle.config import InputError
from pipistrelle.refusals import refusal, shown

_TURNS = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
"""Classes of characters that embed, override or isolate a direction of writing."""
_PARTIAL = re.compile(r"(.+)\.[0-9a-f]{8}\.partial")


def check_ordinary(path: Path) -> None:
    """Refuse a path that exists but is no ordinary file.

    >>> check_ordinary(Path("/dev/null"))
    Traceback (most recent call last):
    pipistrelle.config.InputError: /dev/null: found a pipe or a device, expected a file; put what it
    holds into a file
    """
    if path.exists() and not path.is_file():
        if path.is_dir():
            raise refusal(path, "a folder", "a file", "name a file, or move the folder away")
        raise refusal(path, "a pipe or a device", "a file", "put what it holds into a file")


def read_file(path: Path) -> bytes:
    """Read a file as bytes."""
    check_ordinary(path)
    return path.read_bytes()


def read_named(path: Path, expected: str) -> bytes:
    """Read a file that a user named; refuse one that cannot be read, and say what was expected."""
    try:
        return read_file(path)
    except InputError:
        raise
    except FileNotFoundError:
        found = "a link to no file" if path.is_symlink() else "no such file"
        fix = "add it, or name the folder that holds it"
        raise refusal(path, found, expected, fix) from None
    except (OSError, ValueError) as error:  # a ValueError is of a name that no file can have
        found, fix = getattr(error, "strerror", error), "check the path and its permissions"
        raise refusal(printable(path), str(found), expected, fix) from None


def read_text(path: Path) -> str:
    """Read a file as UTF-8 text, without a byte order mark."""
    data = read_named(path, "a readable text file")
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        found = f"byte {error.start}, which is no UTF-8 text"
        raise refusal(path, found, "UTF-8 text", "save it as UTF-8") from None


def printable(path: Path) -> str:
    """Return the path as text; shortened or escaped if no file can have such a name."""
    text = str(path)
    return text if text.isprintable() and len(text) < 4096 else shown(text)


def text_of(name: str | Path) -> str:
    r"""Return a path, or text with paths in it, as UTF-8 can hold it: other bytes are escaped.

    >>> text_of("log" + chr(0xDCFF))
    'log\\xff'
    """
    return str(name).encode(errors="surrogateescape").decode(errors="backslashreplace")


def spelt(name: str | Path) -> str:
    r"""Return a path, or text with paths in it, in one line; unprintable characters are escaped.

    >>> spelt("one [2]"), spelt("a" + chr(10)), spelt("b" + chr(0x202E))
    ('one [2]', 'a\\n', 'b\\u202e')
    """
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text_of(name))


def upright(text: str) -> str:
    r"""Return text in which characters that change the direction of writing are escaped.

    A name that holds one would show the rest of its line in another order.

    >>> upright("log" + chr(0x202E) + "gol")
    'log\\u202egol'
    """
    return "".join(repr(c)[1:-1] if bidirectional(c) in _TURNS else c for c in text)


def without_links(path: Path) -> Path:
    """Return a path without links; that of a link to itself stands as it is.

    >>> without_links(Path("/dev/../dev"))
    PosixPath('/dev')
    """
    return Path(os.path.realpath(path))  # Path.resolve raises RuntimeError for such a link


def partial_of(path: Path) -> Path:
    """Return a new name beside a file, under which it is written before it is whole."""
    return path.with_name(f"{path.name}.{uuid4().hex[:8]}.partial")


def sum_of(path: Path) -> str:
    """Return the SHA-256 sum of a file, read in pieces."""
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()


class PiecesFile:
    """A new file that is written in pieces, beside the place that it is to have, and summed.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as place:
    ...     long = PiecesFile(Path(place) / "long.wav")
    ...     long.write(b"one")
    ...     long.close()
    ...     whole_name(long.path.name), long.sum == sum_of(long.path)
    ('long.wav', True)
    """

    def __init__(self, path: Path) -> None:
        self.path = partial_of(path)
        self._file = self.path.open("xb")
        self._sum = sha256()

    @property
    def sum(self) -> str:
        """The sum of what was written so far."""
        return self._sum.hexdigest()

    def write(self, data: bytes) -> None:
        """Write one more piece."""
        self._file.write(data)
        self._sum.update(data)

    def close(self) -> None:
        """Write all down to the disk."""
        if not self._file.closed:
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()

    def discard(self) -> None:
        """Remove the file where it was not put in its place."""
        with contextlib.suppress(OSError):
            self._file.close()
            self.path.unlink(missing_ok=True)


def whole_name(partial: str) -> str | None:
    """Return the name of the file that a partial one was to become; None of any other name.

    >>> whole_name("mission.png.0f3a9c2e.partial"), whole_name("debian.iso.partial")
    ('mission.png', None)
    """
    found = _PARTIAL.fullmatch(partial)
    return found[1] if found else None


def write_down(path: Path, data: bytes) -> None:
    """Write a new file down to the disk, so that a rename cannot outlive its content.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as place:
    ...     write_down(Path(place) / "one.partial", b"word")
    ...     (Path(place) / "one.partial").read_bytes()
    b'word'
    """
    with path.open("xb") as file:  # exclusive: it follows no link
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def write_whole(path: Path, data: bytes, *, replace: bool = True) -> None:
    """Write a file completely or not at all, even if writing is interrupted.

    `replace`: whether what stands there is replaced; a link itself is, never what it points at.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as parent:
    ...     write_whole(Path(parent) / "one.txt", b"word")
    ...     [path.name for path in Path(parent).iterdir()]
    ['one.txt']
    """
    partial = partial_of(path)
    try:
        write_down(partial, data)
        put_in_place(partial, path, replace=replace)
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def put_in_place(partial: Path, path: Path, *, replace: bool = True) -> None:
    """Rename a complete file, unless another process has already put it in place.

    `partial`, `path`: its name so far, and the one that it is to have; `replace`: whether what
    stands there is replaced.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as place:
    ...     partial, whole = Path(place) / "one.partial", Path(place) / "one"
    ...     write_down(partial, b"word")
    ...     put_in_place(partial, whole)
    ...     put_in_place(partial, whole)  # by another process, after this one
    ...     partial.exists(), whole.exists()
    (False, True)
    """
    if not replace:
        return _put_where_nothing_is(partial, path)
    try:
        partial.replace(path)
    except FileNotFoundError:
        if not path.exists():
            raise


def _put_where_nothing_is(partial: Path, path: Path) -> None:
    """Rename a file without replacing anything, even if it appeared a moment ago."""
    try:
        os.link(partial, path, follow_symlinks=False)
    except FileExistsError:
        raise
    except (OSError, NotImplementedError):  # a file system without hard links
        if os.path.lexists(path):
            raise FileExistsError(17, os.strerror(17), str(path)) from None
        partial.replace(path)
        return
    partial.unlink()
