"""A run that may not fit into memory is refused before it starts, with what it would need."""

import os
import platform
import subprocess
import sys
import tracemalloc

import pytest

from pipistrelle.__main__ import main
from pipistrelle.config import (
    Config,
    EmitterConfig,
    FastSlamConfig,
    InputError,
    RayConfig,
    ScenarioConfig,
)
from pipistrelle.estimation.catalogue import COPIES
from pipistrelle.experiments import machine
from pipistrelle.experiments.machine import check_length, check_memory
from pipistrelle.experiments.runs import validate
from pipistrelle.experiments.runs.trial import run_mission
from pipistrelle.experiments.studies.plan import Plan
from pipistrelle.experiments.studies.study import run_study

GB = 1e9


def test_large_worlds_that_fit_are_let_through(monkeypatch):
    monkeypatch.setattr(machine, "installed", lambda: 4.0 * GB)
    many = Config(fastslam=FastSlamConfig(particles=1000))
    check_memory(["ekf", "fastslam"], 501, many, passive=True)


@pytest.mark.parametrize(
    ("way", "landmarks", "particles", "need"),
    [
        ("ekf", 10_001, 100, 3 * 8 * (3 + 2 * 4 * 10_001) ** 2 / GB),
        ("fastslam", 51, 1_000_000, 3 * 8 * 1_000_000 * (6 * 4 * 51 + 51) / GB),
    ],
)
def test_the_refusal_states_the_needed_memory(monkeypatch, way, landmarks, particles, need):
    monkeypatch.setattr(machine, "installed", lambda: 4.0 * GB)
    config = Config(fastslam=FastSlamConfig(particles=particles))
    with pytest.raises(InputError, match=f"{way}: .* may need {need:.1f} GB .* has 4.0 GB"):
        check_memory([way], landmarks, config, passive=True)


def test_active_landmarks_need_one_member_each(monkeypatch):
    monkeypatch.setattr(machine, "installed", lambda: 4.0 * GB)
    check_memory(["ekf"], 5_001, Config(), passive=False)
    with pytest.raises(InputError):
        check_memory(["ekf"], 5_001, Config(), passive=True)


def test_a_refusal_of_dense_rays_names_their_members(monkeypatch):
    monkeypatch.setattr(machine, "installed", lambda: 4.0 * GB)
    message = r"51 landmarks of \d,\d{3} members each \(rays\.range_ratio\) may need"
    with pytest.raises(InputError, match=message):
        check_memory(["ekf"], 51, Config(rays=RayConfig(range_ratio=1.001)), passive=True)
    with pytest.raises(InputError, match="20000 landmarks may need"):
        check_memory(["ekf"], 20_000, Config(), passive=False)


def test_too_many_steps_are_refused_before_a_path_is_drawn(monkeypatch):
    monkeypatch.setattr(machine, "installed", lambda: 4.0 * GB)
    monkeypatch.setattr(validate, "world_of", lambda _: pytest.fail("drawn"))
    config = Config(scenario=ScenarioConfig(steps=200_000_000))
    with pytest.raises(InputError, match=r"200,000,000 steps may need .* GB .* has 4.0 GB"):
        run_mission(config, ["fused"])


def test_steps_count_for_every_trial_frame_and_worker(monkeypatch):
    setup = ScenarioConfig(steps=1000)
    need = 8 * (1000 * (3 * 18 + 12 * 6) + 250 * 50 * (1 + 3) * 9)
    monkeypatch.setattr(machine, "installed", lambda: need)
    check_length(setup, strategies=3, filters=2)
    for more in ({"strategies": 4, "filters": 2}, {"strategies": 3, "filters": 3}):
        with pytest.raises(InputError):
            check_length(setup, **more)
    with pytest.raises(InputError, match="in each of 2 workers"):
        check_length(setup, strategies=3, filters=2, workers=2)


def test_the_estimated_memory_of_a_step_matches_the_measured():
    def peak(steps):
        setup = ScenarioConfig(steps=steps, steps_per_frame=steps, landmarks=12)
        tracemalloc.start()
        run_mission(Config(scenario=setup), ["active"])
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    peak(8)
    step = (peak(10_000) - peak(5_000)) / 5_000
    said = 8 * (COPIES * machine.STEP_NUMBERS + machine.TRACK_NUMBERS)
    assert step == pytest.approx(said, rel=0.2)


@pytest.mark.parametrize("taper", [0.0, 0.2])
def test_the_estimated_memory_of_a_recording_matches_the_measured(taper, monkeypatch):
    config = Config(
        scenario=ScenarioConfig(steps=4, landmarks=2), emitter=EmitterConfig(taper=taper)
    )
    said = {}
    monkeypatch.setattr(machine, "_refuse_beyond", lambda what, need, _: said.update({what: need}))
    run_mission(config, ["active"])
    tracemalloc.start()
    run_mission(config, ["active"])
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    (recording,) = (need for what, need in said.items() if "recording" in what)
    assert 0.3 * recording < most < 2.0 * recording


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


def test_a_run_that_hears_passively_among_others_needs_room_for_rays(monkeypatch):
    config = Config(scenario=ScenarioConfig(steps=8))
    # EKF-SLAM of 51 landmarks: 24 bytes times the square of 105 numbers, or of 411 with rays.
    monkeypatch.setattr(machine, "installed", lambda: 1e6)
    monkeypatch.setattr(validate, "check_recording", lambda *_, **__: None)
    for ways in (("active", "passive"), ("fused", "active")):
        with pytest.raises(InputError, match=r"ekf: 51 landmarks of 4 members each \(rays"):
            run_mission(config, ways)
    assert len(run_mission(config, ("active",)).trials) == 1


def test_a_study_refuses_the_total_memory_of_its_workers(tmp_path, monkeypatch):
    config = Config(fastslam=FastSlamConfig(particles=100_000))
    ways = {"strategies": ("passive",), "filters": ("fastslam",)}
    plan = Plan(name="many", iterations=1, config=config, grid={}, **ways)
    need = 3 * 8 * 100_000 * (6 * 4 * 51 + 51)
    monkeypatch.setattr(machine, "installed", lambda: 2.5 * need)
    with pytest.raises(InputError, match=f"need {need / GB:.1f} GB .* in each of 3 workers"):
        run_study(plan, tmp_path / "many", workers=3)
    assert not (tmp_path / "many").exists()


def test_study_refuses_a_drive_too_long_for_its_workers(tmp_path, monkeypatch):
    config = Config(scenario=ScenarioConfig(steps=10_000_000))
    ways = {"strategies": ("active",), "filters": ("ekf",)}
    plan = Plan(name="long", iterations=1, config=config, grid={}, **ways)
    monkeypatch.setattr(machine, "installed", lambda: 20.0 * GB)
    with pytest.raises(InputError, match=r"10,000,000 steps may need .* in each of 3 workers"):
        run_study(plan, tmp_path / "long", workers=3)
    assert not (tmp_path / "long").exists()


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
for _ in range(20):
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
