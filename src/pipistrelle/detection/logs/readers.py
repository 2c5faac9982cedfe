"""The formats of recorded logs, and how a log's format is recognised.

To add a format, write its reader in a new file of this folder, and add an entry here. A reader is
imported only when a log is read. The truth of a log is read elsewhere, by the entry's name.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipistrelle.config import InputError
from pipistrelle.files import LOG, REPORT, RESULTS, SOUND, WORLD, OwnFiles
from pipistrelle.refusals import refusal

if TYPE_CHECKING:
    from pipistrelle.detection.logs.recording import Log


STUDY, AUDIO, UNFINISHED = "a study", "an audio recording", "results that are not complete"
_AUDIO = {".wav", ".flac", ".aif", ".aiff", ".ogg", ".mp3"}
"""Suffixes of sound files."""
_MARKS = {
    "plan.toml": STUDY,
    "trials": STUDY,
    "recording.toml": SOUND.title,
    "world.toml": WORLD.title,
    "index.html": REPORT.title,
    "summary.json": RESULTS.title,
    "config.toml": UNFINISHED,
}
"""Kinds of folders by a file that only they contain, in the order in which they are tried."""
_SOLVE = "solve it: `pipistrelle slam {} -o DIR`"
_USES = {
    STUDY: "`pipistrelle report {0}` puts it on a page; `pipistrelle run --settings "
    "{0}/config.toml -o DIR` makes a mission of its settings",
    RESULTS.title: "`pipistrelle view {}` plays results",
    UNFINISHED: "run or solve it again with --overwrite",
    REPORT.title: "open its index.html",
    LOG.title: _SOLVE,
    SOUND.title: "make a log of it: `pipistrelle hear {} -o LOG`",
    AUDIO: "name its folder, or describe it for `pipistrelle hear` (docs/sound.md)",
    WORLD.title: "drive through it: `pipistrelle run --world {}`",
}
"""Hint for a folder of another kind."""
Robot = int | str
"""A robot of a log of several, by number or by name, as the format has it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """A log format: how its logs are recognised and read."""

    name: str
    title: str
    """Name in errors."""
    recognises: Callable[[Path], bool]
    """Return whether a path holds such a log."""
    read: "Callable[..., Log]"
    """Read a path, and a robot if it holds several, as a `Log`."""
    configured: bool = False
    """Whether ``read`` takes the settings of the section ``bag``, after the path."""
    robots: Callable[[Path], Sequence[Robot]] | None = None
    """List the robots of a path, by number or by name; None if a log has only one robot."""
    files: tuple[str, ...] = ("*",)
    """Patterns of files that it may read in a folder; their content identifies a log."""
    help: str = ""
    robot_help: str = ""
    """`help` and `robot_help`: texts of the command line for the path, and for ``--robot``."""


def reader_of(folder: Path, readers: Sequence[Reader] = ()) -> Reader:
    """Return the first reader that recognises the format of a log's folder.

    `readers` are tried before the package's. If none recognises the folder, the reader of log
    folders is returned, whose error names the missing files.

    >>> reader_of(Path("/nowhere")).name
    'folder'
    >>> tape = Reader(name="tape", title="a tape", recognises=lambda folder: True, read=print)
    >>> reader_of(Path("/nowhere"), [tape]).name
    'tape'
    """
    known = (*readers, *READERS)
    return next((reader for reader in known if reader.recognises(folder)), LOG_FOLDER)


def kind_of(path: Path) -> str:
    """Name the kind of a file or folder: results, a study, a log, a recording; "" if unknown.

    >>> kind_of(Path("walk.wav")), kind_of(Path("/nowhere"))
    ('an audio recording', '')
    """
    if path.suffix.lower() in _AUDIO:
        return AUDIO
    titles = (reader.title for reader in READERS if reader.recognises(path))
    marks = (kind for name, kind in _MARKS.items() if (path / name).exists())
    kind = OwnFiles(path, LOG).there or next(titles, "") or next(marks, "")
    if kind == RESULTS.title and not (path / "summary.json").exists():
        return UNFINISHED
    if kind or not path.is_dir():
        return kind
    return AUDIO if any(file.suffix.lower() in _AUDIO for file in path.iterdir()) else ""


def wrong_kind(path: Path, expected: str, file: str) -> InputError:
    """Return the error for a path that lacks `file`: its kind, and the verb that takes it."""
    kind, missing = kind_of(path), "a file" if path.exists() else "no such folder"
    log = kind in (reader.title for reader in READERS)
    other = "name its folder" if path.is_file() else "check the path"
    fix = _SOLVE if log else _USES.get(kind, other)
    return refusal(
        path, kind or (f"no {file}" if path.is_dir() else missing), expected, fix.format(path)
    )


def _imported(module: str, name: str) -> "Callable[..., Log]":
    """Return a log-reading function that imports its module only when it is called."""

    def read(*path_and_robot: Any, **framed: Any) -> "Log":
        read = getattr(import_module(f"pipistrelle.detection.logs.{module}"), name)
        return read(*path_and_robot, **framed)

    return read


def _is_bag(path: Path) -> bool:
    """Return whether a path has the suffix of a ROS bag, or is a folder of a ROS 2 bag."""
    from pipistrelle.detection.logs.bag import BAGS, storages

    if not path.is_dir():
        return path.suffix in BAGS
    return (path / "metadata.yaml").exists() or bool(storages(path))


def _mrclam_robots(folder: Path) -> list[Robot]:
    """List the robots with odometry in a MRCLAM set, by number if the file name has one."""
    files = sorted(path.name for path in folder.glob("Robot*_Odometry.dat"))
    names = [name.removeprefix("Robot").removesuffix("_Odometry.dat") for name in files]
    return [int(name) if name in {*"12345"} else name for name in names]


LOG_FOLDER = Reader(
    name="folder",
    title="a log folder",
    help="a log folder",
    recognises=lambda folder: (folder / "log.toml").exists(),
    read=_imported("folder", "read_log"),
    files=("log.toml", "odometry.csv", "measurements.csv"),
)
MRCLAM = Reader(
    name="mrclam",
    title="a MRCLAM set",
    help="a UTIAS MRCLAM folder",
    robot_help="a MRCLAM folder, 1 to 5",
    recognises=lambda folder: (
        (folder / "Barcodes.dat").exists() or any(folder.glob("Robot*_Odometry.dat"))
    ),
    read=_imported("folder", "read_mrclam"),
    robots=_mrclam_robots,
    files=("*.dat",),
)
ROS_BAG = Reader(
    name="bag",
    title="a ROS bag",
    help="a ROS bag (.mcap, .db3, .bag, a folder of ROS 2)",
    recognises=_is_bag,
    read=_imported("bag_log", "read_bag"),
    configured=True,
    files=("metadata.yaml", "*.db3*", "*.mcap*"),
)
READERS = (LOG_FOLDER, MRCLAM, ROS_BAG)
"""All formats, in the order in which they are tried."""
