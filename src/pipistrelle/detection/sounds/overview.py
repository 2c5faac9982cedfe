"""What was heard of some calls, for a figure: the matched filter's output and the echoes."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from pipistrelle.detection.loudness import energy_of
from pipistrelle.detection.scans import OWN, Scan
from pipistrelle.detection.snapshots import Detections
from pipistrelle.detection.sounds.hearing import Frame

CALLS = 60
"""Most calls that are kept."""
BINS = 400
"""Most delays at which the output is kept, the loudest of each."""


@dataclass(kw_only=True)
class Overview:
    """The first calls that were heard."""

    names: tuple[str, ...]
    """Who calls, the vehicle first."""
    time: list[float] = field(default_factory=list)
    """Of the calls [s]."""
    delay: list[Float[np.ndarray, " n"]] = field(default_factory=list)
    """Since the vehicle's call, of each bin [s]."""
    level_db: list[Float[np.ndarray, "n c"]] = field(default_factory=list)
    """Of the loudest face over the noise of its elements, in each bin [dB]."""
    detections: list[Detections] = field(default_factory=list)
    scans: list[Scan] = field(default_factory=list)

    def look(self, frame: Frame) -> None:
        """Keep what was heard after a call, if it is one of the first."""
        if len(self.time) == CALLS:
            return
        lags, faces, tones, elements = frame.matched.shape
        energy = (
            energy_of(frame.matched.reshape(-1).view(frame.matched.real.dtype), elements) / elements
        )
        loudest = energy.reshape(lags, faces, tones).max(axis=1, initial=0.0)
        edges = np.unique(np.linspace(0, lags, BINS + 1).astype(np.int64))[:-1]
        if edges.size:
            loudest = np.maximum.reduceat(loudest, edges, axis=0)
        self.time.append(frame.time)
        self.delay.append(frame.start + edges * frame.interval)
        self.level_db.append(10.0 * np.log10(np.maximum(loudest, 1e-3)))
        self.detections.append(frame.detections)
        self.scans.append(frame.scan)

    def direct(self, number: int) -> Float[np.ndarray, " k"]:
        """Return when a caller's direct call began after each call of the vehicle, or NaN [s]."""
        if number == OWN:
            return np.full(len(self.time), np.nan)
        calls = (found.direct for found in self.detections)
        return np.array([np.nan if one is None else one.delay[number] for one in calls])
