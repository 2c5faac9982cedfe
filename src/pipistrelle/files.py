"""Safe files: read ordinary files only, write atomically, and replace only Pipistrelle's output.

A file is written beside its final place under a new random name, and renamed when it is complete.

``SHA256SUMS``, in the format of ``sha256sum -c``, lists the files that we wrote into a folder. As
many downloads have such a list, it is ours only if its first line states so and all its names are
of files that we write. A listed file is ours while it is an ordinary file with the listed sum,
reached through no link. Only our files are ever replaced or removed.

A folder named by a user is checked by `claim` before the work, and written by `OwnFiles.replace`
after it.
"""

import contextlib
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from hashlib import file_digest, sha256
from importlib import resources
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory, TemporaryFile, gettempdir
from typing import get_args
from unicodedata import bidirectional
from uuid import uuid4

from pipistrelle.config import InputError, Strategy
from pipistrelle.refusals import refusal, shown

_TURNS = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
"""Unicode classes of characters that embed, override or isolate a direction of writing."""
_DESCRIPTORS = Path("/proc/self/fd")
_PARTIAL = re.compile(r"(.+)\.[0-9a-f]{8}\.partial")


def shipped_text(path: str) -> str:
    """Return the text of a file of this package, such as the README of a kind of folder."""
    return (resources.files("pipistrelle") / path).read_text(encoding="utf-8")


def check_ordinary(path: Path) -> None:
    """Raise if a path exists but is not an ordinary file; a pipe or a device may never end."""
    if path.exists() and not path.is_file():
        if path.is_dir():
            raise refusal(path, "a folder", "a file", "name a file, or move the folder away")
        raise refusal(path, "a pipe or a device", "a file", "put what it holds into a file")


def read_file(path: Path) -> bytes:
    """Read an ordinary file as bytes; raise for a folder, a pipe or a device."""
    check_ordinary(path)
    return path.read_bytes()


def read_named(path: Path, expected: str) -> bytes:
    """Read a file that a user named; raise if it cannot be read, with `expected` in the message."""
    try:
        return read_file(path)
    except InputError:
        raise
    except FileNotFoundError:
        found = "a link to no file" if path.is_symlink() else "no such file"
        raise refusal(path, found, expected, "check the path, or add the file") from None
    except (OSError, ValueError) as error:  # ValueError: an impossible file name
        found, fix = getattr(error, "strerror", error), "check the path and its permissions"
        raise refusal(printable(path), str(found), expected, fix) from None


def read_text(path: Path) -> str:
    """Read a file as UTF-8 text, without a byte order mark."""
    data = read_named(path, "a readable text file")
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        found = f"byte {error.start}, which is no UTF-8 text"
        raise refusal(path, found, "UTF-8 text", "save it as UTF-8, or name another file") from None


def printable(path: Path) -> str:
    """Return a path as text; shortened or escaped if no file can have such a name."""
    text = str(path)
    return text if text.isprintable() and len(text) < 4096 else shown(text)


def text_of(name: str | Path) -> str:
    """Return a path or a text of paths as valid UTF-8, with other bytes escaped."""
    return str(name).encode(errors="surrogateescape").decode(errors="backslashreplace")


def spelt(name: str | Path) -> str:
    r"""Return a path or a text of paths on one line, with unprintable characters escaped.

    >>> spelt("one [2]"), spelt("a" + chr(10)), spelt("b" + chr(0x202E))
    ('one [2]', 'a\\n', 'b\\u202e')
    """
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text_of(name))


def upright(text: str) -> str:
    r"""Escape the characters of a text that change the direction of writing.

    In a file name they would reorder the rest of the line.

    >>> upright("log" + chr(0x202E) + "gol")
    'log\\u202egol'
    """
    return "".join(repr(c)[1:-1] if bidirectional(c) in _TURNS else c for c in text)


def without_links(path: Path) -> Path:
    """Resolve the links of a path; a link to itself is returned unchanged."""
    return Path(os.path.realpath(path))  # Path.resolve raises RuntimeError for a link to itself


@contextlib.contextmanager
def held(folder: Path) -> Iterator[Path]:
    """Yield a path that keeps leading to a folder even if the folder is renamed or replaced.

    On Linux the path goes through a descriptor; on other systems it is `folder` itself.
    """
    if not hasattr(os, "O_PATH") or not _DESCRIPTORS.is_dir():
        yield folder
        return
    descriptor = os.open(folder, os.O_PATH | os.O_DIRECTORY)
    try:
        yield _DESCRIPTORS / str(descriptor)
    finally:
        os.close(descriptor)


def partial_of(path: Path) -> Path:
    """Return a new temporary name for a file, in the same folder."""
    return path.with_name(f"{path.name}.{uuid4().hex[:8]}.partial")


class PiecesFile:
    """A new file that is written in pieces under a temporary name, with its SHA-256 sum.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as place:
    ...     long = PiecesFile(Path(place) / "long.wav")
    ...     long.write(b"one")
    ...     long.close()
    ...     whole_name(long.path.name), long.sum == sha256(b"one").hexdigest()
    ('long.wav', True)
    """

    def __init__(self, path: Path) -> None:
        self.path, self._whole = partial_of(path), path
        with self._faults_named():
            self._file = self.path.open("xb")
        self._sum = sha256()

    @property
    def sum(self) -> str:
        """The SHA-256 checksum of the data written so far."""
        return self._sum.hexdigest()

    def write(self, data: bytes) -> None:
        """Append bytes to the file and to its checksum."""
        with self._faults_named():
            self._file.write(data)
        self._sum.update(data)

    def close(self) -> None:
        """Flush the file to the disk and close it."""
        if not self._file.closed:
            with self._faults_named():
                self._file.flush()
                os.fsync(self._file.fileno())
                self._file.close()

    def discard(self) -> None:
        """Close the temporary file, and remove it unless it has its final name."""
        with contextlib.suppress(OSError):  # on a full disk, closing writes the rest
            self._file.close()
        with contextlib.suppress(OSError):
            self.path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _faults_named(self) -> Iterator[None]:
        """Convert an error of the system to an `InputError` that names the file."""
        try:
            yield
        except OSError as error:
            raise not_written(self._whole, error) from error


def not_written(path: Path, error: OSError) -> InputError:
    """Return the error for a file or folder that could not be written."""
    fix = "make room or name another folder"
    return InputError(f"{path}: could not be written ({error.strerror}); {fix}")


def whole_name(partial: str) -> str | None:
    """Return the final name of a file with a temporary name; None for any other name."""
    found = _PARTIAL.fullmatch(partial)
    return found[1] if found else None


def write_down(path: Path, data: bytes) -> None:
    """Write a new file and flush it to the disk, so that a rename cannot outlive its content."""
    with path.open("xb") as file:  # exclusive: it follows no link
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def write_whole(path: Path, data: bytes, *, replace: bool = True) -> None:
    """Write a file completely or not at all, even if writing is interrupted.

    `replace`: whether an existing file, or a link itself but not its target, is replaced.
    """
    partial = partial_of(path)
    try:
        write_down(partial, data)
        put_in_place(partial, path, replace=replace)
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def put_in_place(partial: Path, path: Path, *, replace: bool = True) -> None:
    """Rename a complete file to its final name, unless another process has already done so.

    `replace`: whether an existing file is replaced; if not, there is no race with its writer.
    """
    if replace:
        try:
            partial.replace(path)
        except FileNotFoundError:
            if not path.exists():
                raise
        return
    try:
        os.link(partial, path, follow_symlinks=False)
    except FileExistsError:
        raise
    except (OSError, NotImplementedError):  # a file system without hard links
        if os.path.lexists(path):
            raise FileExistsError(17, os.strerror(17), str(path)) from None
        partial.replace(path)
    else:
        partial.unlink()


SUMS = "SHA256SUMS"
_HEAD = "# Of Pipistrelle: {}"
_LINE = re.compile(r"([0-9a-f]{64}) [ *](.+)")


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of output folder, with the names of its files; one kind never replaces another."""

    title: str
    names: tuple[str, ...]
    """Patterns of names: a user's file with such a name is an obstacle."""
    more: tuple[str, ...] = ()
    """Patterns of names that are checked individually, when they are written."""

    def writes(self, name: str) -> bool:
        """Return whether this kind of output includes a file name, relative to the folder."""
        path = PurePosixPath(name)
        inside = not path.is_absolute() and ".." not in path.parts and path.as_posix() == name
        return inside and _matches(name, (*self.names, *self.more))


def _matches(name: str, patterns: Iterable[str]) -> bool:
    """Return whether a file name matches any of the patterns, ignoring case."""
    return any(fnmatchcase(name.lower(), pattern.lower()) for pattern in patterns)


RESULTS = Kind(
    "results",
    (
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
        *(f"mission.{ending}" for ending in ("png", "pdf", "gif", "mp4", "mcap")),
        "summary.json",
    ),
    ("worlds/*", "*.html", "*.rrd"),
)
REPORT = Kind("a report", ("index.html", "summary.json"), ("figures/*",))
LOG = Kind(
    "a log",
    ("log.toml", "odometry.csv", "measurements.csv", "truth.csv", "landmarks.csv", "README.md"),
    ("hearing.png",),
)
SOUND = Kind(
    "a sound recording",
    (
        *("recording.toml", "recording.wav", "array.csv", "calls.csv"),
        *("odometry.csv", "truth.csv", "landmarks.csv", "README.md"),
    ),
    ("call_*.wav",),
)
WORLD = Kind("a world", ("world.toml", "landmarks.csv", "path.csv", "README.md"), ("caller_*.csv",))
COMPARISON = Kind("a comparison", ("comparison.*", "settings.csv", "README.md"))
KINDS = (RESULTS, REPORT, LOG, SOUND, WORLD, COMPARISON)
COMMAND_LINE = ("-o DIR", "--overwrite")
"""Options of the command line for another folder, and for replacing results."""


def claim(
    folder: Path, kind: Kind, *, overwrite: bool, flags: tuple[str, str] = COMMAND_LINE
) -> "OwnFiles":
    """Check that a folder can receive output: it is new, empty, or holds results to replace.

    Raises if it cannot be written, which is tested without leaving anything there. `overwrite`:
    whether our earlier output may be replaced; `flags`: options for another folder and for
    replacing, for the message.

    >>> with TemporaryDirectory() as name:
    ...     own = claim(Path(name) / "new", LOG, overwrite=False)
    ...     own.replace({"log.toml": b"format = 1"})
    ...     sorted(path.name for path in own.folder.iterdir())
    ['SHA256SUMS', 'log.toml']
    """
    (another, allow), word = flags, kind.title.removeprefix("a ")
    try:
        made = make_folder(folder)
        try:
            with held(folder) as place:
                TemporaryFile(dir=place).close()
                empty = all(whole_name(path.name) == SUMS for path in place.iterdir())
        finally:
            remove_empty(made)
    except OSError as error:
        why = f"cannot be used as a folder for {kind.title} ({error.strerror})"
        raise InputError(f"{folder}: {why}; name one that can be written with {another}") from error
    own = OwnFiles(folder, kind)
    if empty:
        return own
    own.check_kind()
    if not own.there:
        listed = os.path.lexists(folder / SUMS)
        named = f"its {SUMS} is not Pipistrelle's" if listed else f"no {SUMS} names any"
        raise InputError(
            f"{folder}: is not empty and holds no {word} of Pipistrelle's ({named}), so nothing in "
            f"it is replaced; name a new folder with {another}"
        )
    if not overwrite:
        fix = f"name a new folder with {another}, or add {allow} to replace the {word} there"
        raise InputError(f"{folder}: is not empty; {fix}")
    own.check()
    return own


def make_folder(folder: Path) -> list[Path]:
    """Make a folder; return it and its parents that were missing, the innermost first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        remove_empty(missing)
        raise
    return missing


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders if they are empty, the innermost first."""
    with contextlib.suppress(OSError):
        for folder in folders:
            folder.rmdir()


def drawn_files(draw: Callable[[Path], object], under: str = "") -> dict[str, bytes]:
    """Run a drawing function in a temporary folder; return its files as {under + name: bytes}."""
    try:
        with TemporaryDirectory(prefix="pipistrelle-") as place:
            draw(Path(place))
            drawn = sorted(Path(place).iterdir())
            return {f"{under}{path.name}": path.read_bytes() for path in drawn}
    except OSError as error:
        why = f"pictures could not be drawn there ({error.strerror})"
        fix = "make room, or set TMPDIR to a folder that has some"
        raise InputError(f"{gettempdir()}: {why}; {fix}") from error


class OwnFiles:
    """The files that Pipistrelle wrote into a folder, identified by the folder's checksums.

    `kind`: the kind to read or write; a folder with another kind is not written.

    >>> with TemporaryDirectory() as name:
    ...     own, notes = OwnFiles(Path(name), LOG), Path(name) / "notes.txt"
    ...     own.replace({"README.md": b"one", "log.toml": b"two"})
    ...     _ = notes.write_text("a user's")
    ...     own.replace({"log.toml": b"three"})
    ...     sorted(path.name for path in Path(name).iterdir())
    ['SHA256SUMS', 'log.toml', 'notes.txt']
    """

    def __init__(self, folder: Path, kind: Kind) -> None:
        self.folder, self.kind = folder, kind
        self._place = folder
        """The path of the folder while it is written to (`held`)."""
        self._list = _list_in(folder)
        self.there, self._sums = _sums_of(self._list)
        """The title of the kind in the folder, None if it has no files of ours, and their sums."""

    def __contains__(self, name: str) -> bool:
        """Return whether the checksums list a file: we wrote it, or began to."""
        return name in self._sums

    def read(self, name: str) -> bytes:
        """Return a file's content; raise if the file was changed since we wrote it."""
        path = self.folder / name
        try:
            data = read_file(path)
        except FileNotFoundError:
            raise InputError(f"{path}: is missing; run again what wrote the others") from None
        except OSError as error:
            raise InputError(f"{path}: could not be read ({error.strerror})") from error
        if name not in self._sums:
            raise InputError(f"{path}: is not Pipistrelle's: {SUMS} does not name it")
        if sha256(data).hexdigest() not in self._sums[name]:
            fix = "run again what wrote it"
            raise InputError(f"{path}: was changed since Pipistrelle wrote it; {fix}")
        return data

    def check_kind(self) -> None:
        """Raise if the folder contains results of another kind."""
        if self.there not in (None, self.kind.title):
            why = f"holds {self.there} of Pipistrelle, which {self.kind.title} does not replace"
            raise InputError(f"{self.folder}: {why}; name another folder")

    def check(self) -> None:
        """Raise if the folder contains changed or foreign files that output would replace."""
        self.check_kind()
        named = (name for name in _names_in(self._place) if _matches(name, self.kind.names))
        for name in sorted({*named, *self._sums}):
            self.refuse(name)

    def refuse(self, name: str) -> None:
        """Raise if a file to be replaced was not written by us, or was changed since."""
        if "\n" in name:
            raise InputError(f"{name!r}: holds a line break; choose another name")
        if self.there is None and os.path.lexists(self._place / SUMS):
            raise _in_the_way(self.folder / SUMS, "is not Pipistrelle's")
        for parent in reversed(PurePosixPath(name).parents[:-1]):
            place = self._place / parent
            if place.is_symlink() or (place.exists() and not place.is_dir()):
                what = "is a link" if place.is_symlink() else "is no folder"
                raise _in_the_way(self.folder / parent, what)
        if os.path.lexists(self._place / name) and not self._is_ours(name):
            changed, strange = "was changed since Pipistrelle wrote it", "is not Pipistrelle's"
            raise _in_the_way(self.folder / name, changed if name in self._sums else strange)

    def _is_ours(self, name: str) -> bool:
        """Return whether a file is unchanged since we wrote it."""
        path = self._place / name
        if name not in self._sums or path.is_symlink() or not path.is_file():
            return False
        with contextlib.suppress(OSError), path.open("rb") as file:
            return file_digest(file, "sha256").hexdigest() in self._sums[name]
        return False

    def replace(self, files: Mapping[str, str | bytes | PiecesFile]) -> None:
        """Replace all our earlier files in the folder by new ones: all of them, or none.

        Names are relative to the folder, with slashes. The last file is removed first and put in
        place last: if it is there, all are. A `PiecesFile` must be closed. Raises InputError as
        `check`, if another process has written here since this object was made, or if there is no
        room; the folder is then unchanged.
        """
        self._write(files, keep=False)

    def add(self, name: str, content: bytes) -> None:
        """Write one file next to the others, replacing our earlier one."""
        self._write({name: content}, keep=True)

    def _write(self, files: Mapping[str, str | bytes | PiecesFile], *, keep: bool) -> None:
        """Check that the folder may be written, and write files into it."""
        made: list[Path] = []
        try:
            made = make_folder(self.folder)
            with held(self.folder) as self._place:
                if keep:
                    self.check_kind()
                elif _list_in(self._place) == self._list:
                    self.check()
                else:
                    why = "somebody else wrote into it meanwhile, so nothing there is replaced"
                    raise InputError(f"{self.folder}: {why}; name another folder")
                self._write_held(files, keep=keep)
        except OSError as error:
            raise not_written(self.folder, error) from error
        finally:
            self._place = self.folder
            remove_empty(made)

    def _write_held(self, files: Mapping[str, str | bytes | PiecesFile], *, keep: bool) -> None:
        """Write files under temporary names, list their checksums, and rename them."""
        contents = {n: c.encode() if isinstance(c, str) else c for n, c in files.items()}
        for name in contents:
            if not self.kind.writes(name):
                raise ValueError(f"{name}: is no file of {self.kind.title}")
            self.refuse(name)
        before = self._sums
        new = {
            name: {sha256(c).hexdigest() if isinstance(c, bytes) else c.sum}
            for name, c in contents.items()
        }
        partials = {
            name: (self._place / name).with_name(c.path.name)
            if isinstance(c, PiecesFile)
            else partial_of(self._place / name)
            for name, c in contents.items()
        }
        made: list[Path] = []
        at = self.folder
        try:
            try:
                self._list_sums({n: before.get(n, set()) | new.get(n, set()) for n in before | new})
                for name, partial in partials.items():
                    at = self.folder / name
                    made = [*make_folder(partial.parent), *made]
                    content = contents[name]
                    if isinstance(content, bytes):
                        write_down(partial, content)
            except BaseException:
                with contextlib.suppress(OSError):
                    _remove(partials.values())
                    if before:
                        self._list_sums(before)
                    elif self.there:
                        (self._place / SUMS).unlink(missing_ok=True)
                remove_empty(made)
                raise
            self._put_in_place(partials, () if keep else before.keys() - new.keys())
            self._list_sums(before | new if keep else new)
        except OSError as error:
            raise not_written(at, error) from error
        finally:
            with contextlib.suppress(OSError):
                _remove(partials.values())

    def _put_in_place(self, partials: Mapping[str, Path], old: Iterable[str]) -> None:
        """Rename the new files to their final names; remove old files and leftovers of crashes."""
        *_, last = partials
        _remove(self._place / name for name in (*([last] if last in self._sums else ()), *old))
        for name in [*_names_in(self._place)]:
            path, ours = self._place / name, whole_name(name) in (*self._sums, SUMS)
            if ours and path not in partials.values() and path.is_file() and not path.is_symlink():
                path.unlink(missing_ok=True)
        for name, partial in partials.items():
            put_in_place(partial, self._place / name, replace=self._is_ours(name))

    def _list_sums(self, sums: Mapping[str, set[str]]) -> None:
        """Write the list of checksums, which marks its files as ours even after a crash."""
        lines = [f"{one}  {name}" for name, some in sums.items() for one in sorted(some)]
        text = "\n".join([_HEAD.format(self.kind.title), *lines, ""])
        data = text.encode(errors="surrogateescape")
        write_whole(self._place / SUMS, data, replace=self.there is not None)
        self._list, self.there, self._sums = data, self.kind.title, dict(sums)


def _in_the_way(path: Path, what: str) -> InputError:
    """Return the error that a file or folder may not be replaced by output."""
    fix = "move it away, or name another folder"
    return InputError(f"{path}: {what}, so it is not replaced; {fix}")


def _list_in(folder: Path) -> bytes | None:
    """Return the content of a folder's SHA256SUMS; None if it cannot be read."""
    path = folder / SUMS
    if path.is_symlink():
        return None
    try:
        return read_file(path)
    except OSError:
        return None


def _sums_of(text: bytes | None) -> tuple[str | None, dict[str, set[str]]]:
    """Parse a list of checksums; return the folder's kind, None if not ours, and sums by file.

    While files are replaced, the list has the old and the new sums.
    """
    head, *lines = (text or b"").decode(errors="surrogateescape").split("\n")
    kind = next((kind for kind in KINDS if head == _HEAD.format(kind.title)), None)
    sums: dict[str, set[str]] = {}
    if kind is None or not lines or lines.pop():  # each line ends with a newline
        return None, {}
    for line in lines:
        found = _LINE.fullmatch(line)
        if not found or not kind.writes(found[2]):
            return None, {}
        sums.setdefault(found[2], set()).add(found[1])
    return kind.title, sums


def _names_in(folder: Path) -> Iterator[str]:
    """Yield the names of everything in and below a folder, relative to it, following no link."""
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            yield (Path(place) / name).relative_to(folder).as_posix()


def _remove(paths: Iterable[Path]) -> None:
    """Remove files, if they exist."""
    for path in paths:
        path.unlink(missing_ok=True)
