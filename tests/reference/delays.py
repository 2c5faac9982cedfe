r"""Lower bounds on the error of a delay, for a rectangular call in block sums.

A call of M blocks that starts the share q into a block has the weights :math:`w(q) = (1 - q, 1,
\dots, 1, q)` in blocks with independent noise. Powers p are of the whole call after the matched
filter and the beam, relative to the noise: the number of elements times the SNR of each. Delays are
in blocks.
"""

import numpy as np

FAR = 4
"""Blocks on either side of the truth in the search range."""
STEPS = 50
"""Delays per block in the search range."""


def cramer_rao(power, pulse, share=None):
    r"""Cramer-Rao bound of the delay's variance, for unknown amplitude and phase.

    .. math:: \frac{M}{4 p} \left(1 - \frac{(2 q - 1)^2}{2 |w(q)|^2}\right)^{-1}, \qquad
              |w(q)|^2 = M - 2 q + 2 q^2

    The mean over all shares q, unless a share is given. Kay, Fundamentals of Statistical Signal
    Processing: Estimation Theory (1993), Sec. 3.9 and 15.7. It holds within a block: at the edges
    the slope of w jumps to another block, and larger errors have passed an edge.
    """
    q = np.linspace(0.0, 1.0, 1001) if share is None else np.asarray(share)
    known = 1.0 - (2.0 * q - 1.0) ** 2 / (2.0 * (pulse - 2.0 * q + 2.0 * q**2))
    return np.mean(0.25 * pulse / power / known)


def call(delay, pulse):
    """Shares of the call in the blocks from FAR before it on, a row per delay in blocks."""
    block, start = np.arange(2 * FAR + pulse + 1), FAR + np.asarray(delay)[:, None]
    return np.clip(np.minimum(block + 1, start + pulse) - np.maximum(block, start), 0.0, 1.0)


def least_mean_square(power, pulse, draws=2000, seed=0):
    r"""Lower bound of the mean square error of any estimator, averaged over all q.

    .. math:: \mathrm{E} \operatorname{Var}(\tau \mid x)

    The posterior variance of the delay with a uniform prior and known amplitude, phase and bearing,
    averaged over random draws. Van Trees, Detection, Estimation, and Modulation Theory I (1968),
    Sec. 2.4.
    """
    rng, amplitude = np.random.default_rng(seed), np.sqrt(power) / pulse
    asked = np.linspace(-FAR, FAR, 2 * FAR * STEPS + 1)
    shapes, total = call(asked, pulse), 0.0
    square = (shapes**2).sum(axis=1)
    for some in np.array_split(rng.uniform(-0.5, 0.5, draws), max(draws // 500, 1)):
        heard = amplitude * call(some, pulse)
        heard += rng.normal(0.0, np.sqrt(0.5 / pulse), heard.shape)  # part in phase with the call
        likely = pulse * amplitude * (2.0 * heard @ shapes.T - amplitude * square)
        weight = np.exp(likely - likely.max(axis=1, keepdims=True))
        weight /= weight.sum(axis=1, keepdims=True)
        total += (weight @ asked**2 - (weight @ asked) ** 2).sum()
    return total / draws
