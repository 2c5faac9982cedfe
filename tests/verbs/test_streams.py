"""Streams that are closed, full, or left by their reader decide nothing of what is done."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pipistrelle.__main__ import main
from pipistrelle.experiments.studies.world import done_worlds
from reference.command_line import SHORT, summary

TINY = """\
format = 1
iterations = 2
strategies = ["fused"]
filters = ["ekf"]
[config.scenario]
steps = 8
landmarks = 8
"""
PIPISTRELLE = f"'{sys.executable}' -m pipistrelle"
POSIX = pytest.mark.skipif(os.name != "posix", reason="redirections are those of a POSIX shell")
FULL = pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full device here")

pytestmark = POSIX


def shell(line):
    """The status of the first command of a line, and what the line printed."""
    script = f'{line}; exit "${{PIPESTATUS[0]}}"'
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=300)
    return done.returncode, done.stdout + done.stderr


LEFT = pytest.param("2>&1 | head -c 1 > first", id="a reader that leaves")
CLOSED = pytest.param("<&- >&- 2>&-", id="closed")
UNTOLD = pytest.param("2>/dev/full", id="no room for what is said", marks=FULL)


def at_night(param):
    """The same, left out of the fast suite."""
    return pytest.param(*param.values, id=param.id, marks=[*param.marks, pytest.mark.slow])


@pytest.mark.parametrize("streams", [CLOSED, *map(at_night, (LEFT, UNTOLD))])
def test_a_study_goes_on_whatever_becomes_of_its_words(streams):
    Path("tiny.toml").write_text(TINY)
    status, printed = shell(f"{PIPISTRELLE} study tiny.toml -o one {streams}")
    assert status == 0, printed
    assert done_worlds(Path("one")) == {0, 1}
    assert "Traceback" not in printed


@pytest.mark.parametrize("streams", [LEFT, pytest.param("<&- >&- 2>&-", marks=pytest.mark.slow)])
def test_a_run_goes_on_whatever_becomes_of_its_words(streams):
    status, printed = shell(f"{PIPISTRELLE} run {' '.join(SHORT)} -o one {streams}")
    assert status == 0, printed
    assert len(summary("one")["runs"]) == 3


@pytest.mark.slow
@pytest.mark.parametrize("streams", [LEFT, CLOSED])
def test_a_report_is_whole_whatever_becomes_of_its_words(streams):
    Path("tiny.toml").write_text(TINY)
    assert main(["study", "tiny.toml", "-o", "one", "--workers", "1", "--quiet"]) == 0
    status, printed = shell(f"{PIPISTRELLE} report one {streams}")
    assert status == 0, printed
    assert {"index.html", "summary.json"} <= {path.name for path in Path("one/report").iterdir()}


@FULL
def test_a_result_that_cannot_be_printed_is_told_by_the_status():
    status, said = shell(f"{PIPISTRELLE} config show >/dev/full")
    assert status == 2
    assert said == (
        "pipistrelle: error: the output could not be written: No space left on device\n"
    )


@FULL
@pytest.mark.parametrize("streams", ["2>/dev/full", "2>&-"])
def test_a_mistake_that_cannot_be_said_is_one_all_the_same(streams):
    assert shell(f"{PIPISTRELLE} run --bemwidth 3 {streams}") == (2, "")


def test_a_file_is_never_given_the_number_of_a_closed_stream():
    code = "import pipistrelle.verbs.streams as s; s.hold_streams(); f = open('notes', 'w'); "
    status, printed = shell(f"{sys.executable} -c \"{code} import os; os.write(2, b'word')\" 2>&-")
    assert (status, printed, Path("notes").read_text()) == (0, "", "")


def test_what_a_stream_has_no_letters_for_is_printed_by_its_number():
    code = "import pipistrelle.verbs.streams as s; s.hold_streams(); s.put('\\u03c3', '\\udcff')"
    line = f'PYTHONIOENCODING=latin-1 "{sys.executable}" -c "{code}" > word'
    assert shell(line) == (0, "")
    assert Path("word").read_bytes() == b"\\u03c3 \xff\n"


def test_a_name_that_is_no_text_is_printed_by_its_bytes():
    log = os.fsdecode(b"log\xff")
    assert (
        main(["run", *SHORT, "--strategy", "fused", "--quiet", "--save-log", log, "-o", "1"]) == 0
    )
    name = "$'log\\xff'"
    status, said = shell(f"{PIPISTRELLE} slam {name} -o $'two\\xff' --quiet > folder")
    assert (status, said) == (0, "")
    assert Path("folder").read_bytes() == b"two\xff\n"
    readme = (Path(os.fsdecode(b"two\xff")) / "README.md").read_text()
    assert r"slam 'log\xff' -o 'two\xff'" in readme
