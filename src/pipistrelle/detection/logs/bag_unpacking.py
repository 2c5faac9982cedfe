"""What a bag's compressed parts may unpack to: a few bytes can claim to be gigabytes.

rosbags unpacks a chunk or a message whole, however large it becomes, and a compressed file of a
folder into the temporary folder. While a bag is open, its decompressors stop at a largest size. An
older rosbags, which has other decompressors, unpacks without a limit.
"""

import bz2
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from tempfile import gettempdir
from types import SimpleNamespace
from typing import Any

MOST_UNPACKED = 128_000_000
"""Of a chunk or a message [bytes]; writers make chunks of 1 to 4 MB, of more than one message."""
ROOM = 0.5
"""Share of the free room of the temporary folder that a compressed file may take."""
MOST_FRAMES = 100
"""Of compressed data that follow one another in a chunk or a message; writers make one."""


@contextmanager
def bounded_unpacking() -> Iterator[None]:
    """Let rosbags unpack so much and no more; its own functions are put back at the end."""
    try:
        from lz4.frame import LZ4FrameDecompressor
        from rosbags.rosbag1.reader import decompressors as of_first
        from rosbags.rosbag2 import reader, storage_mcap

        of_second: Any = reader
        of_mcap, zstd = storage_mcap.DECOMPRESSORS, of_second.zstd
        makers = {
            "zstd": zstd.ZstdDecompressor,
            "lz4": LZ4FrameDecompressor,
            "bz2": bz2.BZ2Decompressor,
        }
    except (ImportError, AttributeError):
        yield
        return
    unpack = {name: partial(_unpacked, make) for name, make in makers.items()}
    ours = SimpleNamespace(**vars(zstd))
    ours.decompress, ours.open = unpack["zstd"], lambda *words: _File(zstd.open(*words))
    kept, kept_of_first = dict(of_mcap), dict(of_first)
    try:
        of_mcap.update({name: unpack[name] for name in ("lz4", "zstd")})
        of_first.update({name: unpack[name] for name in ("lz4", "bz2")})
        of_second.zstd = ours
        yield
    finally:
        of_mcap.update(kept)
        of_first.update(kept_of_first)
        of_second.zstd = zstd


def _unpacked(make: Callable[[], Any], data: bytes, _: int = 0) -> bytes:
    """Unpack all frames that follow one another; the size that a chunk claims is compared later."""
    whole, left = b"", data
    for _ in range(MOST_FRAMES):
        frame = make()
        whole += frame.decompress(left, MOST_UNPACKED + 1 - len(whole))
        if len(whole) > MOST_UNPACKED:
            raise ValueError(f"{len(data)} bytes that unpack to more than {MOST_UNPACKED}")
        if not frame.eof:
            raise ValueError("compressed data that were cut")
        if not (left := frame.unused_data):
            return whole
    raise ValueError(f"more than {MOST_FRAMES} frames of compressed data")


class _File:
    """A compressed file that is read while it takes not too much of the room that there is."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._left = ROOM * shutil.disk_usage(gettempdir()).free

    def __enter__(self) -> "_File":
        """Lend it."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self._file.close()

    def read(self, size: int = -1) -> bytes:
        """Read the next bytes."""
        data = self._file.read(size)
        self._left -= len(data)
        if self._left < 0.0:
            raise ValueError(
                f"a compressed file that takes more than {ROOM:.0%} of the room in {gettempdir()}"
            )
        return data
