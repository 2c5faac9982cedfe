"""Timings of the stages of a mission, in CPU time on a single core, for `./dev bench`.

Each stage is timed between two timings of the calibration kernel; the numbers of frames and the
lower bounds are stored with it.
"""

import time
from statistics import median

import pytest

from benchmarks.calibration import calibrate
from benchmarks.counts import covariance_updates, elementary_functions
from benchmarks.limits import elementary_function, multiply_add
from benchmarks.worlds import RADII, scans_of, world_of
from pipistrelle.config import Config, FilterConfig, RayConfig
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.machine import keep_freed_memory
from pipistrelle.experiments.named_settings import Case
from pipistrelle.experiments.runs.heard_world import drive_of
from pipistrelle.experiments.runs.trial import run_trial
from reference.drives import turn_and_drive

keep_freed_memory()  # as the commands do
CONFIG = Config()
WORLD = world_of(CONFIG)
ONE = (CONFIG.emitter.radius,)

pytestmark = pytest.mark.benchmark(timer=time.process_time)


@pytest.fixture(autouse=True)
def _yardstick(benchmark):
    """Store the time of the calibration kernel around a stage [s]."""
    before = calibrate(time.process_time)
    yield
    after = calibrate(time.process_time)
    benchmark.extra_info["calibration_s"] = 0.5 * (before + after)


def test_listening_through_one_beam(benchmark):
    benchmark.extra_info["frames"] = 375
    benchmark.pedantic(listen, (WORLD, CONFIG, ONE), rounds=9, warmup_rounds=1)


def test_listening_through_twelve_beams(benchmark):
    benchmark.extra_info["frames"] = 375 * len(RADII)
    benchmark.pedantic(listen, (WORLD, CONFIG, RADII), rounds=5, warmup_rounds=1)


def test_listening_to_sweeps_and_to_tones(benchmark):
    """Time frames with sweeps and, before each of their rounds, frames with tones."""
    tones, rounds = [], 5
    sweep = {"call": "sweep", "sweep": "hyperbolic"}
    bands = {"emitter": sweep, "beacon": sweep | {"band": (90e3, 65e3)}}
    config = Config.model_validate(bands)
    world = world_of(config)

    def to_tones():
        began = time.process_time()
        listen(WORLD, CONFIG, ONE)
        tones.append(time.process_time() - began)

    benchmark.extra_info["frames"] = 375
    benchmark.pedantic(listen, (world, config, ONE), setup=to_tones, rounds=rounds, warmup_rounds=1)
    pairs = zip(benchmark.stats.stats.data, tones[-rounds:], strict=True)
    benchmark.extra_info["over_tones"] = median(one / other for one, other in pairs)


@pytest.mark.parametrize("strategy", ["active", "fused", "passive"])
@pytest.mark.parametrize("name", ["ekf", "fastslam"])
def test_mission(benchmark, name, strategy):
    scans, drive = scans_of(CONFIG, strategy), drive_of(WORLD, CONFIG)
    case = Case(strategy=strategy, filter=name)
    if name == "ekf":
        seconds = covariance_updates(case, drive, scans, CONFIG) * multiply_add()
    else:
        seconds = elementary_functions(case, drive, scans, CONFIG) * elementary_function()
    benchmark.extra_info["floor_s"] = seconds
    benchmark.pedantic(run_trial, (case, drive, scans, CONFIG), rounds=15, warmup_rounds=1)


@pytest.mark.parametrize("name", ["iekf", "smoother"])
def test_estimator(benchmark, name):
    """Time a fused mission and, before each of its rounds, the EKF's."""
    scans, drive, ekf = scans_of(CONFIG, "fused"), drive_of(WORLD, CONFIG), []

    def the_ekfs():
        began = time.process_time()
        run_trial(Case(strategy="fused", filter="ekf"), drive, scans, CONFIG)
        ekf.append(time.process_time() - began)

    case, rounds = Case(strategy="fused", filter=name), 5
    benchmark.pedantic(
        run_trial, (case, drive, scans, CONFIG), setup=the_ekfs, rounds=rounds, warmup_rounds=1
    )
    pairs = zip(benchmark.stats.stats.data, ekf[-rounds:], strict=True)
    benchmark.extra_info["over_ekf"] = median(mine / its for mine, its in pairs)


@pytest.mark.parametrize("name", ["ekf", "iekf", "smoother"])
def test_precise_bearings(benchmark, name):
    """Time a drive of 300 scans with bearings of 0.003 rad; store its aligned error."""
    drive, scans = turn_and_drive(1)
    config = Config(
        filter=FilterConfig(gate=0.999),
        rays=RayConfig(range_bounds=(0.1, 10.0), precise_bearings="auto"),
    )
    case = Case(strategy="passive", filter=name)
    found = benchmark.pedantic(run_trial, (case, drive, scans, config), rounds=3, warmup_rounds=1)
    benchmark.extra_info["aligned_m"] = found.scores.position_rmse_aligned_m
