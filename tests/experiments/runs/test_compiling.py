"""Kernels that are compiled: announced before, and no part of a filter's time."""

import json
import os
import subprocess
import sys
import time

import numba
import pytest
from numba.core.event import install_timer

from pipistrelle import jit
from pipistrelle.config import Config, InputError, ScenarioConfig
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.experiments.runs import compiling, trial, validate

TINY = Config(scenario=ScenarioConfig(steps=8, landmarks=4, radius=10.0))
COLD = """
import json, sys, time
from numba.core.event import install_recorder
from pipistrelle.config import Config, ListeningConfig, ScenarioConfig
from pipistrelle.experiments.runs.trial import run_mission
tiny = ScenarioConfig(steps=8, landmarks=4, radius=10.0)


def compiling(buffer):
    total, depth = 0.0, 0
    for at, event in buffer:
        if event.is_start:
            begun, depth = (begun if depth else at), depth + 1
        else:
            depth -= 1
            total += 0.0 if depth else at - begun
    return total


for name in sys.argv[1:]:
    for timing in (False, True):
        config = Config(scenario=tiny, listening=ListeningConfig(timing=timing))
        began = time.perf_counter()
        with install_recorder("numba:compile") as recorder:
            trials = run_mission(config, ("active", "fused", "passive"), (name,)).trials
        took = time.perf_counter() - began
        compiled = compiling(recorder.buffer)
        print(json.dumps([name, timing, compiled, sum(t.wall_s for t in trials), took]))
"""


@pytest.fixture
def said(monkeypatch):
    """What is announced of the next that is compiled, as if it were this process's first."""
    lines = []
    monkeypatch.setattr(jit._CLOCK, "said", False)
    jit.announce(lines.append)
    yield lines
    jit.announce()


def test_the_first_of_the_kernels_that_are_compiled_is_announced_before_and_no_other(said):
    numba.njit(lambda x: x + 1)(1.0)
    assert said == [jit.COMPILING]
    numba.njit(lambda x: x + 2)(1.0)
    assert said == [jit.COMPILING]
    jit.announce(said.append)  # by a second mission in this process
    numba.njit(lambda x: x + 3)(1.0)
    assert said == [jit.COMPILING]


def test_the_announcement_may_be_silent(said, capfd):
    jit.announce(None)
    numba.njit(lambda x: x - 1)(1.0)
    assert capfd.readouterr() == ("", "")
    jit.announce(said.append)
    numba.njit(lambda x: x - 2)(1.0)
    assert said == [jit.COMPILING], "who was not told was counted as told"


def test_nothing_is_announced_while_input_is_judged(said, monkeypatch):
    """The world is drawn by kernels, and may be refused."""

    def drawn(*_, **__):
        numba.njit(lambda x: x + 4)(1.0)
        raise InputError("scenario.landmarks: too many")

    monkeypatch.setattr(validate, "world_of", drawn)
    with pytest.raises(InputError, match="too many"):
        trial.run_mission(TINY, ("fused",))
    assert said == []
    numba.njit(lambda x: x + 5)(1.0)
    assert said == [jit.COMPILING]


def test_compilation_does_not_count_as_a_filters_time(monkeypatch):
    compiled, took, run_filter, run_trial = [], [], trial.run_filter, trial.run_trial
    trial.run_mission(TINY, ("fused",))  # all else is loaded

    def slowed(*given, **named):
        with install_timer("numba:compile", compiled.append):
            numba.njit(lambda x: x * 3)(1.0)
        return run_filter(*given, **named)

    def timed(*given, **named):
        began = time.perf_counter()
        result = run_trial(*given, **named)
        took.append(time.perf_counter() - began)
        return result

    monkeypatch.setattr(trial, "run_filter", slowed)
    monkeypatch.setattr(trial, "run_trial", timed)
    (done,) = trial.run_mission(TINY, ("fused",)).trials
    assert 0.0 < done.wall_s <= took[0] - compiled[0]
    assert compiled[0] > took[0] / 2.0, "little was compiled: this proves nothing"


@pytest.mark.slow
def test_an_empty_cache_costs_no_filter_time_with_timing_or_without(tmp_path):
    names = list(CATALOGUE)
    done = subprocess.run(
        [sys.executable, "-c", COLD, *names],
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == jit.COMPILING + "\n"
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row[:2] for row in rows] == [[name, timed] for name in names for timed in (False, True)]
    for name, timed, compiled, in_filters, took in rows:
        assert 0.0 < in_filters <= took - compiled
        shared = name == "smoother" or (name, timed) == ("iekf", True)
        assert shared or compiled > took / 2.0, f"{name}, {timed}: little is compiled, or proved"


def test_kernels_are_compiled_for_the_filters_and_timings_that_are_named(monkeypatch):
    tried = []

    def noted(config, _, filters):
        tried.append((config.listening.excess_paths, *filters))

    monkeypatch.setattr(compiling, "run_mission", noted)
    compiling.compile_kernels(["iekf", "my.own:Filter"], [True])
    assert tried == [(True, "iekf")]
    compiling.compile_kernels()
    assert tried[1:] == [(timing, *CATALOGUE) for timing in (False, True)]


@pytest.fixture
def second(monkeypatch):
    """The second processes that are started."""
    started, popen = [], subprocess.Popen

    def start(*given, **named):
        started.append(popen(*given, **named))
        return started[-1]

    monkeypatch.setattr(compiling, "cores", lambda: 2)
    monkeypatch.setattr(compiling.subprocess, "Popen", start)
    return started


def test_a_second_process_starts_with_the_first_kernel_and_ends_with_the_work(said, second):
    with compiling.in_two_processes(said.append, TINY, ["ekf"]):
        assert second == []
        numba.njit(lambda x: x + 6)(1.0)
        assert said == [jit.COMPILING]
        (process,) = second
        assert process.poll() is None
    assert process.poll() is not None


@pytest.mark.parametrize("trouble", ["one core", "no interpreter"])
def test_a_missing_second_process_does_not_stop_the_first(said, second, monkeypatch, trouble):
    if trouble == "one core":
        monkeypatch.setattr(compiling, "cores", lambda: 1)
    else:
        monkeypatch.setattr(compiling.sys, "executable", os.devnull + "/python")
    with compiling.in_two_processes(said.append, TINY, ["ekf"]):
        assert numba.njit(lambda x: x + 7)(1.0) == 8.0
    assert said == [jit.COMPILING]
    assert second == []


@pytest.mark.slow
@pytest.mark.parametrize("name", CATALOGUE)
@pytest.mark.parametrize("timing", [False, True])
def test_the_second_process_compiles_the_kernels_of_a_missions_filters(tmp_path, name, timing):
    """Else it would be of no use: of a filter's kernels, nearly none is left for the mission."""
    code = """
import sys
from numba.core.event import install_recorder
from pipistrelle.config import Config, ListeningConfig
from pipistrelle.experiments.runs import compiling, trial

config = Config(listening=ListeningConfig(timing=sys.argv[2] == "True"))
compiling.compile_filters(config, sys.argv[1:2])
kept = trial.try_trial

def told(*given, **named):
    with install_recorder("numba:compile") as recorder:
        done = kept(*given, **named)
    print(len({event.data["dispatcher"].py_func.__name__ for _, event in recorder.buffer}))
    return done

trial.try_trial = told
trial.run_mission(config, ("fused",), sys.argv[1:2])
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    command = [sys.executable, "-c", code, name, str(timing)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert int(done.stdout) <= 2
