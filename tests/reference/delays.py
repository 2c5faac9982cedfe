r"""The least error of a delay: of a rectangular call that is heard in sums over blocks.

A call of M blocks that starts the share q into a block weighs the blocks :math:`w(q) = (1 - q, 1,
\dots, 1, q)`; each has noise of its own. Powers p are those of the whole call after the matched
filter and the beam, in units of the noise: the elements' number times the SNR of one. Delays are in
blocks.
"""

import numpy as np

FAR = 4
"""Blocks to either side of the truth that are asked."""
STEPS = 50
"""Delays that are asked of a block."""


def cramer_rao(power, pulse, share=None):
    r"""The Cramer-Rao bound of the variance, where nobody knows amplitude and phase.

    .. math:: \frac{M}{4 p} \left(1 - \frac{(2 q - 1)^2}{2 |w(q)|^2}\right)^{-1}, \qquad
              |w(q)|^2 = M - 2 q + 2 q^2

    Its mean over all shares q, unless one is given. Kay, Fundamentals of Statistical Signal
    Processing: Estimation Theory (1993), Sec. 3.9 and 15.7. It holds within a block: at a block's
    edge the slope of w jumps from one block to another, and who is off by more than a share of one
    has passed an edge.
    """
    q = np.linspace(0.0, 1.0, 1001) if share is None else np.asarray(share)
    known = 1.0 - (2.0 * q - 1.0) ** 2 / (2.0 * (pulse - 2.0 * q + 2.0 * q**2))
    return np.mean(0.25 * pulse / power / known)


def call(delay, pulse):
    """Shares of the call in the blocks from FAR before it on, a row per delay in blocks."""
    block, start = np.arange(2 * FAR + pulse + 1), FAR + np.asarray(delay)[:, None]
    return np.clip(np.minimum(block + 1, start + pulse) - np.maximum(block, start), 0.0, 1.0)


def least_mean_square(power, pulse, draws=2000, seed=0):
    r"""The mean square error that no estimator is below in the mean over all q.

    .. math:: \mathrm{E} \operatorname{Var}(\tau \mid x)

    the variance that is left when all is known but the delay itself, of which any is as likely as
    another: amplitude, phase and bearing are given away. Van Trees, Detection, Estimation, and
    Modulation Theory I (1968), Sec. 2.4. By draws, of which it is the mean.
    """
    rng, amplitude = np.random.default_rng(seed), np.sqrt(power) / pulse
    asked = np.linspace(-FAR, FAR, 2 * FAR * STEPS + 1)
    shapes, total = call(asked, pulse), 0.0
    square = (shapes**2).sum(axis=1)
    for some in np.array_split(rng.uniform(-0.5, 0.5, draws), max(draws // 500, 1)):
        heard = amplitude * call(some, pulse)
        heard += rng.normal(0.0, np.sqrt(0.5 / pulse), heard.shape)  # what is in phase with it
        likely = pulse * amplitude * (2.0 * heard @ shapes.T - amplitude * square)
        weight = np.exp(likely - likely.max(axis=1, keepdims=True))
        weight /= weight.sum(axis=1, keepdims=True)
        total += (weight @ asked**2 - (weight @ asked) ** 2).sum()
    return total / draws
