"""Print the times that `association.md` tells of missions without labels, and with them.

    python docs/association_time.py [WORLDS]

Worlds of a seed that no study uses are heard without labels and driven through, fused at 180°, with
the settings of the study `association`, with labels and by `marginal`, in turns.
"""

import sys
from time import process_time

import numpy as np
from association_tables import BEAMS, settings_of

from pipistrelle.detection.noise import noise_of
from pipistrelle.estimation.catalogue import entry
from pipistrelle.estimation.data_association.sequential import association_of
from pipistrelle.estimation.session import Session
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.experiments.machine import keep_freed_memory
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of

SEED, WORLDS, TURNS = 515151, 5, 3


def settings(name, method):
    """Return those of the study `association` for one filter and method, and another seed."""
    return settings_of(name, seed=SEED, **{"association.method": method})


def times(config, name, drive, scans):
    """Return the CPU time of each frame of a mission [ms]."""
    session = Session(
        entry(name).build(config, drive.motion), drive.start, np.random.default_rng(0),
        association=association_of(config), noise=noise_of(config.filter),
    )  # fmt: skip
    steps, done, took = np.searchsorted(drive.time, [scan.time for scan in scans]), 0, []
    for last, scan in zip(steps.tolist(), scans, strict=True):
        begin = process_time()
        session.move(drive.controls[done:last], np.diff(drive.time[done : last + 1]))
        session.hear(scan)
        took.append(1e3 * (process_time() - begin))
        done = last
    return np.array(took)


def main(worlds):
    """Print median and 99th of a hundred of the frames' times, and how much longer missions are."""
    keep_freed_memory()  # as the commands do
    told = settings("iekf", "known")
    scenarios = [world_of(told, world) for world in range(worlds)]
    heard = [
        listen(scenario, told, [BEAMS["180°"]], iteration=world, labels=False)[0]
        for world, scenario in enumerate(scenarios)
    ]
    for name in ("iekf", "smoother"):
        least = {"known": [], "marginal": []}
        for world, (scenario, frames) in enumerate(zip(scenarios, heard, strict=True)):
            turns = {method: [] for method in least}
            for _ in range(TURNS):
                for method, measured in turns.items():
                    config = settings(name, method)
                    drive, scans = (
                        drive_of(scenario, config, world),
                        scans_of(frames, "fused", config),
                    )
                    measured.append(times(config, name, drive, scans))
            for method, measured in turns.items():
                least[method].append(np.min(measured, axis=0))
        for method, measured in least.items():
            frames = np.concatenate(measured)
            median, late = np.quantile(frames, (0.5, 0.99))
            print(f"{name} {method}: {median:.2f} ms a frame, 99 % {late:.2f}")
        missions = zip(least["marginal"], least["known"], strict=True)
        longer = np.median([one.sum() / other.sum() for one, other in missions])
        print(f"{name}: missions take {longer:.1f} times as long")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else WORLDS)
