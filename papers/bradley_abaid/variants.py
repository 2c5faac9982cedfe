"""The whole study again with one thing changed at a time: which verdicts hang on it.

    python papers/bradley_abaid/variants.py FOLDER [--workers 2]

Each variant is a study of its own below FOLDER, the plan `physics` with something changed: 5750
trials in the worlds of the first. One that is done is only read. Written as ``variants.csv`` beside
this file: landmarks that passive EKF-SLAM places, worlds left out, gain of fused over active
sensing in position at 11 degrees, verdicts. (The kept table is from a report that left a world out
where any case diverged, and that judged eight claims by statements of its own.)
"""

import argparse
import csv
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

VARIANTS: dict[str, dict[str, str]] = {
    "study": {},
    "runs": {
        "detection.snapshots": "runs",
        "detection.peak-db": "0",
        "emitter.level-db": "50.4",
        "beacon.level-db": "43.3",
        "rays.prune_threshold": "5e-6",
    },
    "off_axis": {
        "emitter.directivity_law": "power",
        "emitter.level-db": "48.8",
        "beacon.level-db": "42.8",
        "rays.prune_threshold": "2e-5",
    },
    "bearing": {"rays.range_update": "bearing"},
    "n1": {"rays.exponent": "1", "rays.prune_threshold": "5e-4"},
    "n3": {"rays.exponent": "3", "rays.prune_threshold": "2e-9"},
    "aggregated": {"rays.weights": "aggregated"},
    "exact": {"fastslam.mixture": "exact"},
    "bistatic": {
        "air.spreading": "bistatic",
        "emitter.level-db": "50.2",
        "beacon.level-db": "61.9",
    },
    "particles300": {"fastslam.particles": "300"},
    "particles1000": {"fastslam.particles": "1000"},
}
"""Settings by the variant's name. With each power of n goes the tau that reaches the paper's count,
with the bistatic law the levels that do (``sensitivity.csv``), with the paper's reading of
snapshots and of the off-axis loss, each alone, both (``readings.csv``)."""
OUT = Path(__file__).with_name("variants.csv")


def flags(settings: Mapping[str, str]) -> list[str]:
    """Word settings as the command line takes them."""
    return [word for key, value in settings.items() for word in (f"--{key}", value)]


def pipistrelle(*words: str) -> None:
    """Run a verb; its failure ends the script."""
    status = subprocess.call([sys.executable, "-m", "pipistrelle", *words])
    if status:
        sys.exit(status)


def found(folder: Path) -> Iterator[tuple[str, object]]:
    """Read out of a study's report what the table shows."""
    summary = json.loads((folder / "report" / "summary.json").read_text(encoding="utf-8"))
    passive = [row for row in summary["table_ii"] if row["beamwidth"].startswith("passive")]
    for row, left in zip(passive, summary["exclusions"], strict=True):
        yield f"placed_passive_{row['filter']}", round(row["full"][0], 1)
        yield f"left_out_{left['filter']}", left["excluded"]
    with (folder / "report" / "figures" / "gain.csv").open(encoding="utf-8") as file:
        gains = [row for row in csv.DictReader(file) if row["panel"].startswith("position")]
    for name, title in (("ekf", "position, EKF"), ("fastslam", "position, FastSLAM 2.0")):
        narrowest = min(
            (row for row in gains if row["panel"] == title and row["exclusion"] == "world"),
            key=lambda row: float(row["beamwidth_deg"]),
        )
        yield f"gain_{name}_m", round(float(narrowest["gain_m"]), 2)
    yield "verdicts", "; ".join(claim["verdict"].replace("-", " ") for claim in summary["claims"])


def main() -> None:
    """Run what is not done, report it, write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--workers", default="2")
    given = parser.parse_args()
    rows = []
    for name, settings in VARIANTS.items():
        folder = given.folder / name
        words = ["--output", str(folder), "--workers", given.workers, *flags(settings)]
        pipistrelle("study", "physics", *words)
        pipistrelle("report", str(folder))
        rows.append({"variant": name, "settings": " ".join(flags(settings)), **dict(found(folder))})
    with OUT.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main()
