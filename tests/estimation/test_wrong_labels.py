"""Labels of which one in twenty is wrong: what Huber's loss makes of them."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import Config
from pipistrelle.detection.scans import labelled
from pipistrelle.estimation.catalogue import entry
from reference.missions import BICYCLE, followed, measured_to, paper_mission

PRECISE = {"range_std": 0.05, "bearing_std": 0.02}


def mislabelled(mission, share, rng):
    """Give a share of the rows the label of another landmark, one that is not in the scan."""
    scans = []
    for scan in mission.scans:
        label = scan.landmark.copy()
        others = np.setdiff1d(np.arange(1, len(mission.landmarks) + 1), label)
        wrong = np.flatnonzero(rng.random(label.size) < share)[: others.size]
        label[wrong] = rng.permutation(others)[: wrong.size]
        scans.append(labelled(scan, label))
    return replace(mission, scans=scans)


def farthest(name, robust, share, seed):
    """Return how far off the vehicle is believed at most, in the second half of the drive [m]."""
    mission = paper_mission("fused", frames=150, seed=seed, **PRECISE)
    mission = replace(mission, scans=[measured_to(scan, **PRECISE) for scan in mission.scans])
    mission = mislabelled(mission, share, np.random.default_rng(seed))
    config = Config.model_validate({"filter": {"noise": "measured", "robust": robust}})
    slam = entry(name).build(config, BICYCLE)
    found = [belief.pose().mean[:2] for belief, _ in followed(slam, mission)]
    return np.hypot(*(np.array(found) - mission.path[1:, :2]).T)[75:].max()


@pytest.mark.parametrize("name", ["iekf", pytest.param("smoother", marks=pytest.mark.slow)])
def test_hubers_loss_limits_the_error_from_wrong_labels(name):
    """Of four drives the median is 0.7 m by the invariant EKF, 1.2 m by the smoother; 12 m."""
    robust, trusting = (
        np.median([farthest(name, loss, 0.05, seed) for seed in range(3, 7)])
        for loss in ("huber", "none")
    )
    assert robust < 1.6
    assert robust < 0.15 * trusting
