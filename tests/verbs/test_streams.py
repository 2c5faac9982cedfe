"""Closed, full or abandoned streams, and signals to end."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipistrelle.__main__ import main
from pipistrelle.experiments.studies.world import done_worlds
from pipistrelle.verbs.streams import heard_signals
from reference.command_line import SHORT, summary
from reference.studies import TINY

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
UNTOLD = pytest.param("2>/dev/full", id="no room for what is said", marks=(FULL, pytest.mark.slow))


@pytest.mark.parametrize("workers", ["1", pytest.param("2", marks=pytest.mark.slow)])
@pytest.mark.parametrize("streams", [LEFT, CLOSED, UNTOLD])
def test_a_study_goes_on_whatever_becomes_of_its_words(streams, workers):
    Path("tiny.toml").write_text(TINY)
    words = f"study tiny.toml --iterations 2 --workers {workers} -o one"
    status, printed = shell(f"{PIPISTRELLE} {words} {streams}")
    assert status == 0, printed
    assert done_worlds(Path("one")) == {0, 1}
    assert "Traceback" not in printed


@pytest.mark.slow
@pytest.mark.parametrize("streams", [LEFT, CLOSED])
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
def test_an_unprintable_result_is_reported_by_the_status():
    status, said = shell(f"{PIPISTRELLE} config show >/dev/full")
    assert status == 2
    assert said == (
        "pipistrelle: error: the output could not be written: No space left on device\n"
    )


@FULL
@pytest.mark.parametrize("streams", ["2>/dev/full", pytest.param("2>&-", marks=pytest.mark.slow)])
def test_a_mistake_without_standard_error_keeps_its_status(streams):
    assert shell(f"{PIPISTRELLE} run --bemwidth 3 {streams}") == (2, "")


def test_a_file_is_never_given_the_number_of_a_closed_stream():
    code = "import pipistrelle.verbs.streams as s; s.hold_streams(); f = open('notes', 'w'); "
    status, printed = shell(f"{sys.executable} -c \"{code} import os; os.write(2, b'word')\" 2>&-")
    assert (status, printed, Path("notes").read_text()) == (0, "", "")


def test_characters_outside_the_encoding_are_printed_as_numbers():
    code = "import pipistrelle.verbs.streams as s; s.hold_streams(); s.put('\\u03c3', '\\udcff')"
    line = f'PYTHONIOENCODING=latin-1 "{sys.executable}" -c "{code}" > word'
    assert shell(line) == (0, "")
    assert Path("word").read_bytes() == b"\\u03c3 \xff\n"


def test_a_name_that_is_no_text_is_printed_by_its_bytes(capsys, monkeypatch, short_log, undrawn):
    log, results = (os.fsdecode(name) for name in (b"log\xff", b"two\xff"))
    shutil.copytree(short_log, log)
    with Path("folder").open("w", encoding="utf-8") as folder:
        words = ["slam", log, "-o", results, "--quiet"]
        monkeypatch.setattr(sys, "stdout", folder)
        monkeypatch.setattr(sys, "argv", ["pipistrelle", *words])
        assert main(words) == 0
    assert capsys.readouterr().err == ""
    assert Path("folder").read_bytes() == b"two\xff\n"
    assert r"slam 'log\xff' -o 'two\xff'" in Path(results, "README.md").read_text()


PLAN = """\
format = 1
iterations = 400
strategies = ["fused"]
filters = ["ekf"]
[config.scenario]
steps = 40
landmarks = 8
"""


SIGNALS = pytest.mark.parametrize(
    "ending", [pytest.param(signal.SIGTERM, marks=pytest.mark.slow), signal.SIGINT]
)


@SIGNALS
def test_a_study_that_is_asked_to_end_ends_in_order(ending):
    Path("long.toml").write_text(PLAN)
    words = ["study", "long.toml", "--workers", "2", "-o", "one"]
    study = subprocess.Popen(
        [sys.executable, "-m", "pipistrelle", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120.0
    while not done_worlds(Path("one")) and study.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(study.pid, ending)
    _, said = study.communicate(timeout=60)
    assert study.returncode == 128 + ending
    lines = said.splitlines()
    assert lines[-1] == "pipistrelle: interrupted"
    assert "one: worlds that are done are kept; the same command goes on with the rest" in lines
    assert "resource_tracker" not in said
    assert 0 < len(done_worlds(Path("one"))) < 400


def test_an_interruption_hidden_by_a_library_is_reported(obey, monkeypatch):
    def hidden(*_, **__):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise ValueError("a validator could not be built") from None

    monkeypatch.setattr("pipistrelle.verbs.missions.mission_settings", hidden)
    assert obey("config", "show") == (130, "", "pipistrelle: interrupted\n")


def test_signal_handlers_are_restored():
    before = [signal.getsignal(ending) for ending in (signal.SIGINT, signal.SIGTERM)]
    with heard_signals():
        assert signal.getsignal(signal.SIGTERM) is not before[1]
    assert [signal.getsignal(ending) for ending in (signal.SIGINT, signal.SIGTERM)] == before


@SIGNALS
def test_a_signal_after_the_work_keeps_the_status(ending):
    """It is sent when Python takes itself down, in a function that is called at the end."""
    code = (
        "import atexit, signal, sys; from pipistrelle.__main__ import main; "
        f"atexit.register(signal.raise_signal, {int(ending)}); "
        "sys.argv = ['pipistrelle', 'config', 'show']; sys.exit(main())"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, b"")
