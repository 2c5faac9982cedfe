"""What three callers' sound costs beside one's, and what it cannot cost less.

python -m benchmarks.callers WORLDS     # ratio, floor and counts as JSON

Each caller has a tone, so that four are heard in place of two; each echoes from every landmark, and
an echo is heard at every tone. The floor is what one caller's sound would take if its parts only
had that much more to do, each by its own count, and all else no more.
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
"""The parts of listening that grow, and how much each has to do."""
WORLDS = 9


def measure(worlds: int = WORLDS) -> tuple[list[Row], list[float]]:
    """Time both in turns in a process of its own: the row; no yardstick, for it is a ratio."""
    told = answer("-m", "benchmarks.callers", str(worlds))
    note = f"{told['noise']:.2f} times the noise, {told['echoes']:.2f} times the echoes by tones"
    command, ratio = "./dev bench --only callers", told["ratio"]
    found = row(
        "three_callers_over_one", ratio, command, ratio=ratio, floor=told["floor"], note=note
    )
    return [found], []


class Sound:
    """Times and counts of the sound of some worlds."""

    def __init__(self, tones: tuple[float, ...]) -> None:
        self.tones = tones
        self.seconds: list[float] = []
        self.part: Counter[str] = Counter()
        self.count: Counter[str] = Counter()

    def hear(self, seed: int) -> None:
        """Listen through a world."""
        callers = tuple(CallerConfig(name=f"at{f:.0f}", frequency=f) for f in self.tones)
        config = Config(seed=seed, callers=callers)
        world, parts = world_of(config), {name: self._timed(name) for name in TASKS}
        find = parts.pop("find_calls")
        with patch.multiple(listening, **parts):
            began = time.process_time()
            listening.listen(world, config, (config.emitter.radius,), find=find)
            self.seconds.append(time.process_time() - began)

    def _timed(self, name: str) -> Callable[..., Any]:
        """Return a part of listening that keeps its time and its count."""
        function = getattr(listening, name)

        def timed(*arguments: Any, **named: Any) -> Any:
            began = time.process_time()
            found = function(*arguments, **named)
            self.part[name] += time.process_time() - began
            self.count[name] += TASKS[name](found, *arguments)
            return found

        return timed


def shares(worlds: int) -> dict[str, float]:
    """Return the ratio of CPU times, the median over worlds, its floor, and counts."""
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
