"""The second process that compiles: it may fail, be impossible or be unwanted."""

import os
import subprocess
import sys

import numba
import pytest

from pipistrelle.experiments.runs import compiling as kernels


@pytest.fixture
def started(monkeypatch):
    """The processes that are started."""
    begun, popen = [], subprocess.Popen

    def start(*given, **options):
        begun.append(popen(*given, **options))
        return begun[-1]

    monkeypatch.setattr(subprocess, "Popen", start)
    return begun


def test_second_process_runs_its_statement_to_the_end(tmp_path, started):
    done = tmp_path / "done"
    with kernels._second_process(f"open({str(done)!r}, 'w').close()"):
        pass
    assert done.exists()
    assert started[0].returncode == 0


def test_second_process_that_fails_says_nothing_and_stops_nothing(started, capfd):
    with kernels._second_process("raise SystemExit('broken')"):
        pass
    assert started[0].returncode == 1
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("interpreter", [None, "", "/nowhere/python"])
def test_work_is_done_where_no_second_process_can_be_had(monkeypatch, interpreter):
    monkeypatch.setattr(sys, "executable", interpreter)
    worked = False
    with kernels._second_process("pass"):
        worked = True
    assert worked


def test_second_process_ends_with_the_work_that_breaks_off(started):
    with pytest.raises(KeyboardInterrupt), kernels._second_process("import time; time.sleep(600)"):
        raise KeyboardInterrupt
    assert started[0].returncode is not None


@pytest.mark.parametrize(("cores", "files", "processes"), [(2, 0, 1), (2, 1, 0), (1, 0, 0)])
def test_second_process_is_asked_only_to_fill_an_empty_cache_beside_a_free_core(
    tmp_path, monkeypatch, started, cores, files, processes
):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(kernels, "cores", lambda: cores)
    monkeypatch.setattr(kernels, "run_mission", lambda *_: None)
    monkeypatch.setattr(kernels, "_SECOND", "pass")
    for name in range(files):
        (tmp_path / f"{name}.nbc").touch()
    kernels.compile_kernels()
    assert len(started) == processes


def test_second_process_leaves_the_filters_compiled_that_are_not_the_first():
    from pipistrelle.estimation.fastslam.particles import correct_particles
    from pipistrelle.estimation.fastslam.poses import summarise

    kernels.compile_others()
    assert correct_particles.signatures
    assert summarise.signatures


@pytest.fixture
def told():
    """How often compiling was told of."""
    return []


def test_the_first_of_the_kernels_that_are_compiled_is_told_of(monkeypatch, told):
    def mission(*_):
        numba.njit(lambda x: x + 1)(1.0)
        numba.njit(lambda x: x + 2)(1.0)

    monkeypatch.setattr(kernels, "run_mission", mission)
    kernels.compile_kernels(lambda: told.append(1))
    assert told == [1]
    numba.njit(lambda x: x + 3)(1.0)
    assert told == [1], "what is compiled afterwards is somebody else's"


def test_kernels_that_are_there_are_loaded_and_nothing_is_told(tmp_path, told):
    code = (
        "from pipistrelle.experiments.runs import compiling\n"
        "from pipistrelle.geometry import wrap_angle\n"
        "compiling.run_mission = lambda *_: wrap_angle(4.0)\n"
        "compiling.cores = lambda: 1\n"
        "compiling.compile_kernels(lambda: print('compiling'))"
    )
    for wanted in ("compiling\n", ""):
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")},
            capture_output=True,
            text=True,
            check=True,
        )
        assert (done.stdout, done.stderr) == (wanted, "")


def test_nobody_need_be_told(monkeypatch):
    monkeypatch.setattr(kernels, "run_mission", lambda *_: numba.njit(lambda x: x - 1)(1.0))
    kernels.compile_kernels()
