"""The paper's square and tones, and what they record of sounds that are placed by hand."""

import numpy as np

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.acoustics.paths import callers_of
from pipistrelle.arrays.layout import square_of_four
from pipistrelle.arrays.receiver import add_echo_blocks, noise_blocks
from pipistrelle.arrays.sampling import sampling
from pipistrelle.config import BLOCK, Config
from pipistrelle.detection.matched import filter_blocks
from pipistrelle.detection.snapshots import detect, detector

CONFIG = Config()
CALLERS = callers_of(CONFIG, np.zeros(2))
SETTLED, SQUARE = sampling(CONFIG, CALLERS), square_of_four(CONFIG.receiver)
FINDER = detector(CONFIG, SQUARE, SETTLED.tones)
C, PULSE = CONFIG.air.sound_speed, SETTLED.pulse
SAMPLES, START = PULSE * SETTLED.block, PULSE * BLOCK
LAGS = {"start": START, "interval": BLOCK, "pulse": PULSE}
OWN, BEACON = 0, 1
SAMPLED = BLOCK / SETTLED.block / np.sqrt(3.0)
"""Root mean square delay of a call [s] by sampling: it is heard from the next sample on."""


def sounds(delay, bearing, snr_db, caller=OWN, shift=1.0):
    """Return arrivals of given SNR [dB], at one microphone and after the matched filter."""
    columns = map(np.atleast_1d, (delay, bearing, snr_db, caller, shift))
    delay, bearing, snr_db, caller, shift = np.broadcast_arrays(*columns)
    return Arrivals(
        delay=delay.astype(float),
        level_db=snr_db - 10.0 * np.log10(SAMPLES),
        bearing=bearing.astype(float),
        frequency=SETTLED.tones[caller] * shift,
        caller=caller.astype(np.int8),
        landmark=np.arange(1, delay.size + 1),
    )


def filtered(sums, settled=SETTLED):
    """Return the matched filter's outputs of block sums."""
    return filter_blocks(sums, pulse=settled.pulse, block=settled.block, noise_std=1.0)


def matched_of(arrivals, layout=SQUARE, key=None, blocks=60):
    """Return the matched filter's outputs of arrivals, with noise if there is a key."""
    if key is None:
        sums = np.zeros((blocks, layout.shape[0], 2, layout.shape[1]), dtype=complex)
    else:
        sums = noise_blocks(blocks, layout, SETTLED, key)
    add_echo_blocks(sums, arrivals, layout, SETTLED)
    return filtered(sums)


def found_in(matched, finder=FINDER):
    """Return the detections in matched-filter outputs."""
    return detect(matched, finder, **LAGS)
