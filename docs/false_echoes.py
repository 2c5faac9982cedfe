"""Print the tables of false echoes in `association.md` anew.

    python docs/false_echoes.py [WORLDS [FRAMES]]

Worlds of a seed that no study uses are heard without labels, and each row of a frame is held
against the true arrivals: it is right, or false in one of five ways. Then the same worlds are
driven through, with the settings of the study `association`.
"""

import sys
from collections import Counter
from time import process_time

import numpy as np
from association_tables import BEAMS, planned, settings_of

import pipistrelle
from pipistrelle.acoustics.paths import VEHICLE
from pipistrelle.config import Config
from pipistrelle.detection.front_end import same_echo
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.oracle import label_detections
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.geometry import wrap

SEED = 31337
WAYS = ("merge", "resolve")
TONES = {"own": VEHICLE, "beacon's": VEHICLE + 1}
KINDS = ("between two echoes", "a neighbour's edge", "bearing off", "leakage", "noise")
LEAK_DB = -30.0
"""Level of a call's edges in another tone, relative to the call."""
FAINT_DB = 12.0
"""Of echoes that overlap those count that are fainter than the loudest by no more."""


def settings(way, frames):
    """Return those of the study `association`, for so many frames."""
    changes = {"detection.overlaps": way, "scenario.steps": 4 * frames}
    return settings_of("iekf", seed=SEED, **changes)


def kind_of(caller, delay, bearing, arrivals, faintest_db):
    """Tell in which way a row is false, by the arrivals that are heard at its time."""
    pulse = Config().emitter.call_duration
    late = np.abs(arrivals.delay - delay)
    level = arrivals.level_db + 20.0 * np.log10(np.maximum(1.0 - late / pulse, 1e-9))
    here = (arrivals.caller == caller) & (level > faintest_db)
    loudest = level[here].max(initial=-np.inf)
    others = arrivals.level_db[(arrivals.caller != caller) & (late <= 1.5 * pulse)]
    if others.max(initial=-np.inf) + LEAK_DB > loudest:
        return "leakage"
    if not here.any():
        return "noise"
    if np.any(here & (np.abs(wrap(arrivals.bearing - bearing)) <= 0.1)):
        return "a neighbour's edge"
    if np.count_nonzero(here & (level > loudest - FAINT_DB)) == 1:
        return "bearing off"
    return "between two echoes"


class Ledger:
    """Counts what the rows of frames are, as an oracle that listens along."""

    def __init__(self):
        self.frames, self.counts = 0, {caller: Counter() for caller in TONES.values()}

    def __call__(self, found, arrivals, layout, gates, *, pulse, faintest_db):
        """Label detections, and count the rows that they are without labels."""
        known = {"pulse": pulse, "faintest_db": faintest_db}
        label = label_detections(found, arrivals, layout, gates, **known)
        near = {"delay_gate": gates.delay_gate * pulse, "bearing_gate": gates.bearing_gate}
        echo, threshold_db = same_echo(found, **near), faintest_db + gates.margin_db
        self.frames += 1
        for caller, counts in self.counts.items():
            heard = set()
            for number in np.unique(echo[found.caller == caller]):
                rows = np.flatnonzero(echo == number)
                first = rows[found.power[rows].argmax()]
                causes = label[rows][label[rows] != UNLABELLED]
                where = found.delay[first], found.bearing[first]
                counts["rows"] += 1
                if causes.size:
                    counts["right"] += 1
                    heard.add(causes[0])
                else:
                    counts[kind_of(caller, *where, arrivals, threshold_db - 10.0)] += 1
            loud = (arrivals.caller == caller) & (arrivals.level_db > threshold_db)
            counts["arrivals"] += np.count_nonzero(loud)
            counts["found"] += len(heard & {*arrivals.landmark[loud].tolist()})
        return label


def measured(way, radius, worlds, frames):
    """Return what the rows of frames are, and the CPU time of hearing one without labels [ms]."""
    config, ledger, cpu = settings(way, frames), Ledger(), 0.0
    for world in range(worlds):
        scenario = world_of(config, world)
        listen(scenario, config, [radius], iteration=world, oracle=ledger)
        begun = process_time()
        listen(scenario, config, [radius], iteration=world, labels=False)
        cpu += process_time() - begun
    return ledger, 1e3 * cpu / ledger.frames


def rows_table(worlds, frames):
    """Print what the rows of a frame are, without and with overlaps resolved."""
    names = ("rows", "right", *KINDS)
    print("| tone, beam | " + " | ".join(names) + " | arrivals found [%] | CPU of a frame [ms] |")
    print("|---" + "|--:" * (len(names) + 2) + "|")
    for beam, radius in BEAMS.items():
        both = [measured(way, radius, worlds, frames) for way in WAYS]
        for tone, caller in TONES.items():
            counts = [(ledger.counts[caller], ledger.frames) for ledger, _ in both]
            cells = [" → ".join(f"{c[name] / n:.2f}" for c, n in counts) for name in names]
            cells.append(" → ".join(f"{100.0 * c['found'] / c['arrivals']:.1f}" for c, _ in counts))
            cells.append(" → ".join(f"{cpu:.2f}" for _, cpu in both))
            print(f"| {tone}, {beam} | " + " | ".join(cells) + " |", flush=True)


def missions_table(worlds):
    """Print what that does to missions, with labels and without."""
    grid = {"detection.overlaps": WAYS, "association.method": ["known", "marginal"]}
    plan = planned(grid | {"emitter.radius": [*BEAMS.values()]}, seed=SEED)
    trials = pipistrelle.study(plan, iterations=worlds).trials.to_dicts()
    names = [f"{what}, {how}" for how in ("labels", "none") for what in ("[m]", "aligned [mm]")]
    names += ["right [%]", "missed", "false", "twice"]
    print("\n| sensing, beam | " + " | ".join(names) + " |\n|---" + "|--:" * len(names) + "|")
    for strategy in plan["strategies"]:
        for beam, radius in {"": None}.items() if strategy == "passive" else BEAMS.items():
            here = [t for t in trials if t["strategy"] == strategy]
            here = [t for t in here if radius in (t["emitter.radius"], None)]
            print(f"| {strategy} {beam} | " + " | ".join(mission_cells(here)) + " |")


def mission_cells(trials):
    """Return cells, without and with overlaps resolved, of one case's trials."""

    def both(method, score, mean, form):
        values = [
            [t[score] for t in trials if (t["detection.overlaps"], t["association.method"]) == key]
            for key in ((way, method) for way in WAYS)
        ]
        return " → ".join(form.format(mean(np.array(one, float))) for one in values)

    cells = []
    for method in ("known", "marginal"):
        cells.append(both(method, "position_rmse_m", lambda x: np.sqrt(np.mean(x**2)), "{:.2f}"))
        cells.append(both(method, "position_rmse_aligned_m", lambda x: 1e3 * np.mean(x), "{:.0f}"))
    cells.append(both("marginal", "associated_right", lambda x: 100.0 * np.nanmean(x), "{:.1f}"))
    for score in ("landmarks_missed", "landmarks_false", "landmarks_twice"):
        cells.append(both("marginal", score, np.mean, "{:.1f}"))
    return cells


def main(worlds=24, frames=40):
    """Print both tables."""
    rows_table(worlds, frames)
    missions_table(worlds)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
