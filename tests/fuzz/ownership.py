"""A user's own files, lists of sums and links in a folder that a command is told to write into."""

import os
import shutil
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

from numpy.random import Generator

from fuzz.judging import Tried, contents, faults_of
from fuzz.mutations import one_of
from fuzz.running import command, made, undrawn
from pipistrelle.files import KINDS, SUMS
from reference.command_line import SHORT
from reference.studies import TINY

RUN = ("run", *SHORT, "--strategy", "fused", "--quiet")
DOORS: dict[str, tuple[str, ...]] = {
    "results": (*RUN, "-o", "{}"),
    "solved": ("slam", "log", "--quiet", "-o", "{}"),
    "log": (*RUN, "-o", "new", "--save-log", "{}"),
    "world": (*RUN, "-o", "new", "--save-world", "{}"),
    "comparison": ("compare", "results", "solved", "--quiet", "-o", "{}"),
    "report": ("report", "study", "--quiet", "-o", "{}"),
    "study": ("study", "tiny.toml", "--workers", "1", "--quiet", "-o", "{}"),
    "page": ("view", "results", "--quiet", "-o", "{}/page.html"),
}
"""The commands that write into a folder, by what they write."""
ALWAYS = ("report", "study")
"""Those without --overwrite: they replace, or go on with, their own like."""
LIMIT = 60.0
NAMES = (
    *("notes.txt", "debian.iso", "index.html", "summary.json", "figures/a.png", "config.toml"),
    *("log.toml", "odometry.csv", "landmarks.csv", "path.csv", "world.toml", "README.md"),
    *("plan.toml", "trials/mine.txt", "trials/iteration_00000.notes.partial", "page.html"),
    *("debian.iso.partial", "summary.json.partial", "index.html.partial", "page.html.partial"),
    *("track_fused_ekf.tum", "comparison.csv", "worlds/mine/notes.txt", "sub/deep/b.txt"),
    *(".pipistrelle-abc/notes.txt", "view.html", "mission.png", "a [1].txt", "runs/latest"),
)
"""Names that a user's files have; many are names that we would write."""


def prepare(base: Path) -> Path:
    """Have each command write once, so that there is something to replace."""
    sound = base / "sound"
    sound.mkdir()
    (sound / "tiny.toml").write_text(TINY)
    (sound / "outside").mkdir()
    for name in ("secret.txt", "deep.txt"):
        (sound / "outside" / name).write_text(f"precious {name}")
    for name in ("study", "log", "world", "results", "solved", "report", "comparison"):
        made(sound, *(word.format(name) for word in DOORS[name]), limit=LIMIT)
        shutil.rmtree(sound / "new", ignore_errors=True)
    return sound


# What a user does to a folder; each returns what was done


def lay_files(rng: Generator, folder: Path) -> str:
    """Lay files of the user's."""
    names = [one_of(rng, NAMES) for _ in range(int(rng.integers(1, 6)))]
    for name in names:
        path = folder / name
        if os.path.lexists(path) or any(
            os.path.lexists(p) and not p.is_dir() for p in path.parents
        ):
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"a user's {name}")
    return f"files {', '.join(names)}"


def lay_links(rng: Generator, folder: Path) -> str:
    """Link names to files and folders outside, to nothing, or to each other."""
    name = one_of(rng, [*NAMES, "figures", "trials", "worlds", "sub", SUMS])
    target = one_of(rng, ["outside", "outside/secret.txt", "nowhere", "log", "results"])
    path = folder / name
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    if not os.path.lexists(path) and path.parent.is_dir():
        path.symlink_to(Path(os.path.relpath(folder.parent / target, path.parent)))
    return f"{name} -> {target}"


def _one_of_ours(rng: Generator, folder: Path) -> Path | None:
    """Draw a file, and no link, in a folder."""
    ours = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    return one_of(rng, sorted(ours)) if ours else None


def link_ours(rng: Generator, folder: Path) -> str:
    """Move a file of ours away, and put a link to it in its place."""
    path = _one_of_ours(rng, folder)
    if path is None:
        return "nothing to move"
    moved = folder.parent / "outside" / f"moved-{path.name}"
    path.rename(moved)
    path.symlink_to(os.path.relpath(moved, path.parent))
    return f"{path.relative_to(folder)} is a link to where it was moved"


def change_ours(rng: Generator, folder: Path) -> str:
    """Change a file that we wrote."""
    path = _one_of_ours(rng, folder)
    if path is None:
        return "nothing to change"
    path.write_bytes(path.read_bytes() + b"\nmine")
    return f"{path.relative_to(folder)} is changed"


def list_all(rng: Generator, folder: Path) -> str:
    """Write a list of sums: of what is there, of what is outside, in several forms."""
    files = [p for p in folder.rglob("*") if p.is_file() and p.name != SUMS]
    names = [p.relative_to(folder).as_posix() for p in files]
    names += [f"../outside/{name}" for name in ("secret.txt", "deep.txt")]
    head = one_of(
        rng, ["", "", "# of a download\n", *(f"# Of Pipistrelle: {k.title}\n" for k in KINDS)]
    )
    mode = one_of(rng, ["sums", "sums", "append", "bsd", "head below"])
    path = folder / SUMS
    if os.path.lexists(path) and (path.is_symlink() or not path.is_file()):
        return "the list cannot be written"
    sums = {name: sha256((folder / name).read_bytes()).hexdigest() for name in names}
    lines = "".join(f"{one}  {name}\n" for name, one in sums.items())
    if mode == "bsd":
        lines = "".join(f"SHA256 ({name}) = {one}\n" for name, one in sums.items())
    before = path.read_text() if mode == "append" and path.exists() else ""
    path.write_text(lines + head if mode == "head below" else before + head + lines)
    return f"a list ({mode}, {head.strip()!r}) of {len(names)} files"


def lay_pipe(rng: Generator, folder: Path) -> str:
    """Put a pipe where a file may be."""
    path = folder / one_of(rng, ["index.html", "summary.json", SUMS, "config.toml", "pipe"])
    if not os.path.lexists(path):
        os.mkfifo(path)
    return f"{path.name} is a pipe"


DEEDS: tuple[Callable[[Generator, Path], str], ...] = (
    *(lay_files, lay_files, lay_files, lay_links, link_ours, change_ours, *[list_all] * 4),
    lay_pipe,
)


def attempt(rng: Generator, place: Path, sound: Path) -> Tried:
    """Let a user work in a folder, and then a command write into it."""
    shutil.copytree(sound, place, dirs_exist_ok=True, symlinks=True)
    door = one_of(rng, list(DOORS))
    folder = place / "target"
    like = one_of(rng, [None, door, door, one_of(rng, list(DOORS))])
    if like is not None and (sound / like).is_dir():
        shutil.copytree(sound / like, folder)
    folder.mkdir(exist_ok=True)
    theirs = contents(place)
    told = [f"a folder of {like}"]
    told += [one_of(rng, DEEDS)(rng, folder) for _ in range(int(rng.integers(1, 5)))]
    before = contents(place)
    words = [word.format("target") for word in DOORS[door]]
    if door not in ALWAYS and rng.random() < 0.7:
        words.append("--overwrite")
    ending = command(place, *words, before=undrawn, limit=LIMIT)
    faults = faults_of(ending, ["target", SUMS, "outside"])
    after = contents(place)
    users = {n: what for n, what in before.items() if theirs.get(n) != what or "target" not in n}
    if door == "page" and "--overwrite" in words:  # it is what is to be replaced
        users.pop("target/page.html", None)
    faults += [f"{door}: loses {_kind(n)}" for n in users if after.get(n) != users[n]][:1]
    if ending.found == 2:
        faults += [f"{door}: is refused, and changes {n}" for n in _changed(before, after)][:1]
    elif like is None and door != "page" and _holds_something(before):
        faults.append(f"{door}: writes into a folder of a user's")
    return Tried(told=(*told, " ".join(words)), endings=(ending,), faults=tuple(faults))


def _kind(name: str) -> str:
    """Name a user's file by what it is like."""
    return "what is outside" if not name.startswith("target") else "a file of a user's"


def _changed(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Name what is not as it was."""
    return sorted(
        name for name in before.keys() | after.keys() if before.get(name) != after.get(name)
    )


def _holds_something(before: dict[str, Any]) -> bool:
    """Tell whether a folder held anything."""
    return any(name.startswith("target/") for name in before)
