"""Merging: what the faces and the tones say of one landmark becomes one measurement."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import Strategy
from pipistrelle.detection.scans import UNLABELLED, Scan
from pipistrelle.detection.snapshots import Detections
from pipistrelle.geometry import wrap, wrap_angle
from pipistrelle.jit import kernel


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """One frame's landmarks with what each tone says of them, averaged over the faces.

    Attributes
    ----------
    time : [s]
    landmark : (m)
        Labels, rising.
    bearing : (m, 2) [rad]
        By the vehicle's tone and by the beacon's; NaN where that tone was not heard.
    range : (m) [m]
        By the vehicle's tone; NaN where it was not heard.
    clutter : int
        Detections without a label.
    """

    time: float
    landmark: Int[np.ndarray, " m"]
    bearing: Float[np.ndarray, "m 2"]
    range: Float[np.ndarray, " m"]
    clutter: int


def average_faces(
    time: float,
    detections: Detections,
    label: Int[np.ndarray, " d"],
    *,
    averaging: str,
    speed_of_sound: float,
) -> Heard:
    r"""Average what the faces say of each landmark, per tone: its strongest estimate of each.

    Bearings are averaged as directions, ``plain`` or ``weighted`` by the inverse variance at the
    array's angle, :math:`\cos^2\theta`. The range is c/2 times the mean delay.

    Parameters
    ----------
    time : [s]
    detections : Detections
        (d) rows.
    label : (d)
        Landmark of each detection, or UNLABELLED.
    averaging : "plain" or "weighted"
    speed_of_sound : [m/s]

    Returns
    -------
    Heard

    Notes
    -----
    Bradley & Abaid, Sec. II-D.

    Examples
    --------
    >>> detections = Detections(
    ...     face=np.array([0, 1]), tone=np.array([0, 0]), angle=np.radians([40.0, -50.0]),
    ...     bearing=np.radians([40.0, 42.0]), delay=np.array([0.02, 0.02]), power=np.ones(2))
    >>> heard = average_faces(
    ...     0.5, detections, np.array([3, 3]), averaging="plain", speed_of_sound=343.0)
    >>> np.degrees(heard.bearing[0, 0]).round(6), heard.range.round(6)
    (np.float64(41.0), array([3.43]))
    """
    labels, clutter = _distinct(label)
    bearing, delay = _average(
        labels, label, detections.face, detections.tone, detections.angle, detections.bearing,
        detections.delay, detections.power, averaging == "weighted",
    )  # fmt: skip
    return Heard(
        time=time,
        landmark=labels,
        bearing=bearing,
        range=0.5 * speed_of_sound * delay,
        clutter=clutter,
    )


def scan_of(heard: Heard, strategy: Strategy) -> Scan:
    """Take from a frame what a sensing strategy takes.

    Active takes the vehicle's tone alone, passive the beacon's alone, fused both: the mean of the
    bearings where both are there.

    Parameters
    ----------
    heard : Heard
    strategy : "active", "fused" or "passive"

    Returns
    -------
    Scan

    Examples
    --------
    >>> heard = Heard(time=0.5, landmark=np.array([2, 5]), range=np.array([4.0, np.nan]),
    ...               bearing=np.array([[0.2, 0.4], [np.nan, 1.0]]), clutter=0)
    >>> scan_of(heard, "fused").bearing.round(9).tolist()
    [0.3, 1.0]
    >>> scan_of(heard, "active").landmark.tolist()
    [2]
    """
    own, other = heard.bearing[:, 0], heard.bearing[:, 1]
    if strategy == "active":
        kept, bearing = ~np.isnan(own), own
    elif strategy == "passive":
        kept, bearing = ~np.isnan(other), other
    else:
        kept = np.ones(own.size, dtype=bool)
        halfway = wrap(own + 0.5 * wrap(other - own))
        bearing = np.where(np.isnan(own), other, np.where(np.isnan(other), own, halfway))
    distance = np.full(own.size, np.nan) if strategy == "passive" else heard.range
    return Scan(
        time=heard.time,
        landmark=heard.landmark[kept],
        bearing=bearing[kept],
        range=distance[kept],
    )


@kernel
def _distinct(label):
    """Labels that occur, rising, and how often none was given."""
    labels, count, clutter = np.empty_like(label), 0, 0
    for d in range(label.size):
        if label[d] == UNLABELLED:
            clutter += 1
            continue
        place = count
        while place > 0 and labels[place - 1] > label[d]:
            place -= 1
        if place > 0 and labels[place - 1] == label[d]:
            continue
        for i in range(count, place, -1):
            labels[i] = labels[i - 1]
        labels[place] = label[d]
        count += 1
    return labels[:count].copy(), clutter


@kernel
def _average(labels, label, face, tone, angle, bearing, delay, power, weighted):
    """Mean direction and delay of each landmark and tone over its strongest rows per face."""
    mean_bearing = np.full((labels.size, 2), np.nan)
    mean_delay = np.full(labels.size, np.nan)
    faces = 0
    for d in range(face.size):
        faces = max(faces, face[d] + 1)
    strongest = np.empty(faces, dtype=np.int64)
    for i in range(labels.size):
        for p in range(2):
            strongest[:] = -1
            for d in range(label.size):
                best = strongest[face[d]]
                if label[d] == labels[i] and tone[d] == p and (best < 0 or power[d] > power[best]):
                    strongest[face[d]] = d
            total = east = north = late = 0.0
            for f in range(faces):
                d = strongest[f]
                if d >= 0:
                    weight = math.cos(angle[d]) ** 2 if weighted else 1.0
                    total += weight
                    east += weight * math.cos(bearing[d])
                    north += weight * math.sin(bearing[d])
                    late += weight * delay[d]
            if total > 0.0:
                mean_bearing[i, p] = wrap_angle(math.atan2(north, east))
                if p == 0:
                    mean_delay[i] = late / total
    return mean_bearing, mean_delay
