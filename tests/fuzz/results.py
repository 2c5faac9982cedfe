"""Damaged folders of missions' results, met by `view`, `compare` and whoever writes there again."""

import contextlib
import os
import shutil
from hashlib import sha256
from pathlib import Path

from numpy.random import Generator

from fuzz.judging import Tried, contents, faults_of
from fuzz.mutations import BYTES, one_of, spoiled
from fuzz.running import command, made, undrawn
from pipistrelle.files import SUMS
from reference.command_line import SHORT

RUN = ("run", *SHORT, "--strategy", "fused", "--quiet", "-o", "one")
SLAM = ("slam", "log", "--quiet", "-o", "two")
VERBS = (
    *(("view", "one", "--quiet"), ("view", "two", "--quiet", "-o", "page.html")),
    *(("compare", "one", "two"), ("compare", "two", "one", "--quiet", "-o", "new")),
    *((*RUN, "--overwrite"), (*SLAM, "--overwrite"), ("report", "one", "--quiet")),
)
TEXTS = (".json", ".toml", ".md", ".tum", ".csv")
LIMIT = 30.0


def prepare(base: Path) -> Path:
    """Simulate a mission and solve its log."""
    sound = base / "sound"
    sound.mkdir()
    for words in ((*RUN, "--save-log", "log"), SLAM):
        made(sound, *words, limit=LIMIT)
    return sound


def damage(rng: Generator, folder: Path) -> str:
    """Spoil a file of the results, or put something else in its place."""
    path = one_of(rng, sorted(path for path in folder.iterdir() if path.is_file()))
    data, name = path.read_bytes(), path.name
    path.unlink()
    deed = one_of(rng, ["spoilt", "spoilt", "spoilt", "gone", "folder", "pipe", "link", "device"])
    if deed == "spoilt":
        text = name.endswith(TEXTS) and rng.random() < 0.7
        deed, data = spoiled(rng, name, data) if text else one_of(rng, BYTES)(rng, data)
        path.write_bytes(data)
    elif deed == "folder":
        path.mkdir()
    elif deed == "pipe":
        os.mkfifo(path)
    elif deed == "link":
        path.symlink_to(one_of(rng, ["nowhere", name, "config.toml", "../log/log.toml"]))
    elif deed == "device":
        path.symlink_to(one_of(rng, ["/dev/zero", "/dev/null"]))
    return f"{folder.name}/{name}: {deed}"


def mend_sums(folder: Path) -> None:
    """Make the list of sums right for what is there now."""
    path = folder / SUMS
    with contextlib.suppress(OSError, ValueError, IndexError):  # what is left of it is no list
        if not path.is_file() or path.is_symlink():
            return
        head, *lines = path.read_text().splitlines()
        names = [line.split("  ", 1)[1] for line in lines]
        there = [name for name in names if (folder / name).is_file()]
        there = [name for name in there if not (folder / name).is_symlink()]
        sums = [f"{sha256((folder / name).read_bytes()).hexdigest()}  {name}" for name in there]
        path.write_text("\n".join([head, *sums, ""]))


def attempt(rng: Generator, place: Path, sound: Path) -> Tried:
    """Damage results, and have a command meet them."""
    shutil.copytree(sound, place, dirs_exist_ok=True)
    told = []
    for _ in range(one_of(rng, [1, 1, 2])):
        folder = place / one_of(rng, ["one", "two"])
        told.append(damage(rng, folder))
        if rng.random() < 0.6:
            mend_sums(folder)
            told.append("sums mended")
    before = contents(place)
    words = one_of(rng, VERBS)
    ending = command(place, *words, before=undrawn, limit=LIMIT)
    faults = faults_of(ending, ["one", "two", "log"])
    after = contents(place)
    if ending.found == 2 and after != before:
        changed = [
            name for name in before.keys() | after.keys() if before.get(name) != after.get(name)
        ]
        faults.append(f"{words[0]}: is refused, and changes {min(changed)}")
    return Tried(told=(*told, " ".join(words)), endings=(ending,), faults=tuple(faults))
