"""Timings of the chain's stages, one core each: `./dev bench`.

Compare rows of one run; the machine is part of every absolute number.
"""

import subprocess
import sys

import numpy as np
import pytest

from pipistrelle.acoustics.arrivals import arrivals_of_emission, through_piston
from pipistrelle.arrays.noise import stream_key
from pipistrelle.config import Config, ReceiverConfig
from pipistrelle.detection.scans import scan_of
from pipistrelle.experiments.listening import listen
from pipistrelle.experiments.scenario import Scenario, draw_scenario
from pipistrelle.experiments.trial import Case, drive_of, run_trial

BARE_PROGRAM = """
from cyclopts import App
from pydantic import BaseModel


class Settings(BaseModel):
    number: float = 1.0


app = App(name="bare", help="A bare program.")


@app.command
def run(*, settings: Settings = Settings()):
    "Run."


app(["--help"])
"""


@pytest.fixture(scope="module")
def config() -> Config:
    return Config()


@pytest.fixture(scope="module")
def world(config: Config) -> Scenario:
    return draw_scenario(config, np.random.default_rng(stream_key(config.seed, 0, "scenario")))


def frames_of(world: Scenario, count: int) -> Scenario:
    """The start of a world: as many frames of four steps."""
    steps = 4 * count
    return Scenario(
        time=world.time[: steps + 1],
        path=world.path[: steps + 1],
        controls=world.controls[:steps],
        landmarks=world.landmarks,
        beacon=world.beacon,
    )


def test_front_end_ten_block_frames(benchmark, config, world):
    listen(world, config, (config.emitter.radius,))
    benchmark(listen, frames_of(world, 10), config, (config.emitter.radius,))


def test_front_end_ten_block_frames_through_twelve_beams(benchmark, config, world):
    radii = tuple(np.geomspace(2.5e-3, 25e-3, 12).round(4))
    benchmark(listen, frames_of(world, 10), config, radii)


def test_front_end_one_dense_frame(benchmark, config, world):
    dense = config.model_copy(update={"receiver": ReceiverConfig(engine="dense")})
    benchmark.pedantic(
        listen, (frames_of(world, 1), dense, (dense.emitter.radius,)), rounds=5, warmup_rounds=1
    )


def test_arrivals_of_one_emission(benchmark, config, world):
    def once():
        emission = arrivals_of_emission(
            world.path[4], np.array([0.75, 0.0]), world.landmarks, world.beacon, config
        )
        return through_piston(emission, radius=0.0088, frequency=35e3, speed_of_sound=343.0)

    benchmark(once)


@pytest.mark.parametrize("strategy", ["active", "fused", "passive"])
def test_ekf_mission(benchmark, config, world, strategy):
    (heard,) = listen(world, config, (config.emitter.radius,))
    scans = tuple(scan_of(frame, strategy) for frame in heard)
    drive = drive_of(world, config)
    benchmark(run_trial, Case(strategy=strategy, filter="ekf"), drive, scans, config)


@pytest.mark.parametrize(
    "program", [["-m", "pipistrelle", "--help"], ["-c", BARE_PROGRAM]], ids=["ours", "bare"]
)
def test_help(benchmark, program):
    benchmark.pedantic(
        subprocess.run,
        ([sys.executable, *program],),
        {"check": True, "stdout": subprocess.DEVNULL},
        rounds=11,
        warmup_rounds=1,
    )
