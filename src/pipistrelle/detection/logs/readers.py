"""The formats of recorded logs: one entry each, found by what a folder holds.

To add one, write what reads it in a file of its own beside this one, and give it an entry here. An
entry's reader is imported when a log is read: the command line names the formats at once. The
truth of a log is none of this room's business; whoever may see it finds it by the entry's name.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipistrelle.detection.logs.recording import Log


_OTHERS = {
    frozenset({".wav", ".flac", ".aif", ".aiff", ".ogg", ".mp3"}): "an audio recording, which is "
    "no log; make a log folder of it with `pipistrelle hear` (docs/sound.md)",
}
"""Recordings that have no reader, by the endings of their files."""
Robot = int | str
"""Whose log of several: by number or by name, as the format has it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """How logs of one format are recognised and read."""

    name: str
    title: str
    """Name in refusals."""
    recognises: Callable[[Path], bool]
    """Tells by its files whether it holds such a log."""
    read: "Callable[..., Log]"
    """Reads the folder or file, of one robot where it holds several, as a `Log`."""
    configured: bool = False
    """Whether ``read`` is given the settings of the section ``bag``, after the path."""
    robots: Callable[[Path], Sequence[Robot]] | None = None
    """Lists the robots whose logs it holds, by number or by name: ``read`` is given one of
    these. Without it there is one, and it needs no name."""
    files: tuple[str, ...] = ("*",)
    """Patterns of what it may read in the folder, by which a log is known to be the same again."""
    help: str = ""
    robot_help: str = ""
    """`help` and `robot_help`: what the command line says of the folder, and of whom ``--robot``
    chooses from."""


def reader_of(folder: Path, readers: Sequence[Reader] = ()) -> Reader:
    """Find the reader of a folder: the first that recognises it.

    `readers`: asked before the package's own. A folder that none recognises goes to the reader of
    the package's own log folders, which says what is missing.

    >>> reader_of(Path("/nowhere")).name
    'folder'
    >>> tape = Reader(name="tape", title="a tape", recognises=lambda folder: True, read=print)
    >>> reader_of(Path("/nowhere"), [tape]).name
    'tape'
    """
    known = (*readers, *READERS)
    return next((reader for reader in known if reader.recognises(folder)), LOG_FOLDER)


def recording_of(path: Path) -> str | None:
    """Name the kind of a recording that no reader takes, and say what can be done with it.


    >>> recording_of(Path("walk.wav"))[:36], recording_of(Path("walk"))
    ('an audio recording, which is no log;', None)
    """
    endings = {path.suffix.lower()}
    if path.is_dir():
        endings |= {file.suffix.lower() for file in path.iterdir()}
    return next((words for known, words in _OTHERS.items() if endings & known), None)


def _read_log_folder(folder: Path) -> "Log":
    """Read a log folder."""
    from pipistrelle.detection.logs.folder import read_log

    return read_log(folder)


def _is_bag(path: Path) -> bool:
    """Tell whether a path is named as a ROS bag, or is a folder of ROS 2."""
    from pipistrelle.detection.logs.bag import BAGS, storages

    if not path.is_dir():
        return path.suffix in BAGS
    return (path / "metadata.yaml").exists() or bool(storages(path))


def _read_bag(path: Path, settings: Any, **framed: Any) -> "Log":
    """Read a ROS bag."""
    from pipistrelle.detection.logs.bag_log import read_bag

    return read_bag(path, settings, **framed)


def _is_mrclam(folder: Path) -> bool:
    """Tell whether a folder is a MRCLAM set: it has barcodes, or odometry of a robot."""
    return (folder / "Barcodes.dat").exists() or any(folder.glob("Robot*_Odometry.dat"))


def _mrclam_robots(folder: Path) -> list[Robot]:
    """List the robots whose odometry is there, by number or by the text in its place."""
    files = sorted(path.name for path in folder.glob("Robot*_Odometry.dat"))
    names = [name.removeprefix("Robot").removesuffix("_Odometry.dat") for name in files]
    numbers = {str(number): number for number in range(1, 6)}
    return [numbers.get(name, name) for name in names]


def _read_mrclam(folder: Path, robot: int, **framed: Any) -> "Log":
    """Read one robot's log of a MRCLAM set."""
    from pipistrelle.detection.logs.folder import read_mrclam

    return read_mrclam(folder, robot, **framed)


LOG_FOLDER = Reader(
    name="folder",
    title="a log folder",
    help="a log folder",
    recognises=lambda folder: (folder / "log.toml").exists(),
    read=_read_log_folder,
    files=("log.toml", "odometry.csv", "measurements.csv"),
)
MRCLAM = Reader(
    name="mrclam",
    title="a MRCLAM set",
    help="a UTIAS MRCLAM folder",
    robot_help="a MRCLAM folder, 1 to 5",
    recognises=_is_mrclam,
    read=_read_mrclam,
    robots=_mrclam_robots,
    files=("*.dat",),
)
ROS_BAG = Reader(
    name="bag",
    title="a ROS bag",
    help="a ROS bag (.mcap, .db3, .bag, a folder of ROS 2)",
    recognises=_is_bag,
    read=_read_bag,
    configured=True,
    files=("metadata.yaml", "*.db3*", "*.mcap*"),
)
READERS = (LOG_FOLDER, MRCLAM, ROS_BAG)
"""All formats, in the order in which they are asked."""
