"""One process compiles a kernel; another that needs it waits, and loads what the first has kept.

A process that compiles holds a lock on one byte of a file in the folder of kernels, and the system
lets go of it when the process ends, however it ends. Where files cannot be locked, or a process
that was stopped holds on to its turn, each compiles for itself.
"""

import os
import time
from contextlib import suppress
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
