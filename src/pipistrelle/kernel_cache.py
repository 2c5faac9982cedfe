"""Files of compiled kernels, each with its sum: what was cut or changed is compiled anew.

Numba keeps a kernel (what `pipistrelle.jit` compiles) in two files, an index and its code, and runs
whatever it finds there. Here each ends in the SHA-256 of what stands before it, which Numba does
not look at when it reads them.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

from numba.core.caching import IndexDataCacheFile

from pipistrelle.kernel_folder import close_to_others
from pipistrelle.kernel_turns import TURN

_said: set[str] = set()
"""What was said once need not be said for every kernel."""


class CheckedFiles(IndexDataCacheFile):
    """A kernel's two files."""

    def load(self, key: Any) -> Any:
        """Load a kernel; None if it must be compiled, for which it is this process's turn."""
        found = super().load(key)
        if found is None:
            TURN.take(Path(self._index_path))
            found = super().load(key)  # another process may have kept it meanwhile
        return found

    def save(self, key: Any, data: Any) -> None:
        """Keep what was compiled, if there is room: without it, it is compiled again next time."""
        try:
            super().save(key, data)
        except OSError as error:
            _say(
                f"{Path(self._cache_path).parent}: compiled kernels could not be kept "
                f"({error.strerror}), so they are compiled at every start; make room or set "
                "NUMBA_CACHE_DIR"
            )

    def _load_index(self) -> dict[Any, str]:
        """Load the index of kernels; it is empty where the file is damaged."""
        return super()._load_index() if self._is_sound(Path(self._index_path)) else {}

    def _load_data(self, name: str) -> Any:
        """Return a kernel's code; Numba takes an error for a file that is gone."""
        if not self._is_sound(Path(self._data_path(name))):
            raise FileNotFoundError(name)
        return super()._load_data(name)

    def _is_sound(self, path: Path) -> bool:
        """Tell whether a file is as it was written, or is not there; remove any other."""
        try:
            found = path.read_bytes()
        except FileNotFoundError:
            return True
        except OSError:
            return False
        if sha256(found[:-32]).digest() == found[-32:]:
            return True
        _say(f"{path.parent.parent}: compiled kernels were damaged, and are compiled anew")
        with suppress(OSError):
            path.unlink()
        return False

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[BytesIO]:  # pyrefly: ignore[bad-override]
        """Write a file, and its sum after it."""
        buffer = BytesIO()
        yield buffer
        content = buffer.getvalue()
        with super()._open_for_write(filepath) as file:
            file.write(content + sha256(content).digest())


def checked(dispatcher: Any) -> Any:
    """Let a compiled function keep its code in checked files.

    Where compilation is switched off, the function itself takes the dispatcher's place.
    """
    if cache := getattr(dispatcher, "_cache", None):
        files = cache._cache_file
        with suppress(OSError):
            close_to_others(Path(files._cache_path))
        cache._cache_file = CheckedFiles.__new__(CheckedFiles)
        cache._cache_file.__dict__.update(files.__dict__)
    return dispatcher


def _say(line: str) -> None:
    """Print a message once."""
    if line not in _said:
        _said.add(line)
        with suppress(OSError, AttributeError):  # there is no reader
            print(f"pipistrelle: {line}", file=sys.stderr)
