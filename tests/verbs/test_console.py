"""What ends a command before its time, on its own account or another's."""

import subprocess
import sys
from pathlib import Path

import pytest

from pipistrelle.scripting import missions


def test_a_bug_keeps_its_traceback(obey, monkeypatch):
    def broken(*_, **__):
        raise ValueError("ours")

    monkeypatch.setattr(missions, "run_mission", broken)
    with pytest.raises(ValueError, match="ours"):
        obey("run", "-o", "one")


def test_an_interrupted_run_says_so_and_leaves_no_empty_folder(obey, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(missions, "run_mission", interrupted)
    assert obey("run") == (130, "", "pipistrelle: interrupted\n")
    assert not Path("runs").exists()


def test_memory_that_ends_is_said_in_a_line(refused, tmp_path, monkeypatch):
    def full(*_, **__):
        raise MemoryError("unable to allocate")

    monkeypatch.setattr("pipistrelle.scripting.missions.run_mission", full)
    assert "not enough memory" in refused("run", "-o", tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_a_reader_that_leaves_early_sees_no_traceback():
    command = [sys.executable, "-m", "pipistrelle", "config", "show"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0


def test_a_full_disk_behind_the_output_is_said_in_a_line():
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "pipistrelle", "config", "show"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("pipistrelle: error: the output could not be written")
    assert "Traceback" not in done.stderr
