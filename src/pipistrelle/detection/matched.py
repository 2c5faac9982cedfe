"""Matched filter: what a call would leave of each lag's samples, in units of the noise."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float

from pipistrelle.acoustics.call import Call
from pipistrelle.jit import Whole, kernel


class Workspace:
    """Arrays that every frame uses anew: fresh memory costs more than the arithmetic on it."""

    def __init__(self) -> None:
        self._flat: dict[str, np.ndarray] = {}

    def array(self, name: str, shape: tuple[int, ...]) -> Complex[np.ndarray, "..."]:
        """Return the array of a name in a shape; its content is undefined."""
        size = math.prod(shape)
        if name not in self._flat or self._flat[name].size < size:
            self._flat[name] = np.empty(size + size // 4, dtype=np.complex128)
        return self._flat[name][:size].reshape(shape)


def filter_blocks(
    blocks: Complex[np.ndarray, "b f c e"],
    *,
    pulse: int,
    block: int,
    noise_std: float,
    out: Complex[np.ndarray, "l f c e"] | None = None,
) -> Complex[np.ndarray, "l f c e"]:
    """Filter block sums by a boxcar as long as the call: the matched filter.

    `pulse`: blocks per call; `block`: samples per block; `noise_std`: of one complex sample; `out`:
    written and returned instead of a new array. Lag i is a call that starts with block i;
    noise has unit variance.
    """
    lags = max(blocks.shape[0] - pulse + 1, 0)
    matched = np.empty((lags, *blocks.shape[1:]), dtype=np.complex128) if out is None else out
    scale = 1.0 / (noise_std * math.sqrt(pulse * block))
    columns = 2 * math.prod(blocks.shape[1:])
    _boxcar(
        blocks.reshape(-1).view(np.float64).reshape(-1, columns),
        pulse,
        scale,
        matched.reshape(-1).view(np.float64).reshape(-1, columns),
    )
    return matched


def filter_samples(
    samples: Complex[np.ndarray, "t f e"],
    *,
    calls: Sequence[Call],
    rate: float,
    noise_std: float,
) -> Complex[np.ndarray, "l f c e"]:
    """Filter samples by each call, by fast convolution: the matched filter.

    Parameters
    ----------
    samples : (samples, faces, elements) complex
        Real ones, as a recording has them, are taken as such.
    calls : sequence of c Call
        Equally long.
    rate : [Hz]
    noise_std : float
        Of one complex sample.

    Returns
    -------
    (samples - length + 1, faces, calls, elements) complex
        With the length of a call in samples. Lag i is a call that starts with sample i; noise has
        unit variance. As precise as the samples.
    """
    from scipy.signal import oaconvolve

    time = np.arange(round(calls[0].duration * rate)) / rate
    sent = np.stack([call.waveform(time, call.frequency) for call in calls], axis=1)
    replica = sent[::-1].conj() / (noise_std * np.linalg.norm(sent, axis=0))
    return oaconvolve(
        samples[:, :, None, :],
        replica.astype(np.result_type(samples, np.complex64))[:, None, :, None],
        mode="valid",
        axes=0,
    )


@kernel
def _boxcar(
    rows: Float[np.ndarray, "b i"], width: Whole, scale: float, sums: Float[np.ndarray, "l i"]
) -> None:
    """Write the running sums of width rows, scaled."""
    columns = rows.shape[1]
    total = np.zeros(columns)
    for b in range(min(width - 1, rows.shape[0])):
        for i in range(columns):
            total[i] += scale * rows[b, i]
    for b in range(width - 1, rows.shape[0]):
        new, old, done = rows[b], rows[b - width + 1], sums[b - width + 1]
        for i in range(columns):
            done[i] = total[i] + scale * new[i]
            total[i] = done[i] - scale * old[i]
