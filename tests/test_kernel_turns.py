"""Processes that need the same kernel: one compiles it, the others wait and load it."""

import os
import subprocess
import sys
import time

import pytest

from pipistrelle import kernel_folder
from pipistrelle.kernel_folder import Turn

LINES = """
from pipistrelle.jit import kernel

@kernel
def doubled(x):
    return 2.0 * x
"""
COMPILE = "import slow; slow.doubled(1.0); print(sum(slow.doubled.stats.cache_misses.values()))"
HOLD = """
import sys
from pathlib import Path
from pipistrelle.kernel_folder import Turn

Turn().take(Path(sys.argv[1]))
print("mine", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """A process that has the turn of a kernel until its input ends."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "one.nbi")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        assert process.stdout.readline() == b"mine\n"
        yield process
        process.kill()


def test_of_processes_that_need_a_kernel_at_once_one_compiles_it(tmp_path):
    (tmp_path / "slow.py").write_text(LINES)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", COMPILE], cwd=tmp_path, env=environment, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        for _ in range(3)
    ]  # fmt: skip
    assert sorted(int(process.communicate()[0]) for process in started) == [0, 0, 1]


def test_another_kernel_has_a_separate_turn(tmp_path, holder):
    began, turn = time.monotonic(), Turn()
    turn.take(tmp_path / "other.nbi")
    turn.end()
    assert time.monotonic() - began < kernel_folder._LONGEST_S / 2.0


def test_a_turn_ends_with_the_process_that_has_it(tmp_path, holder, monkeypatch):
    monkeypatch.setattr(kernel_folder.time, "sleep", lambda _: holder.kill())
    turn = Turn()
    turn.take(tmp_path / "one.nbi")
    assert holder.wait() != 0, "nobody waited, or nobody had the turn"
    turn.end()


def test_waiting_for_a_stalled_process_is_limited(tmp_path, holder, monkeypatch):
    waited = []
    monkeypatch.setattr(kernel_folder, "_LONGEST_S", 0.2)
    monkeypatch.setattr(kernel_folder.time, "sleep", waited.append)
    Turn().take(tmp_path / "one.nbi")
    assert holder.poll() is None
    assert waited


@pytest.mark.parametrize("lock", [None, "a folder"])
def test_where_files_cannot_be_locked_each_compiles_for_itself(tmp_path, monkeypatch, lock):
    if lock is None:
        monkeypatch.setattr(kernel_folder, "fcntl", None)
    else:
        (tmp_path / "compiling.lock").mkdir()
    turn = Turn()
    turn.take(tmp_path / "one.nbi")
    assert turn._file is None, "it has a turn that nobody can have"
    turn.end()
