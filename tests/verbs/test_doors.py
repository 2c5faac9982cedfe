"""Every door through which we write: what a user has in the place that it names stays as it is."""

import os
import shutil
import sys
from hashlib import sha256
from pathlib import Path
from typing import get_args

import pytest

import pipistrelle
from pipistrelle.__main__ import main
from pipistrelle.config import InputError
from pipistrelle.verbs.command_line import app
from reference.command_line import SHORT
from reference.results import loop, mission_folder
from reference.sounds import record
from reference.studies import TINY

LOG = Path(__file__).parents[1] / "data" / "unicycle_log"
READ = {"--world", "--log", "LOG", "PATH", "RECORDING", "FOLDER", "--folder", "FOLDERS"}
"""What names a place that is only read."""
RUN = ("run", *SHORT, "--strategy", "fused", "-o")
COMMANDS = {
    "run --output": (*RUN, "d"),
    "run --save-log": (*RUN, "new", "--save-log", "d"),
    "run --save-world": (*RUN, "new", "--save-world", "d"),
    "run --save-sound": (*RUN, "new", "--receiver.elements", "2", "--save-sound", "d"),
    "hear --output": ("hear", "tape", "-o", "d"),
    "slam --output": ("slam", LOG, "-o", "d"),
    "study --output": ("study", "tiny.toml", "--workers", "1", "-o", "d"),
    "report --output": ("report", "s", "-o", "d"),
    "compare --output": ("compare", "one", "two", "-o", "d"),
    "look --output": ("look", LOG, "-o", "d/debian.png"),
    "array --output": ("array", "square", "-o", "d/debian.png"),
    "view --output": ("view", "one", "-o", "d/debian.html"),
}
CALLS = {
    "run": lambda o: pipistrelle.run(
        duration=2.0, landmarks=5, strategies="fused", output="d", **o
    ),
    "hear": lambda o: pipistrelle.hear("tape", output="d", **o),
    "slam": lambda o: pipistrelle.slam(LOG, output="d", **o),
    "save": lambda o: pipistrelle.run(duration=2.0, landmarks=5, strategies="fused").save("d", **o),
    "study": lambda o: pipistrelle.study("tiny.toml", output="d"),
    "report": lambda o: pipistrelle.load("s").report("d"),
}
"""What a user of Python calls, with its options."""
ALWAYS = ("study --output", "report --output", "study", "report")
"""Those that go on with, or replace, their own like without being asked to."""
NOTES = ("notes.txt", "sub/deep/b.txt")
BY_NAME = (*ALWAYS, "array --output", "look --output", "view --output")
"""Those that have no --overwrite, or are told by it which file to replace."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A plan, its study, two missions and a recording."""
    here = tmp_path_factory.mktemp("made")
    (here / "tiny.toml").write_text(TINY)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        patch.setattr(sys, "argv", ["pipistrelle"])
        assert main(["study", "tiny.toml", "--workers", "1", "--quiet", "-o", "s"]) == 0
    record(here / "tape", "--frames", "0:2", drive=("--receiver.elements", "2", "--duration", "2"))
    for name in ("one", "two"):
        mission_folder(here / name, {("fused", "ekf"): loop()})
    return here


@pytest.fixture
def users(made, monkeypatch, undrawn):
    """A user's folder of downloads beside them, with a list of sums as is usual; all it holds."""
    monkeypatch.setattr("pipistrelle.report.page._write_figure", lambda *_: None)
    shutil.copytree(made, ".", dirs_exist_ok=True)
    outside, folder = Path("outside"), Path("d")
    for name in (*(f"debian.{end}" for end in ("iso", "html", "png")), *NOTES):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(f"a user's {name}")
    outside.mkdir()
    (outside / ".bashrc").write_text("precious")
    (folder / "h").symlink_to("../outside")
    (folder / "figures").symlink_to("../outside")
    names = ("debian.iso", "debian.html", "notes.txt", "sub/deep/b.txt", "h/.bashrc")
    sums = "".join(f"{sha256((folder / n).read_bytes()).hexdigest()}  {n}\n" for n in names)
    (folder / "SHA256SUMS").write_text(sums + "0" * 64 + "  summary.json\n")
    for name in ("summary.json", "index.html", "debian.html", "plan.toml", "log.toml"):
        (folder / f"{name}.partial").write_text("half a download")
    return contents(folder) | contents(outside)


def contents(folder):
    """All files of a folder, and what its links point at."""
    found = {}
    for place, folders, files in os.walk(folder):
        for path in (Path(place) / name for name in (*folders, *files)):
            if path.is_symlink():
                found[path] = path.readlink()
            elif path.is_file():
                found[path] = path.read_bytes()
    return found


def test_each_flag_with_a_path_is_listed_as_reading_or_writing():
    found = {
        f"{verb} {argument.names[0]}"
        for verb in ("array", "run", "hear", "look", "slam", "view", "report", "compare", "study")
        for argument in app[verb].assemble_argument_collection()
        if argument.hint is Path or Path in get_args(argument.hint)
        if not READ & {*argument.names}
    }
    assert found == {*COMMANDS}


@pytest.mark.parametrize(
    "words",
    [
        *COMMANDS.values(),
        *((*words, "--overwrite") for door, words in COMMANDS.items() if door not in BY_NAME),
    ],
    ids=lambda words: " ".join(map(str, words[:1] + words[-2:])),
)
def test_a_command_keeps_all_files_of_a_user(obey, users, words):
    status, printed, said = obey(*words)
    assert (status, printed) == (2, "")
    assert "d/debian" in said or "d: is not empty" in said or "d: holds" in said
    assert contents("d") | contents("outside") == users
    assert not Path("new").exists()


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("door", CALLS)
def test_a_python_call_keeps_all_files_of_a_user(users, door, overwrite):
    options = {} if door in ALWAYS else {"overwrite": overwrite}
    with pytest.raises(InputError, match=r"^d: "):
        CALLS[door](options)
    assert contents("d") | contents("outside") == users


@pytest.mark.parametrize("door", COMMANDS)
def test_a_command_replaces_only_the_files_that_it_wrote(obey, users, door):
    shutil.rmtree("d")
    again = [] if door in ALWAYS else ["--overwrite"]
    assert obey(*COMMANDS[door])[0] == 0
    Path("d/notes.txt").write_text("mine")
    status, _, said = obey(*COMMANDS[door], *again)
    assert (status, said if status else "") == (0, "")
    assert Path("d/notes.txt").read_text() == "mine"
