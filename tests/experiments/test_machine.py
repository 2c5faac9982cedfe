"""A run that may not fit into memory is refused before it starts, with what it would need."""

import os
import platform
import subprocess
import sys

import pytest

from pipistrelle.__main__ import main
from pipistrelle.config import Config, FastSlamConfig, InputError, RayConfig
from pipistrelle.experiments import machine
from pipistrelle.experiments.machine import check_memory
from pipistrelle.experiments.plan import Plan
from pipistrelle.experiments.study import run_study

GB = 1e9


def test_large_worlds_that_fit_are_let_through(monkeypatch):
    monkeypatch.setattr(machine, "installed", lambda: 4.0 * GB)
    check_memory(["ekf", "fastslam"], 501, 1000, RayConfig(), passive=True)


@pytest.mark.parametrize(
    ("way", "landmarks", "particles", "need"),
    [
        ("ekf", 10_001, 100, 3 * 8 * (3 + 2 * 4 * 10_001) ** 2 / GB),
        ("fastslam", 51, 1_000_000, 3 * 8 * 1_000_000 * (6 * 4 * 51 + 51) / GB),
    ],
)
def test_refusal_says_what_would_be_needed(monkeypatch, way, landmarks, particles, need):
    monkeypatch.setattr(machine, "installed", lambda: 4.0 * GB)
    with pytest.raises(InputError, match=f"{way}: .* may need {need:.1f} GB .* has 4.0 GB"):
        check_memory([way], landmarks, particles, RayConfig(), passive=True)


def test_active_landmarks_need_one_member_each(monkeypatch):
    monkeypatch.setattr(machine, "installed", lambda: 4.0 * GB)
    check_memory(["ekf"], 5_001, 100, RayConfig(), passive=False)
    with pytest.raises(InputError):
        check_memory(["ekf"], 5_001, 100, RayConfig(), passive=True)


@pytest.mark.parametrize(("limit", "have"), [("1000000\n", 1e6), ("max\n", None), (None, None)])
def test_a_containers_share_of_the_memory_counts(tmp_path, monkeypatch, limit, have):
    file = tmp_path / "memory.max"
    if limit is not None:
        file.write_text(limit)
    monkeypatch.setattr(machine, "LIMIT", file)
    assert machine.installed() == (have or os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))


def test_command_refuses_and_leaves_nothing(tmp_path, capsys):
    words = ["run", "--filter", "fastslam", "--particles", "1000000000", "-o", str(tmp_path / "o")]
    assert main(words) == 2
    assert "may need" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_study_refuses_what_its_workers_need_together_and_leaves_nothing(tmp_path, monkeypatch):
    config = Config(fastslam=FastSlamConfig(particles=100_000))
    ways = {"strategies": ("passive",), "filters": ("fastslam",)}
    plan = Plan(name="many", iterations=1, config=config, grid={}, **ways)
    need = 3 * 8 * 100_000 * (6 * 4 * 51 + 51)
    monkeypatch.setattr(machine, "installed", lambda: 2.5 * need)
    with pytest.raises(InputError, match=f"need {need / GB:.1f} GB .* in each of 3 workers"):
        run_study(plan, tmp_path / "many", workers=3)
    assert not (tmp_path / "many").exists()


FAULTS = """
import sys
from resource import RUSAGE_SELF, getrusage

import numpy as np

from pipistrelle.experiments.machine import keep_freed_memory

if sys.argv[1] == "kept":
    keep_freed_memory()
frame = [np.ones(200_000) for _ in range(4)]
del frame
before = getrusage(RUSAGE_SELF).ru_minflt
for _ in range(100):
    frame = [np.ones(200_000) for _ in range(4)]
    del frame
print(getrusage(RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only the GNU C library can be told")
def test_memory_that_is_kept_is_not_asked_for_again():
    faults = {
        way: int(subprocess.run([sys.executable, "-c", FAULTS, way], capture_output=True,
                                check=True, text=True).stdout)
        for way in ("kept", "given back")
    }  # fmt: skip
    pages = 4 * 200_000 * 8 // 4096
    assert faults["kept"] < 2 * pages
    assert faults["given back"] > 5 * pages
