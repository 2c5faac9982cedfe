"""Known association without a gate: two more ways to give a detection the landmark it belongs to.

`pipistrelle.experiments.hearing.oracle.label_detections` gives a detection no label if no true
arrival is within its gates in delay and bearing, so that bearings far from the truth never reach an
estimator. Both functions here label every detection during which something arrived.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.arrays.layout import Layout
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.detection.snapshots import Detections
from pipistrelle.geometry import wrap

SPEED_OF_SOUND = 343.0
"""For the phases at the elements [m/s]; the paper's."""


def label_by_cause(
    detections: Detections,
    arrivals: Arrivals,
    layout: Layout,
    _gates: Any,
    *,
    pulse: float,
    faintest_db: float,
) -> Int[np.ndarray, " d"]:
    r"""Label each detection with the arrival that gives most of the matched beam's output there.

    An arrival of level :math:`L_a`, at delay :math:`\tau_a` and angle :math:`\theta_a` off the
    face's normal, adds to the output of a tone's matched filter at delay :math:`\tau` in the beam
    towards :math:`\theta` the level

    .. math:: L_a + 20 \log_{10}\left(1 - \frac{|\tau - \tau_a|}{T}\right) + 20 \log_{10}
              \left|\frac1E \sum_e e^{i (\varphi_e(\theta_a) - \varphi_e(\theta))}\right|
    """
    late, reaches = _overlap(detections, arrivals, layout, pulse, faintest_db)
    angle = wrap(arrivals.bearing - layout.normal[detections.face, np.newaxis])
    level = np.full(late.shape, -np.inf)
    for d, a in zip(*np.nonzero(reaches), strict=True):
        tone = float(arrivals.frequency[a])
        apart = layout.phases(angle[d, a], tone, SPEED_OF_SOUND) - layout.phases(
            detections.angle[d], tone, SPEED_OF_SOUND
        )
        share = (1.0 - late[d, a]) * abs(np.mean(np.exp(1j * apart)))
        level[d, a] = arrivals.level_db[a] + 20.0 * np.log10(max(share, 1e-12))
    return _chosen(-level, reaches, arrivals)


def label_by_bearing(
    detections: Detections,
    arrivals: Arrivals,
    layout: Layout,
    _gates: Any,
    *,
    pulse: float,
    faintest_db: float,
) -> Int[np.ndarray, " d"]:
    """Label each detection with the nearest in bearing of the arrivals that overlap it."""
    _, reaches = _overlap(detections, arrivals, layout, pulse, faintest_db)
    off = np.abs(wrap(arrivals.bearing - detections.bearing[:, np.newaxis]))
    return _chosen(off, reaches, arrivals)


def _overlap(
    detections: Detections, arrivals: Arrivals, layout: Layout, pulse: float, faintest_db: float
) -> tuple[Float[np.ndarray, "d a"], Bool[np.ndarray, "d a"]]:
    """Return the differences in delay, in calls, and which arrivals a detection's call overlaps."""
    late = np.abs(detections.delay[:, np.newaxis] - arrivals.delay) / pulse
    ahead = np.abs(wrap(arrivals.bearing - layout.normal[detections.face, np.newaxis]))
    same = detections.caller[:, np.newaxis] == arrivals.caller
    audible = arrivals.level_db >= faintest_db
    return late, same & audible & (late < 1.0) & (ahead <= 0.5 * np.pi)


def _chosen(
    cost: Float[np.ndarray, "d a"], reaches: Bool[np.ndarray, "d a"], arrivals: Arrivals
) -> Int[np.ndarray, " d"]:
    """Return the label of the least cost among the arrivals that reach each detection."""
    if not arrivals.delay.size:
        return np.full(len(cost), UNLABELLED)
    best = np.where(reaches, cost, np.inf).argmin(axis=1)
    return np.where(reaches.any(axis=1), arrivals.landmark[best], UNLABELLED)
