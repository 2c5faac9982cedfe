"""Echoes without labels: what the faces detected of one call, as a robot hears it.

Detections of one call, time and direction are one echo, and one row of a scan. Which rows are the
direct calls of others is found by what these are (`pipistrelle.detection.direct`).
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from pipistrelle.config import Config
from pipistrelle.detection.certainty import DIRECT_FLOOR, EDGE_FLOOR
from pipistrelle.detection.direct import without_calls
from pipistrelle.detection.faces import average_faces, same_echo
from pipistrelle.detection.scans import BEARING_STD, UNLABELLED, Scan, without_labels
from pipistrelle.detection.snapshots import Detections


def with_edge_floor(detections: Detections, config: Config) -> Detections:
    """Return detections whose direct calls begin as surely as they do (`EDGE_FLOOR`)."""
    direct = detections.direct
    if direct is None or config.detection.overlaps != "resolve":
        return detections
    floor = EDGE_FLOOR / config.assumed_sound_speed
    delay_std = np.hypot(direct.delay_std, floor)
    return replace(detections, direct=direct._replace(delay_std=delay_std))


def unlabelled_scan(
    time: float, detections: Detections, config: Config, missable: Bool[np.ndarray, " c"]
) -> tuple[Scan, Int[np.ndarray, " d"]]:
    """Average a frame's detections over the faces, by echo: one call, one time, one direction.

    `missable`: callers whose direct call may not be heard, for they have a beam or a clock of their
    own: the first of their tone is then an echo, so without labels they have no excess paths.
    Returns the scan, and the number of the echo, its row, of each detection.
    """
    gates, direct = config.matching, detections.direct
    echo = same_echo(
        detections,
        delay_gate=gates.delay_gate * config.emitter.pulse,
        bearing_gate=gates.bearing_gate,
    )
    callers = np.full(missable.size, UNLABELLED)
    if direct is not None:
        direct = without_calls(direct, missable)
        detections = replace(detections, direct=direct)
        callers = np.append(echo, UNLABELLED)[direct.detection]
    averaged = average_faces(
        time,
        detections,
        echo,
        averaging=config.detection.averaging,
        speed_of_sound=config.assumed_sound_speed,
    )
    return _with_unsure_calls(without_labels(averaged.rows, callers)), echo


def _with_unsure_calls(scan: Scan) -> Scan:
    """Return a scan whose direct calls have bearings as unsure as they are (`DIRECT_FLOOR`)."""
    rows, numbers = scan.direct[scan.direct >= 0], scan.numbers.copy()
    numbers[BEARING_STD, rows] = np.hypot(numbers[BEARING_STD, rows], DIRECT_FLOOR)
    return replace(scan, numbers=numbers)
