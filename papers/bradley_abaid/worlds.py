"""What the settings give over a number of worlds, beside the paper's Table II.

    python papers/bradley_abaid/worlds.py [--worlds 20] [--first-seed 0] [--filter both]

Each world is heard once through the paper's beams of 180, 33 and 11 degrees (pistons of 2.5, 8.8
and 25 mm), and mapped by EKF-SLAM, or also by FastSLAM 2.0, whose rays are treated the paper's way
(federated) or as an exact mixture. "over" counts the worlds whose largest NEES passes the filter's
limit. Errors of the measurements are those of the scans, after the
averaging over faces. The levels were fitted on other worlds (seeds from 1000 on), see README.md.
"""

import argparse
from collections.abc import Sequence
from itertools import product
from statistics import fmean

import numpy as np

from pipistrelle.config import Config, FastSlamConfig, Strategy
from pipistrelle.detection.front_end import FrameMeasurements
from pipistrelle.detection.scans import Scan
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import Scenario, standing_landmarks, world_of
from pipistrelle.experiments.named_settings import Case
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of
from pipistrelle.experiments.runs.trial import run_trial
from pipistrelle.geometry import range_and_bearing, wrap

RADII = {"180": 0.0025, "33": 0.0088, "11": 0.025}
PAPER_TOTAL = {"fused 180": 43.7, "fused 33": 40.8, "fused 11": 40.1, "passive": 39.5}
PAPER_FULL = {
    "ekf": {"fused 180": 37.7, "fused 33": 31.9, "fused 11": 30.0, "passive": 26.6},
    "fastslam": {"fused 180": 39.3, "fused 33": 32.6, "fused 11": 30.5, "passive": 22.1},
}
WAYS = {"ekf": ("ekf", "federated"), "fastslam": ("fastslam", "federated"),
        "exact": ("fastslam", "exact")}  # fmt: skip
COLUMNS = (
    "total", "paper", "full", "paper", "position_m", "heading_rad", "nees", "nees_max", "over",
    "bearing_rad", "range_m", "per_frame",
)  # fmt: skip


def measurement_errors(scans: Sequence[Scan], scenario: Scenario) -> tuple[float, float]:
    """Return the RMS errors of bearing [rad] and range [m] against the true geometry."""
    _, places = standing_landmarks(scenario)
    bearing, distance = [], []
    for scan in scans:
        k = int(np.searchsorted(scenario.time, scan.time))
        true_range, true_bearing = range_and_bearing(scenario.path[k], places[scan.landmark - 1])
        bearing.append(wrap(scan.bearing - true_bearing))
        distance.append(scan.range - true_range)
    ranges = np.concatenate(distance)
    ranged = ranges[np.isfinite(ranges)]
    spread = float(np.sqrt(np.mean(ranged**2))) if ranged.size else float("nan")
    return float(np.sqrt(np.mean(np.concatenate(bearing) ** 2))), spread


def world_rows(
    seed: int, config: Config, ways: Sequence[str]
) -> tuple[dict[tuple[str, str], list[float]], dict[str, float]]:
    """Return one row of numbers per case, and the clutter per frame of each beam."""
    config = config.model_copy(update={"seed": seed})
    scenario = world_of(config)
    drive = drive_of(scenario, config)
    beams = dict(zip(RADII, listen(scenario, config, tuple(RADII.values())), strict=True))
    cases: list[tuple[str, Strategy, tuple[FrameMeasurements, ...]]] = [
        ("passive", "passive", beams["11"])
    ]
    for name, heard in beams.items():
        cases += [(f"fused {name}", "fused", heard), (f"active {name}", "active", heard)]
    rows = {}
    for (name, strategy, heard), way in product(cases, ways):
        scans = scans_of(heard, strategy, config)
        filter_name, mixture = WAYS[way]
        chosen = config.model_copy(update={"fastslam": FastSlamConfig(mixture=mixture)})
        scores = run_trial(Case(strategy=strategy, filter=filter_name), drive, scans, chosen).scores
        rows[name, way] = [
            scores.landmarks_total, scores.landmarks_full, scores.position_rmse_m,
            scores.heading_rmse_rad, scores.nees_mean, scores.nees_max, scores.diverged,
            *measurement_errors(scans, scenario), scores.measurements_per_frame,
        ]  # fmt: skip
    return rows, {name: fmean(f.clutter for f in heard) for name, heard in beams.items()}


def main() -> None:
    """Print the table."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--worlds", type=int, default=20)
    options.add_argument("--first-seed", type=int, default=0)
    options.add_argument("--filter", choices=("ekf", "both"), default="ekf")
    chosen = options.parse_args()
    ways = ("ekf",) if chosen.filter == "ekf" else tuple(WAYS)
    worlds = [world_rows(chosen.first_seed + i, Config(), ways) for i in range(chosen.worlds)]
    print(f"{'case':<12}{'filter':<10}" + "".join(f"{name:>12}" for name in COLUMNS))
    for name, way in sorted(worlds[0][0], key=lambda key: key[0]):
        mean = [fmean(float(rows[name, way][i]) for rows, _ in worlds) for i in range(10)]
        full = PAPER_FULL[WAYS[way][0]].get(name, np.nan)
        cells = [mean[0], PAPER_TOTAL.get(name, np.nan), mean[1], full, *mean[2:]]
        print(f"{name:<12}{way:<10}" + "".join(f"{cell:12.4g}" for cell in cells))
    for name in RADII:
        print(f"clutter per frame, {name} degrees: {fmean(c[name] for _, c in worlds):.2f}")


if __name__ == "__main__":
    main()
