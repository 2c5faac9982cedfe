"""Cost of simulating three callers relative to one, and its lower bound.

python -m benchmarks.callers WORLDS     # ratio, floor and counts as JSON

Each caller has a tone, so four tones are simulated instead of two; each echoes from every landmark,
and an echo is computed at every tone. The floor scales each part of the time with one caller by the
growth of its count, and keeps the rest.
"""

import json
import sys
import time
from collections import Counter
from collections.abc import Callable
from statistics import median
from typing import Any
from unittest.mock import patch

from benchmarks.machine import answer
from benchmarks.promises import row
from benchmarks.table import Row
from pipistrelle.config import CallerConfig, Config
from pipistrelle.experiments.hearing import listening
from pipistrelle.experiments.hearing.scenario import world_of

TONES = (30e3, 25e3, 20e3)
"""Frequencies of the callers [Hz]."""
TASKS: dict[str, Callable[..., int]] = {
    "noise_blocks": lambda found, *_: found.size,
    "add_echo_blocks": lambda _, signal, arrivals, *__: arrivals.delay.size * signal.shape[2],
    "filter_blocks": lambda found, *_: found.size,
    "find_calls": lambda found, *_: found.delay.size,
}
"""Parts of the simulation that grow, with the count of work in each."""
WORLDS = 9


def measure(worlds: int = WORLDS) -> tuple[list[Row], list[float]]:
    """Time both cases in a separate process; return a row, and no calibration times."""
    told = answer("-m", "benchmarks.callers", str(worlds))
    note = f"{told['noise']:.2f} times the noise, {told['echoes']:.2f} times the echoes by tones"
    command, ratio = "./dev bench --only callers", told["ratio"]
    found = row(
        "three_callers_over_one", ratio, command, ratio=ratio, floor=told["floor"], note=note
    )
    return [found], []


class Sound:
    """Times and counts of the simulated sound of some worlds."""

    def __init__(self, tones: tuple[float, ...]) -> None:
        self.tones = tones
        self.seconds: list[float] = []
        self.part: Counter[str] = Counter()
        self.count: Counter[str] = Counter()

    def hear(self, seed: int) -> None:
        """Simulate the scans of a world."""
        callers = tuple(CallerConfig(name=f"at{f:.0f}", frequency=f) for f in self.tones)
        config = Config(seed=seed, callers=callers)
        world, parts = world_of(config), {name: self._timed(name) for name in TASKS}
        find = parts.pop("find_calls")
        with patch.multiple(listening, **parts):
            began = time.process_time()
            listening.listen(world, config, (config.emitter.radius,), find=find)
            self.seconds.append(time.process_time() - began)

    def _timed(self, name: str) -> Callable[..., Any]:
        """Wrap a function of the simulation to add up its time and its count."""
        function = getattr(listening, name)

        def timed(*arguments: Any, **named: Any) -> Any:
            began = time.process_time()
            found = function(*arguments, **named)
            self.part[name] += time.process_time() - began
            self.count[name] += TASKS[name](found, *arguments)
            return found

        return timed


def shares(worlds: int) -> dict[str, float]:
    """Return the median ratio of CPU times over worlds, its floor, and ratios of counts."""
    for tones in (TONES[:1], TONES):
        Sound(tones).hear(0)  # compiles
    one, three = Sound(TONES[:1]), Sound(TONES)
    for seed in range(1, worlds + 1):
        one.hear(seed)
        three.hear(seed)
    times = {name: three.count[name] / one.count[name] for name in TASKS}
    more = sum(one.part[name] * (times[name] - 1.0) for name in TASKS)
    return {
        "ratio": median(b / a for a, b in zip(one.seconds, three.seconds, strict=True)),
        "floor": 1.0 + more / sum(one.seconds),
        "noise": times["noise_blocks"],
        "echoes": times["add_echo_blocks"],
    }


if __name__ == "__main__":
    print(json.dumps(shares(int(sys.argv[1]))))
