"""ROS bags without ROS: list the topics of a bag and read messages, with bounded memory.

ROS 1 files (.bag) and ROS 2 files and folders (.mcap, .db3) are read by the package rosbags, of the
extra ``ros``; `bag_messages` defines the message types. Parsers of a file's bytes may fail in any
way, and each failure becomes an error that names the file and topic.

A few compressed bytes can claim to be gigabytes. rosbags unpacks a chunk or a message whole, and a
compressed file of a folder into the temporary folder. While a bag is open, its decompressors stop
at a largest size. Older versions of rosbags, with other decompressors, unpack without a limit.
"""

import bz2
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import gettempdir
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

from pipistrelle.config import InputError
from pipistrelle.detection.logs.bag_messages import types_of
from pipistrelle.files import check_ordinary
from pipistrelle.refusals import meant, refusal, shown

MOST_UNPACKED = 128_000_000
"""Largest unpacked chunk or message [bytes]; writers make chunks of 1 to 4 MB."""
ROOM = 0.5
"""Share of the temporary folder's free space that a compressed file may take."""
MOST_FRAMES = 100
"""Most consecutive frames of compressed data in a chunk or a message; writers make one."""


@contextmanager
def bounded_unpacking() -> Iterator[None]:
    """Limit the bytes that rosbags unpacks within the context, by replacing its decompressors."""
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
    """Unpack all consecutive frames of compressed data; raise if they exceed `MOST_UNPACKED`."""
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
    """A compressed file that raises if it unpacks to more than a share of the free space."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._left = ROOM * shutil.disk_usage(gettempdir()).free

    def __enter__(self) -> "_File":
        """Return this file, for use in a `with` statement."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the compressed file."""
        self._file.close()

    def read(self, size: int = -1) -> bytes:
        """Read the next unpacked bytes; raise if the file exceeds its limit."""
        data = self._file.read(size)
        self._left -= len(data)
        if self._left < 0.0:
            room = f"{ROOM:.0%} of the room in {gettempdir()}"
            raise ValueError(f"a compressed file that takes more than {room}")
        return data


if TYPE_CHECKING:
    from rosbags.interfaces import Connection

BAGS = (".bag", ".mcap", ".db3")
"""Suffixes of ROS bags: the first of ROS 1, the others of ROS 2."""
MOST_METADATA = 1_000_000
"""Largest metadata file of a folder [bytes]; a larger file would take minutes to read."""


class Message(NamedTuple):
    """A decoded message of a bag, with its topic, number and time of reception."""

    topic: str
    number: int
    """Number in the topic, from 1."""
    received: float
    """Time of reception, or of writing [s]."""
    content: Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Topic:
    """Name, message type, message count and time span of a topic of a bag."""

    name: str
    type: str
    """Name of its messages' type, with ``/msg/``; all names, if it has several types."""
    count: int
    """Number of messages."""
    span: tuple[float, float] | None = None
    """Times of reception of the first and last message [s]; None if they were not read."""


class Bag:
    """An open ROS bag that lists topics and yields messages."""

    def __init__(self, path: Path, reader: Any) -> None:
        self.path = path
        self._reader = reader
        self._by_topic: dict[str, list[Connection]] = {}
        for connection in reader.connections:
            self._by_topic.setdefault(connection.topic, []).append(connection)

    @property
    def topics(self) -> dict[str, Topic]:
        """Topics of the bag by name, with their message types and counts."""
        return {
            name: Topic(
                name=name,
                type=", ".join(sorted({one.msgtype for one in known})),
                count=sum(one.msgcount for one in known),
            )
            for name, known in sorted(self._by_topic.items())
        }

    def seen(self) -> list[Topic]:
        """Read all messages; list the topics with their message counts and times."""
        found: dict[str, tuple[int, int, int]] = {}
        with faults_named(str(self.path)):
            for connection, stamp, _ in self._reader.messages():
                count, first, last = found.get(connection.topic, (0, stamp, stamp))
                found[connection.topic] = (count + 1, min(first, stamp), max(last, stamp))
        self._check_whole({name: found.get(name, (0,))[0] for name in self._by_topic})
        return [
            Topic(name=name, type=topic.type, count=count, span=(first / 1e9, last / 1e9))
            for name, topic in self.topics.items()
            for count, first, last in (found.get(name, (0, 0, 0)),)
        ]

    def messages(self, names: Iterable[str]) -> Iterator[Message]:
        """Yield the messages of some topics in the order of reception."""
        wanted = [one for name in names for one in self._by_topic.get(name, ())]
        if not wanted:
            return
        decoders = {}
        for one in wanted:
            with faults_named(f"{self.path}, topic {one.topic}"):
                decoders[one.id] = _decoder(one)
        count = dict.fromkeys((one.topic for one in wanted), 0)
        raw = iter(self._reader.messages(connections=wanted))
        while True:
            with faults_named(str(self.path)):
                item = next(raw, None)
            if item is None:
                return self._check_whole(count)
            connection, stamp, data = item
            topic = connection.topic
            count[topic] += 1
            with faults_named(f"{self.path}, topic {topic}, message {count[topic]}"):
                content = decoders[connection.id](data)
            yield Message(topic, count[topic], stamp / 1e9, content)

    def _check_whole(self, count: dict[str, int]) -> None:
        """Raise if fewer messages were found than the bag counts; rosbags skips some."""
        for name, found in count.items():
            said = sum(one.msgcount for one in self._by_topic[name])
            if found < said:
                fix = f"name its file (.mcap, .db3), or {_MEND}" if self.path.is_dir() else _MEND
                where = f"{self.path}, topic {name}"
                raise refusal(where, f"{found} messages", f"the {said} that the bag counts", fix)

    def checked(self, name: str, types: Iterable[str], option: str) -> str:
        """Return a topic's name from an option; raise if the bag lacks it or its type is wrong."""
        topics, where = self.topics, f"{self.path}, option {option}"
        if name not in topics:
            near = meant(name, topics)
            fix = f"did you mean {near}?" if near else "--topics lists them"
            raise refusal(where, f"no topic {shown(name)}", "one of the bag's", fix)
        if topics[name].type not in types:
            found = f"{name} of the type {topics[name].type}"
            raise refusal(where, found, " or ".join(types), "name another; --topics lists them")
        return name


@contextmanager
def opened(path: Path) -> Iterator[Bag]:
    """Open a ROS bag within the context; raise if the path is not a readable bag."""
    whole = _storage(path)
    need_rosbags(str(path))
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    kind: Any = Reader1 if whole.suffix == ".bag" and whole.is_file() else Reader2
    with ExitStack() as stack:
        stack.enter_context(bounded_unpacking())
        with faults_named(str(path)):
            reader = stack.enter_context(kind(whole))
            if kind is Reader2:
                complete_index(getattr(reader.storage, "storages", [reader.storage]))
            bag = Bag(path, reader)
        yield bag


def storages(folder: Path) -> list[Path]:
    """List the storage files in the folder of a ROS 2 bag."""
    return sorted(path for path in folder.iterdir() if path.suffix in BAGS[1:])


def complete_index(storages: Iterable[Any]) -> None:
    """Make rosbags read all chunks of an MCAP file if its index counts too few messages.

    rosbags skips a chunk whose index counts no message of a topic, but that index is optional. If
    the file's index lacks a chunk, rosbags is made to read the file record by record.
    """
    for storage in storages:
        if not (chunks := getattr(storage, "chunks", None)):
            continue
        if storage.statistics.chunk_count > len(chunks):
            chunks.clear()
        indexed = Counter[int]()
        for chunk in chunks:
            indexed.update(chunk.channel_count)
        said = storage.statistics.channel_message_counts
        lacks = any(indexed[channel] < count for channel, count in said.items())
        for chunk in chunks:
            if lacks or not chunk.channel_count:
                chunk.channel_count.update(dict.fromkeys(storage.channels, 1))


def need_rosbags(where: str) -> None:
    """Raise if rosbags is not installed."""
    try:
        import rosbags.rosbag1
        import rosbags.rosbag2  # noqa: F401
    except ImportError:
        fix = "python -m pip install rosbags"
        raise InputError(f"{where}: needs rosbags, which is not installed; {fix}") from None


def _storage(path: Path) -> Path:
    """Return a bag's path to open: the given path, or a folder's only file without metadata."""
    if not path.exists():
        found = "a link to no file" if path.is_symlink() else "no such file"
        raise refusal(path, found, "a ROS bag", "check the path")
    if not path.is_dir():
        check_ordinary(path)
        return path
    inside = storages(path)
    for one in (path / "metadata.yaml", *inside):
        check_ordinary(one)
    if (path / "metadata.yaml").exists():
        if (size := (path / "metadata.yaml").stat().st_size) > MOST_METADATA:
            found, expected = f"{size} bytes", f"at most {MOST_METADATA}"
            raise refusal(path / "metadata.yaml", found, expected, _MEND)
        return path
    if len(inside) > 1:
        fix = "make it with `ros2 bag reindex`, or name one of the files"
        raise refusal(path, f"{len(inside)} files without metadata.yaml", "metadata.yaml", fix)
    return inside[0]


@contextmanager
def faults_named(where: str) -> Iterator[None]:
    """Convert any failure within the context into an `InputError` that names the place."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except MemoryError:
        raise refusal(where, "more than there is memory for", "a sound bag", _MEND) from None
    except Exception as error:
        words = " ".join(str(error).split()) or "nothing said"
        found = f"bytes that cannot be read ({type(error).__name__}: {words[:160]})"
        raise refusal(where, found, "a sound bag", _MEND) from None


_MEND = "mend it (`ros2 bag reindex`, `mcap recover`, `rosbag reindex`), or record it again"


def _decoder(connection: "Connection") -> Callable[[bytes], Any]:
    """Return the function that decodes a ROS connection's messages from bytes."""
    from rosbags.interfaces import ConnectionExtRosbag1, MessageDefinitionFormat

    first, name = isinstance(connection.ext, ConnectionExtRosbag1), connection.msgtype
    form = getattr(connection.ext, "serialization_format", "cdr")
    if form != "cdr":
        raise InputError(f"found messages as {form}, expected CDR; convert the bag")
    language, text = connection.msgdef
    idl, told = language == MessageDefinitionFormat.IDL, language != MessageDefinitionFormat.NONE
    store = types_of(name, text if told else "", idl=idl, first=first)
    read = store.deserialize_ros1 if first else store.deserialize_cdr
    return lambda data: read(data, name)
