"""Share of a study's CPU time outside simulation and filters, with one worker in this process.

python -m benchmarks.overhead WORLDS     # CPU seconds as JSON
"""

import json
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from pipistrelle.experiments.runs.compiling import compile_kernels
from pipistrelle.experiments.studies import world
from pipistrelle.experiments.studies.plan import find_plan, read_plan
from pipistrelle.experiments.studies.study import load_study, run_study


def shares(worlds: int) -> dict[str, float]:
    """Return CPU times [s]: before the first world, and per world total, listening, filters."""
    listening, listen = 0.0, world.listen
    compile_kernels()
    before = time.process_time()

    def timed(*arguments, **named):
        nonlocal listening
        began = time.thread_time()
        heard = listen(*arguments, **named)
        listening += time.thread_time() - began
        return heard

    world.listen = timed
    with TemporaryDirectory() as name:
        run_study(read_plan(find_plan("paper"), None, worlds), Path(name) / "study")
        spent = time.process_time() - before
        filters = load_study(Path(name) / "study").trials.collect()["cpu_s"].sum()
    return {
        "before": before,
        "world": spent / worlds,
        "listening": listening / worlds,
        "filters": filters / worlds,
    }


if __name__ == "__main__":
    print(json.dumps(shares(int(sys.argv[1]))))
