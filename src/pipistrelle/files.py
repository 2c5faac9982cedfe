"""One file: only an ordinary one is read, and what is written is whole or not there.

A pipe or a device may never end, so neither is read. A file is written beside its place, under a
new name that no link can have, and renamed when it is whole.

Folders that we write into: which files in them are ours, and how these are replaced.

``SHA256SUMS``, as ``sha256sum -c`` reads it, lists what we wrote into a folder. Such lists lie
beside many downloads, so one is ours only if its first line says so and each name on it is one that
from collections.abc import Iterator
from contextlib import contextmanager
we write. What it names is ours as long as it is an ordinary file of that sum, reached through no
link. Only that is ever replaced or removed; everything else is somebody's, the list itself too.

Whatever is written into a folder that a user names passes `claim` before the work, and
`OwnFiles.replace` after it.
"""

import contextlib
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from hashlib import file_digest, sha256
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory, TemporaryFile, gettempdir
from typing import get_args
from unicodedata import bidirectional
from uuid import uuid4

from pipistrelle.config import InputError, Strategy
from pipistrelle.refusals import refusal, shown

_TURNS = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
"""Classes of characters that embed, override or isolate a direction of writing."""
_DESCRIPTORS = Path("/proc/self/fd")
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


@contextlib.contextmanager
def held(folder: Path) -> Iterator[Path]:
    """Lend a path that leads to a folder even if another is put in its place meanwhile.

    On Linux it leads by a descriptor; elsewhere it is the folder's own path.
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
        self.path, self._whole = partial_of(path), path
        with self._faults_named():
            self._file = self.path.open("xb")
        self._sum = sha256()

    @property
    def sum(self) -> str:
        """The sum of what was written so far."""
        return self._sum.hexdigest()

    def write(self, data: bytes) -> None:
        """Write one more piece."""
        with self._faults_named():
            self._file.write(data)
        self._sum.update(data)

    def close(self) -> None:
        """Write all down to the disk."""
        if not self._file.closed:
            with self._faults_named():
                self._file.flush()
                os.fsync(self._file.fileno())
                self._file.close()

    def discard(self) -> None:
        """Remove the file where it was not put in its place."""
        with contextlib.suppress(OSError):  # on a full disk, it writes what is left
            self._file.close()
        with contextlib.suppress(OSError):
            self.path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _faults_named(self) -> Iterator[None]:
        """Refuse with the file's name what the system cannot write."""
        try:
            yield
        except OSError as error:
            raise not_written(self._whole, error) from error


def not_written(path: Path, error: OSError) -> InputError:
    """Return the error for a file or folder that could not be written."""
    return InputError(
        f"{path}: could not be written ({error.strerror}); make room or name another folder"
    )


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


SUMS = "SHA256SUMS"
_HEAD = "# Of Pipistrelle: {}"
_LINE = re.compile(r"([0-9a-f]{64}) [ *](.+)")


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of output folder, with the names of its files; one kind never replaces another."""

    title: str
    names: tuple[str, ...]
    """Patterns of names: a user's file of such a name is in the way."""
    more: tuple[str, ...] = ()
    """Patterns of names that are checked one by one, when they are written."""

    def writes(self, name: str) -> bool:
        """Tell whether we write a file of this name, relative to the folder."""
        path = PurePosixPath(name)
        inside = not path.is_absolute() and ".." not in path.parts and path.as_posix() == name
        return inside and _matches(name, (*self.names, *self.more))


def _matches(name: str, patterns: Iterable[str]) -> bool:
    """Tell whether a name is like one of some patterns, in letters of any case."""
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
"""How a user of the command line names another folder, and allows that results are replaced."""


def claim(
    folder: Path, kind: Kind, *, overwrite: bool, flags: tuple[str, str] = COMMAND_LINE
) -> "OwnFiles":
    """Accept a folder to write into: a new or empty one, or one with our results.

    Whether it can be written is tried; nothing is left there by that.

    `kind`: kind of result; `overwrite`: whether what we wrote there may be replaced;
    `flags`: how the user names another folder, and allows to replace.

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
        raise InputError(
            f"{folder}: cannot be used as a folder for {kind.title} ({error.strerror}); name one "
            f"that can be written with {another}"
        ) from error
    own = OwnFiles(folder, kind)
    if empty:
        return own
    own.check_kind()
    if own.there and not overwrite:
        raise InputError(
            f"{folder}: is not empty; name a new folder with {another}, or add {allow} to replace "
            f"the {word} there"
        )
    if not own.there:
        listed = os.path.lexists(folder / SUMS)
        named = f"its {SUMS} is not Pipistrelle's" if listed else f"no {SUMS} names any"
        raise InputError(
            f"{folder}: is not empty and holds no {word} of Pipistrelle's ({named}), so nothing in "
            f"it is replaced; name a new folder with {another}"
        )
    own.check()
    return own


def make_folder(folder: Path) -> list[Path]:
    """Make a folder; return what of it and of those around it was missing, the innermost first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        remove_empty(missing)
        raise
    return missing


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders that we made, the innermost first, as far as they are empty."""
    with contextlib.suppress(OSError):
        for folder in folders:
            folder.rmdir()


def drawn_files(draw: Callable[[Path], None], under: str = "") -> dict[str, bytes]:
    """Return the files that a function draws, by name.

    `under` is put before each name, as in "figures/".
    """
    try:
        with TemporaryDirectory(prefix="pipistrelle-") as place:
            draw(Path(place))
            drawn = sorted(Path(place).iterdir())
            return {f"{under}{path.name}": path.read_bytes() for path in drawn}
    except OSError as error:
        raise InputError(
            f"{gettempdir()}: pictures could not be drawn there ({error.strerror}); make room, or "
            "set TMPDIR to a folder that has some"
        ) from error


class OwnFiles:
    """The files that we wrote into a folder, known by its list of sums; it writes more of them.

    Parameters
    ----------
    folder : Path
    kind : Kind
        What is read or written. Where the folder holds another kind, nothing is written.

    Examples
    --------
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
        """Leads to the folder while it is written to (`held`)."""
        self._list = _list_in(folder)
        self._there, self._sums = _sums_of(self._list)

    @property
    def there(self) -> str | None:
        """The title of the kind that is there; None where nothing is of ours."""
        return self._there

    def __contains__(self, name: str) -> bool:
        """Tell whether a file is on the list: we wrote it, or began to."""
        return name in self._sums

    def read(self, name: str) -> bytes:
        """Read a file if it is unchanged since we wrote it."""
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
            raise InputError(
                f"{path}: was changed since Pipistrelle wrote it; run again what wrote it"
            )
        return data

    def check_kind(self) -> None:
        """Refuse a folder that holds results of another kind."""
        if self._there not in (None, self.kind.title):
            raise InputError(
                f"{self.folder}: holds {self._there} of Pipistrelle, which {self.kind.title} does "
                "not replace; name another folder"
            )

    def check(self) -> None:
        """Refuse a folder that holds changed files under the names to be replaced."""
        self.check_kind()
        named = (name for name in _names_in(self._place) if _matches(name, self.kind.names))
        for name in sorted({*named, *self._sums}):
            self.refuse(name)

    def refuse(self, name: str) -> None:
        """Refuse to replace a file that we did not write or that was changed since."""
        if "\n" in name:
            raise InputError(f"{name!r}: holds a line break; choose another name")
        if self._there is None and os.path.lexists(self._place / SUMS):
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
        """Tell whether a file is as we wrote it."""
        path = self._place / name
        if name not in self._sums or path.is_symlink() or not path.is_file():
            return False
        with contextlib.suppress(OSError):
            return sum_of(path) in self._sums[name]
        return False

    def replace(self, files: Mapping[str, str | bytes | PiecesFile]) -> None:
        """Write files in place of all that we wrote here before: all of them, or none.

        Parameters
        ----------
        files : mapping of name to content
            Names are relative to the folder, with slashes. The last is taken away first and put in
            place last: where it stands, all stand. A file that was written in pieces is beside its
            place already, and closed.

        Raises
        ------
        InputError
            As `check`; also where somebody else has written here since this object was made, or
            where there is no room, and all is as it was.
        """
        self._write(files, keep=False)

    def add(self, name: str, content: bytes) -> None:
        """Write one file beside the others, in place of what we wrote there before."""
        self._write({name: content}, keep=True)

    def _write(self, files: Mapping[str, str | bytes | PiecesFile], *, keep: bool) -> None:
        """Write files into the folder that is there now, and into no other."""
        made: list[Path] = []
        try:
            made = make_folder(self.folder)
            with held(self.folder) as self._place:
                if keep:
                    self.check_kind()
                else:
                    self._check_list()
                    self.check()
                self._write_held(files, keep=keep)
        except OSError as error:
            raise not_written(self.folder, error) from error
        finally:
            self._place = self.folder
            remove_empty(made)

    def _check_list(self) -> None:
        """Refuse a folder whose list is another than it was."""
        if _list_in(self._place) != self._list:
            raise InputError(
                f"{self.folder}: somebody else wrote into it meanwhile, so nothing there is "
                "replaced; name another folder"
            )

    def _write_held(self, files: Mapping[str, str | bytes | PiecesFile], *, keep: bool) -> None:
        """Write files under other names, list them, and then give them their own."""
        contents = {n: c.encode() if isinstance(c, str) else c for n, c in files.items()}
        for name in contents:
            if not self.kind.writes(name):
                raise ValueError(f"{name}: is no file of {self.kind.title}")
            self.refuse(name)
        before, new = self._sums, {n: {_sum_of(c)} for n, c in contents.items()}
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
                self._list_again(before, partials.values(), made)
                raise
            self._put_in_place(partials, () if keep else before.keys() - new.keys())
            self._list_sums(before | new if keep else new)
        except OSError as error:
            raise not_written(at, error) from error
        finally:
            with contextlib.suppress(OSError):
                _remove(partials.values())

    def _list_again(
        self, sums: Mapping[str, set[str]], partials: Iterable[Path], made: Iterable[Path]
    ) -> None:
        """Restore a folder's list after files could not be written."""
        with contextlib.suppress(OSError):
            _remove(partials)
            if sums:
                self._list_sums(sums)
            elif self._there:
                (self._place / SUMS).unlink(missing_ok=True)
        remove_empty(made)

    def _put_in_place(self, partials: Mapping[str, Path], old: Iterable[str]) -> None:
        """Give files their names; take away what is old, and what a killed process left."""
        *_, last = partials
        _remove(self._place / name for name in (*([last] if last in self._sums else ()), *old))
        left = (self._place / name for name in _names_in(self._place) if self._is_left(name))
        _remove([path for path in left if path not in partials.values()])
        for name, partial in partials.items():
            put_in_place(partial, self._place / name, replace=self._is_ours(name))

    def _is_left(self, name: str) -> bool:
        """Tell whether a file is what a killed process left of one of ours."""
        path = self._place / name
        return whole_name(name) in (*self._sums, SUMS) and path.is_file() and not path.is_symlink()

    def _list_sums(self, sums: Mapping[str, set[str]]) -> None:
        """Write the list: from then on what it names is known as ours, whatever ends us."""
        lines = [f"{one}  {name}" for name, some in sums.items() for one in sorted(some)]
        text = "\n".join([_HEAD.format(self.kind.title), *lines, ""])
        data = text.encode(errors="surrogateescape")
        write_whole(self._place / SUMS, data, replace=self._there is not None)
        self._list, self._there, self._sums = data, self.kind.title, dict(sums)


def _sum_of(content: bytes | PiecesFile) -> str:
    """Return the sum of what is to be a file."""
    return content.sum if isinstance(content, PiecesFile) else sha256(content).hexdigest()


def _in_the_way(path: Path, what: str) -> InputError:
    """Return the error for a file or folder that is not replaced."""
    return InputError(
        f"{path}: {what}, so it is not replaced; move it away, or name another folder"
    )


def _list_in(folder: Path) -> bytes | None:
    """Return the list that stands in a folder; None where there is none that is a file."""
    path = folder / SUMS
    if path.is_symlink():
        return None
    try:
        return read_file(path)
    except OSError:
        return None


def _sums_of(text: bytes | None) -> tuple[str | None, dict[str, set[str]]]:
    """Read from a list of ours what is there, and the sums of its files; a user's has none.

    While files are replaced, the list has the old sums and the new ones.
    """
    head, *lines = (text or b"").decode(errors="surrogateescape").split("\n")
    kind = next((kind for kind in KINDS if head == _HEAD.format(kind.title)), None)
    sums: dict[str, set[str]] = {}
    if kind is None or not lines or lines.pop():  # each line has its end
        return None, {}
    for line in lines:
        found = _LINE.fullmatch(line)
        if not found or not kind.writes(found[2]):
            return None, {}
        sums.setdefault(found[2], set()).add(found[1])
    return kind.title, sums


def _names_in(folder: Path) -> Iterator[str]:
    """Name all that is in a folder and below it, relative to it; no link is followed."""
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            yield (Path(place) / name).relative_to(folder).as_posix()


def _remove(paths: Iterable[Path]) -> None:
    """Remove files, as far as they are there."""
    for path in paths:
        path.unlink(missing_ok=True)
