"""Real samples -> outputs of matched filters, where somebody sends no plain tone."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float, Int

from pipistrelle.acoustics.call import Call, ToneBurst
from pipistrelle.config import BLOCK
from pipistrelle.detection.matched import BandFilters
from pipistrelle.detection.sounds.tone_sums import Blocks


class CallOutputs:
    """Filters samples of the channels of an array, each scaled by its own noise.

    `ToneSums` is the same of tones alone, but for the boxcar. A block is a lag here.
    """

    gaps = 64
    """Most gaps between calls in which noise is listened to."""

    def __init__(
        self, calls: Sequence[Call], rate: float, blank: int, channel: Int[np.ndarray, "f e"]
    ) -> None:
        self._filters = BandFilters(calls, rate)
        tones = np.array([call.frequency for call in calls])
        self.blocks = Blocks(rate, self._filters.step, self._filters.pulse, blank, tones)
        self.channel = channel
        tone = any(isinstance(call, ToneBurst) for call in calls)
        alike = self.blocks.pulse if tone else round(BLOCK / self.blocks.interval)
        self.apart = max(alike, 1)
        """Outputs from one that tells of the noise to the next, which is to know nothing of it."""
        self.gain = np.ones((len(channel), len(calls), channel.shape[1]))
        """What an output is multiplied by."""
        self.mean = np.zeros(int(channel.max()) + 1)
        """Of the samples of each channel; taken away."""

    def __call__(
        self, samples: Float[np.ndarray, "t m"], *, around: bool = False
    ) -> Complex[np.ndarray, "l f c e"]:
        """Return the outputs after the call with which the samples begin.

        `around`: also those at lags where a call is only partly heard (`BandFilters.around`).
        """
        heard = samples[self.blocks.blank :]
        if len(heard) < self._filters.length:
            return np.empty((0, *self.gain.shape), dtype=np.complex64)
        heard = heard - self.mean.astype(heard.dtype)[: heard.shape[1]]
        filtered = self._filters.around if around else self._filters
        outputs = filtered(heard[:, self.channel])
        outputs *= self.gain.astype(np.float32)
        return outputs
