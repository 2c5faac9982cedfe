"""The oracle: labels of detections from the true arrivals (known data association).

The paper assumes that the landmark of each measurement is known. The label is therefore assigned
after detection by the true arrivals, by delay and bearing, as a gate in bearing only would match
most clutter to a landmark. Without the oracle `estimation.data_association` labels the scans; it
receives beliefs and scans, never the truth.
"""

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.arrays.layout import Layout, Scattered
from pipistrelle.config import MatchingConfig
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.detection.snapshots import Columns, Detections, detection_columns
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import kernel

_SAME_TIME = 1e-9
"""Difference in squared normalised distance below which two candidates count as simultaneous."""


def label_detections(
    detections: Detections,
    arrivals: Arrivals,
    layout: Layout | Scattered,
    gates: MatchingConfig,
    *,
    pulse: float,
    faintest_db: float,
) -> Int[np.ndarray, " d"]:
    """Label each detection with the landmark that reflected it, from the true arrivals.

    A true arrival of the same face and caller is a candidate if its delay and bearing are within
    the gates and its level is at least `faintest_db` [dB]; the delay gate is a share of `pulse`
    [s]. Detections choose in falling order of power, each the nearest candidate in units of the
    gates, and each arrival is used once per face. Sound scattered by a body in the path arrives
    together with the direct call; among simultaneous candidates the last is chosen, and a caller's
    direct call follows its echoes. Clutter, which matches no arrival, is UNLABELLED.

    Bradley & Abaid, Sec. III-B ("we assumed known data association").

    Two detections: landmark 7, slightly late and to the side, and clutter.

    >>> from pipistrelle.arrays.layout import square_of_four
    >>> from pipistrelle.config import Config
    >>> echoes = Arrivals(
    ...     delay=np.array([0.030, 0.050]), level_db=np.zeros(2), bearing=np.array([0.2, -0.3]),
    ...     frequency=np.full(2, 35e3), caller=np.zeros(2, np.int8), landmark=np.array([7, 9]),
    ... )
    >>> bearing = np.array([0.25, 0.6])
    >>> heard = Detections(
    ...     face=np.zeros(2, int), caller=np.zeros(2, int), angle=bearing, bearing=bearing,
    ...     delay=np.array([0.0302, 0.050]), power=np.array([90.0, 60.0]),
    ... )
    >>> layout = square_of_four(Config().receiver)
    >>> gates = MatchingConfig()
    >>> label_detections(heard, echoes, layout, gates, pulse=2.8e-3, faintest_db=-30.0)
    array([ 7, -1])
    """
    order = np.argsort(-detections.power, kind="stable")
    names = ("caller", "delay", "bearing", "level_db", "landmark")
    true = tuple(getattr(arrivals, name) for name in names)
    within = gates.delay_gate * pulse, gates.bearing_gate, faintest_db
    return _label(order, tuple(detection_columns(detections)), true, layout.normal, within)


def faintest_level_db(
    threshold: float, *, elements: int, samples: int, noise_std: float, margin_db: float
) -> float:
    """Return the level [dB] of an arrival expected `margin_db` [dB] below the detection threshold.

    `threshold` applies to the energy over a face's elements, each of unit noise variance. `samples`
    is the number per call, `noise_std` the noise of one sample.

    >>> settled = {"elements": 10, "samples": 560, "noise_std": 1.0}
    >>> round(faintest_level_db(32.7, margin_db=6.0, **settled), 1)
    -29.9
    """
    per_sample = (threshold - elements) / elements / samples * noise_std**2
    return float(10.0 * np.log10(per_sample) - margin_db)


@kernel
def _label(
    order: Int[np.ndarray, " d"],
    detections: tuple,
    arrivals: tuple,
    normal: Float[np.ndarray, " f"],
    gates: tuple[float, float, float],
) -> Int[np.ndarray, " d"]:
    """Return a label per detection by matching each to at most one arrival, strongest first."""
    found, (caller, delay, bearing, level_db, landmark) = Columns(*detections), arrivals
    face, (delay_gate, bearing_gate, faintest_db) = found.face, gates
    label = np.full(face.size, UNLABELLED, dtype=np.int64)
    taken = np.zeros((normal.size, delay.size), dtype=np.bool_)
    for d in order:
        nearest, best = -1, np.inf
        for a in range(delay.size):
            late = abs(found.delay[d] - delay[a]) / delay_gate
            if late > 1.0 or caller[a] != found.caller[d]:
                continue
            if level_db[a] < faintest_db or taken[face[d], a]:
                continue
            front = normal[face[d]]
            one_sided = front == front  # a NaN normal receives all around
            if one_sided and abs(wrap_angle(bearing[a] - front)) > 0.5 * np.pi:
                continue
            off = abs(wrap_angle(found.bearing[d] - bearing[a])) / bearing_gate
            if off <= 1.0 and late * late + off * off < best + _SAME_TIME:
                nearest, best = a, late * late + off * off
        if nearest >= 0:
            label[d] = landmark[nearest]
            taken[face[d], nearest] = True
    return label
