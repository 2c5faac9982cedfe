"""Signals that ask for an end: the status says so, what is done is kept, nothing is left behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipistrelle.experiments.studies.world import done_worlds
from pipistrelle.verbs.signals import heard_signals

PLAN = """\
format = 1
iterations = 400
strategies = ["fused"]
filters = ["ekf"]
[config.scenario]
steps = 40
landmarks = 8
"""


@pytest.mark.skipif(os.name != "posix", reason="signals are those of POSIX")
@pytest.mark.parametrize(
    "ending", [pytest.param(signal.SIGTERM, marks=pytest.mark.slow), signal.SIGINT]
)
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


def test_an_interruption_that_a_library_hides_is_one_all_the_same(obey, monkeypatch):
    def hidden(*_, **__):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise ValueError("a validator could not be built") from None

    monkeypatch.setattr("pipistrelle.verbs.config.mission_config", hidden)
    assert obey("config", "show") == (130, "", "pipistrelle: interrupted\n")


def test_signals_are_heard_as_before_afterwards():
    before = [signal.getsignal(ending) for ending in (signal.SIGINT, signal.SIGTERM)]
    with heard_signals():
        assert signal.getsignal(signal.SIGTERM) is not before[1]
    assert [signal.getsignal(ending) for ending in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.skipif(os.name != "posix", reason="signals are those of POSIX")
@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_after_the_work_is_done_changes_no_status(ending):
    """It is sent when Python takes itself down, in a function that is called at the end."""
    code = (
        "import atexit, signal, sys; from pipistrelle.__main__ import main; "
        f"atexit.register(signal.raise_signal, {int(ending)}); "
        "sys.argv = ['pipistrelle', 'config', 'show']; sys.exit(main())"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, b"")
