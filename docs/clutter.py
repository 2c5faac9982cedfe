"""Draw what false rows and missed echoes do to association, `images/clutter.png`, anew.

    python docs/clutter.py [WORLDS]

Worlds of a seed that no study uses are heard without labels. Of each frame the rows of landmarks
are kept, each with the probability of detection, and false rows are added: uniform in bearing and
way, and as sure and as loud as rows of the frame. The invariant EKF drives through, fused, with
excess paths, by each method; with labels it has the same rows, without the false ones.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from association_tables import BEAMS, settings_of

from pipistrelle.detection.noise import noise_of, without_hidden
from pipistrelle.detection.scans import BEARING, EXCESS_PATH, RANGE, UNLABELLED, labelled
from pipistrelle.detection.scans import rows_of as some_rows
from pipistrelle.estimation.catalogue import entry
from pipistrelle.estimation.data_association.sequential import METHODS, association_of
from pipistrelle.evaluation.accuracy import alignment, moved, position_error, rmse
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import standing_landmarks, world_of
from pipistrelle.experiments.runs.heard_world import drive_of
from pipistrelle.experiments.runs.trial import run_filter

SEED = 60606
CLUTTER = (0, 5, 10, 20)
DETECTION = (1.0, 0.9, 0.7)
FARTHEST = {RANGE: 12.0, EXCESS_PATH: 20.0}
"""False ways reach so far [m]."""


def settings(method):
    """Return those of the study `association` for one method, and another seed."""
    return settings_of("iekf", seed=SEED, **{"association.method": method})


def thinned(frame, probability, config, beacon, rng):
    """Return a frame's rows of landmarks that are still detected, and their labels."""
    scan = without_hidden(frame.unlabelled, config.filter, timing=True)
    label, direct = frame.causes.copy(), scan.direct[scan.direct >= 0]
    label[direct] = beacon
    kept = (label != UNLABELLED) & (rng.random(label.size) < probability)
    kept[direct] = True
    return some_rows(scan, kept), label[kept]


def cluttered(scan, count, rng):
    """Return a scan with false rows more, as many of each caller as its share of the rows."""
    if not scan.caller.size:
        return scan
    like = rng.integers(scan.caller.size, size=count)
    numbers = scan.numbers[:, like].copy()
    numbers[BEARING] = rng.uniform(-np.pi, np.pi, count)
    for column, farthest in FARTHEST.items():
        there = ~np.isnan(numbers[column])
        numbers[column, there] = rng.uniform(0.3, farthest, there.sum())
    return replace(
        scan,
        landmark=np.append(scan.landmark, np.full(count, UNLABELLED)),
        caller=np.append(scan.caller, scan.caller[like]),
        numbers=np.hstack([scan.numbers, numbers]),
    )


def error(drive, scans, config, path, association=None):
    """Return the aligned error of the invariant EKF's track [m]."""
    estimator, noise = entry("iekf").build(config, drive.motion), noise_of(config.filter)
    rng = np.random.default_rng(0)
    track = run_filter(estimator, drive, scans, rng, association=association, noise=noise)
    points, true = track.pose.mean[:, :2], path[:, :2]
    return rmse(position_error(moved(points, alignment(points, true)), true))


def errors_of(world):
    """Return, for each detection and clutter, the error with labels and by each method."""
    known, errors = settings("known"), {}
    scenario = world_of(known, world)
    heard = listen(scenario, known, [BEAMS["180°"]], iteration=world, labels=False)[0]
    drive, path = drive_of(scenario, known, world), scenario.path
    beacon, noise = int(standing_landmarks(scenario)[0][-1]), noise_of(known.filter)
    for probability in DETECTION:
        for count in CLUTTER:
            rng = np.random.default_rng([SEED, world, count])
            rows = [thinned(frame, probability, known, beacon, rng) for frame in heard]
            labels = [noise(labelled(scan, label)) for scan, label in rows]
            found = [error(drive, labels, known, path)]
            scans = [cluttered(scan, count, rng) for scan, _ in rows]
            for config in map(settings, METHODS):
                found.append(error(drive, scans, config, path, association_of(config)))
            errors[probability, count] = found
    return errors


def draw(ratios, path):
    """Draw the ratio of errors over clutter, a panel for each probability of detection."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(DETECTION), figsize=(9.0, 3.2), sharey=True)
    for panel, probability in zip(axes, DETECTION, strict=True):
        for number, method in enumerate(METHODS):
            values = [ratios[probability, count][number] for count in CLUTTER]
            panel.plot(CLUTTER, values, marker="o", label=method)
        panel.set(title=f"detection {probability:g}", xlabel="false rows a frame", yscale="log")
        panel.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("aligned error over that with labels")
    axes[-1].legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def main(worlds=8):
    """Print the ratios of mean errors and draw them."""
    worlds, ratios = [errors_of(world) for world in range(worlds)], {}
    for probability in DETECTION:
        for count in CLUTTER:
            mean = np.mean([errors[probability, count] for errors in worlds], axis=0)
            ratios[probability, count] = mean[1:] / mean[0]
            found = zip(METHODS, ratios[probability, count], strict=True)
            words = ", ".join(f"{method} {ratio:.2f}" for method, ratio in found)
            print(f"detection {probability:g}, clutter {count}: {words}", flush=True)
    draw(ratios, Path(__file__).parent / "images" / "clutter.png")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
