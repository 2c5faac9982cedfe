"""The file of a `Slam`: what it is made of, and all that it knows, guarded by a sum.

What is known is pickled. A pickle can make any function run, so of a file only arrays, plain
containers and the records of this package are taken, and those of an estimator from outside where
the caller names it.
"""

import json
import pickle
from collections.abc import Mapping
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

from pipistrelle.config import InputError
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.files import printable, read_file, read_named, write_whole
from pipistrelle.refusals import refusal, shown
from pipistrelle.version import find_version

HEAD = b"# Of Pipistrelle: a drive to go on from\n"
"""First line of the file; the second is the sum of all that follows it."""
_ROOMS = ("pipistrelle.detection.", "pipistrelle.estimation.", "pipistrelle.config.")
_PLAIN = {
    ("_codecs", "encode"),
    ("builtins", "bytes"),
    ("builtins", "complex"),
    ("builtins", "frozenset"),
    ("builtins", "set"),
    ("builtins", "slice"),
    ("collections", "OrderedDict"),
    ("collections", "deque"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
}
"""What is allowed besides records: it holds values, and does nothing."""


def write_state(path: Path, header: Mapping[str, Any], content: Mapping[str, Any]) -> None:
    """Write the file, in place of one that was written here before."""
    try:
        known = pickle.dumps(dict(content), protocol=5)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        found = f"a belief that cannot be written ({error})"
        raise refusal(path, found, "one that can be pickled", "correct the estimator") from None
    line = json.dumps({"version": find_version(), **header}).encode()
    body = line + b"\n" + known
    try:
        if path.exists() and not read_file(path).startswith(HEAD):
            found, expected = "a file that Slam.save did not write", "a new file, or one to replace"
            raise refusal(path, found, expected, "name another")
        write_whole(path, HEAD + sha256(body).hexdigest().encode() + b"\n" + body)
    except InputError:
        raise
    except (OSError, ValueError) as error:  # a ValueError is of a name that no file can have
        found = f"that it cannot be written ({getattr(error, 'strerror', error)})"
        fix = "name a file in a folder that is there and can be written"
        raise refusal(printable(path), found, "a file", fix) from None


def read_state(path: Path, own: str | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what the file says and holds; `own` names an estimator from outside."""
    data = read_named(path, "a file of Slam.save")
    found = "a file that Slam.save did not write"
    if data.startswith(HEAD):
        sum_, _, body = data[len(HEAD) :].partition(b"\n")
        if sum_ == sha256(body).hexdigest().encode():
            return _content(path, body, own)
        found = "a file that has changed since Slam.save wrote it"
    raise refusal(path, found, "one of Slam.save, as it was written", "name another")


def _content(path: Path, body: bytes, own: str | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the header and what follows it; bytes that have a sum may still be anybody's."""
    line, _, known = body.partition(b"\n")
    try:
        header = json.loads(line)
        _check_header(path, header, own)
        return header, _Records(BytesIO(known), own).load()
    except InputError:
        raise
    except Exception as error:
        raise not_saved(path, error) from None


def not_saved(path: Path, error: Exception) -> InputError:
    """Return the refusal of a file whose sum is right and whose content is not."""
    found = f"what Slam.save did not write ({type(error).__name__})"
    return refusal(path, found, "one of Slam.save, as it was written", "name another")


def _check_header(path: Path, header: Mapping[str, Any], own: str | None) -> None:
    """Refuse what another version wrote, and an estimator from outside that is not named."""
    here, there, name = find_version(), header["version"], header["filter"]
    if there != here:
        fix = f"load it with Pipistrelle {there}, or drive on from a new start"
        raise refusal(path, f"a drive of Pipistrelle {there}", f"one of {here}", fix)
    if name != (own or name) or (own is None and name not in CATALOGUE):
        found = f"a drive by the filter {shown(name)}"
        expected = f"one by {own}" if own else "an estimator of this package"
        raise refusal(path, found, expected, f"if you trust the file, load(..., filter={name!r})")


class _Records(pickle.Unpickler):
    """Reads arrays, containers and records of the rooms that estimators know."""

    def __init__(self, file: BytesIO, own: str | None) -> None:
        super().__init__(file)
        self._own = own.partition(":")[0] if own else None

    def find_class(self, module: str, name: str) -> Any:
        """Return a class that a file may hold; refuse all else."""
        ours = f"{module}.".startswith(_ROOMS) or module == self._own
        if (module, name) in _PLAIN or ours:
            kind = super().find_class(module, name)
            if not ours or isinstance(kind, type):
                return kind
        raise refusal("the saved drive", f"{module}.{name}", "records of values", "do not load it")
