"""Files that are whole or not there, and a list of those in a folder that are ours.

The list is ``SHA256SUMS``, as ``sha256sum -c`` reads it; its first line says what of ours is there.
Only what it names, and what still has the sum that stands there, is ever replaced or removed, and
only by its like: everything else is somebody's.
"""

import contextlib
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

from pipistrelle.config import InputError

SUMS = "SHA256SUMS"
RESULTS, REPORT, LOG, WORLD, COMPARISON = KINDS = (
    "results", "a report", "a log", "a world", "a comparison",
)  # fmt: skip
_KIND = "# Of Pipistrelle: {}\n"
_LINE = re.compile(r"([0-9a-f]{64}) [ *](.+)")


class OwnFiles:
    """What we wrote into a folder, by its list of sums; and the way to write more.

    Parameters
    ----------
    folder : Path
    kind : str
        What they are together: results, a report, a log, a world. One kind never replaces another.

    Raises
    ------
    InputError
        Where what stands in the list's place is no file.

    Examples
    --------
    >>> with TemporaryDirectory() as name:
    ...     own, notes = OwnFiles(Path(name), "a log"), Path(name) / "notes.txt"
    ...     own.write("one.txt", "word")
    ...     _ = notes.write_text("a user's")
    ...     own.clear()
    ...     [path.name for path in Path(name).iterdir()]
    ['notes.txt']
    """

    def __init__(self, folder: Path, kind: str) -> None:
        self.folder, self.kind = folder, kind
        check_ordinary(folder / SUMS)
        try:
            lines = (folder / SUMS).read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError):
            lines = []
        heads = {line: told for told in KINDS for line in [_KIND.format(told).strip()]}
        self._there = next((heads[line] for line in lines if line in heads), kind)
        found = [match.groups() for line in lines if (match := _LINE.fullmatch(line))]
        self._sums = {name: its_sum for its_sum, name in found if _is_inside(name)}

    def __bool__(self) -> bool:
        """Whether we wrote anything here."""
        return bool(self._sums)

    @property
    def there(self) -> str | None:
        """What of ours is here, as `KINDS` have it; None where nothing is."""
        return self._there if self._sums else None

    def __contains__(self, name: str) -> bool:
        """Whether a file is on the list: we wrote it, or began to."""
        return name in self._sums

    def read(self, name: str) -> bytes:
        """Read a file that is as we wrote it.

        Parameters
        ----------
        name : str
            Relative to the folder.

        Returns
        -------
        bytes

        Raises
        ------
        InputError
            Where it is not there, cannot be read, or is not as we wrote it.
        """
        path = self.folder / name
        try:
            check_ordinary(path)
            data = path.read_bytes()
        except FileNotFoundError:
            raise InputError(f"{path}: is missing; run again what wrote the others") from None
        except OSError as error:
            raise InputError(f"{path}: could not be read ({error.strerror})") from error
        if name not in self._sums:
            raise InputError(f"{path}: is not Pipistrelle's: {SUMS} does not name it")
        if sha256(data).hexdigest() != self._sums[name]:
            raise InputError(
                f"{path}: was changed since Pipistrelle wrote it; run again what wrote it"
            )
        return data

    def check(self, names: Iterable[str] = ()) -> None:
        """Refuse a folder in which what would be replaced is not as we wrote it.

        Parameters
        ----------
        names : iterable of str
            Relative to the folder; what we wrote there before is checked in any case.

        Raises
        ------
        InputError
            With the file.
        """
        if self._sums and self._there != self.kind:
            raise InputError(
                f"{self.folder}: holds {self._there} of Pipistrelle, which {self.kind} does not "
                "replace; name another folder"
            )
        for name in sorted({*names, *self._sums}):
            self.refuse(name)

    def clear(self, names: Iterable[str] = ()) -> None:
        """Remove what we wrote, and nothing else.

        Parameters
        ----------
        names : iterable of str
            What is to be written next, checked with the rest.

        Raises
        ------
        InputError
            As `check`, before anything is removed; or where a file cannot be removed.
        """
        self.check(names)
        try:
            for name in (*self._sums, SUMS):
                if not (self.folder / name).exists():  # we were stopped while we wrote it
                    self._partial(name).unlink(missing_ok=True)
                (self.folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise _unwritable(self.folder, error) from error
        self._sums.clear()

    def write(self, name: str, content: str | bytes) -> None:
        """Write a file, unless somebody else's is there.

        Parameters
        ----------
        name : str
            Relative to the folder, with slashes; folders on the way are made.
        content : str or bytes

        Raises
        ------
        InputError
            As `check`, or where it cannot be written.
        """
        data = content.encode() if isinstance(content, str) else content
        self.refuse(name)
        path = self.folder / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._note(name, sha256(data).hexdigest())
            write_whole(path, data)
        except OSError as error:
            raise _unwritable(path, error) from error

    @contextmanager
    def room(self, under: str = "") -> Iterator[Path]:
        """Lend a folder, and put in place what was written there, when all of it is whole.

        Parameters
        ----------
        under : str
            Where it belongs, relative to the folder.

        Yields
        ------
        Path
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with TemporaryDirectory(prefix=".pipistrelle-", dir=self.folder) as place:
                yield Path(place)
                for path in sorted(Path(place).iterdir()):
                    self.write((Path(under) / path.name).as_posix(), path.read_bytes())
        except OSError as error:
            raise _unwritable(self.folder, error) from error

    def refuse(self, name: str) -> None:
        """Refuse to replace a file that is not as we wrote it.

        Parameters
        ----------
        name : str
            Relative to the folder; what is not there may be written.

        Raises
        ------
        InputError
            With the file.
        """
        path, known = self.folder / name, name in self._sums
        if not known and os.path.lexists(self._partial(name)):
            path = self._partial(name)
        elif not os.path.lexists(path) or self._is_ours(name):
            return
        what = "was changed since Pipistrelle wrote it" if known else "is not Pipistrelle's"
        raise InputError(
            f"{path}: {what}, so it is not replaced; move it away, or name another folder"
        )

    def _is_ours(self, name: str) -> bool:
        """Whether a file is as we wrote it."""
        path = self.folder / name
        try:
            if not path.is_file():  # a pipe may never end
                return False
            return sha256(path.read_bytes()).hexdigest() == self._sums.get(name)
        except OSError:
            return False

    def _partial(self, name: str) -> Path:
        """Return where a file stands until it is whole."""
        path = self.folder / name
        return path.with_name(f"{path.name}.partial")

    def _note(self, name: str, its_sum: str) -> None:
        """Put a file on the list, before it is there: whatever ends us, it is known as ours."""
        known = name in self._sums
        self._sums[name] = its_sum
        if known:
            lines = [f"{its}  {other}\n" for other, its in self._sums.items()]
            head = _KIND.format(self.kind)
            write_whole(self.folder / SUMS, "".join([head, *lines]).encode())
        else:
            with (self.folder / SUMS).open("a", encoding="utf-8", newline="\n") as file:
                head = "" if file.tell() else _KIND.format(self.kind)
                file.write(f"{head}{its_sum}  {name}\n")


def _is_inside(name: str) -> bool:
    """Whether a name on a list stays in the list's folder."""
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts


def _unwritable(path: Path, error: OSError) -> InputError:
    """Say that a file cannot be written."""
    return InputError(
        f"{path}: could not be written ({error.strerror}); make room or name another folder"
    )


def check_ordinary(path: Path) -> None:
    """Refuse to read what stands in a file's place and is none: a pipe or a device may never end.

    Parameters
    ----------
    path : Path
        Of a file in a folder of ours; it may be missing.

    Raises
    ------
    InputError
        For a folder, a pipe or a device.

    Examples
    --------
    >>> check_ordinary(Path("/dev/null"))
    Traceback (most recent call last):
    pipistrelle.config.InputError: /dev/null: is no file; remove what stands in its place
    """
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is no file; remove what stands in its place")


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
