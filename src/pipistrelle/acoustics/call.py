r"""Calls: what a caller sends.

A `Call` is all that recorder and matched filter know of a waveform. The engine ``block`` has closed
forms for a `ToneBurst` alone; ``dense`` takes any. A motion at the speed v scales a call in time,
:math:`s(a (t - \tau))` with a the ratio of the received frequency to the sent one.

A `Sweep` passes through a band. By the linear law its frequency is linear in time, by the
hyperbolic law its period is,

.. math:: f(t) = f_0 + (f_1 - f_0) \frac{t}{T}, \qquad
          \frac{1}{f(t)} = \frac{1}{f_0} + \left(\frac{1}{f_1} - \frac{1}{f_0}\right) \frac{t}{T} ,

and a call of the second law that is scaled in time is the same call at another time, but for its
ends: no motion makes its echo fainter. Both laws take a Doppler shift for a delay,

.. math:: \delta = -(a - 1) \frac{f_1 T}{f_1 - f_0} ,

to first order (`coupling`).

Sources: Klauder et al., Bell System Technical Journal 39 (1960), for the linear law; Kroszczynski,
Proceedings of the IEEE 57 (1969), and Altes & Titlebaum, Journal of the Acoustical Society of
America 48 (1970), for the hyperbolic one.
"""

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from jaxtyping import Complex, Float


class Call(Protocol):
    """One call of one caller, of constant envelope or not."""

    @property
    def frequency(self) -> float:
        """Centre of the band [Hz]."""
        ...

    @property
    def duration(self) -> float:
        """Length [s]."""
        ...

    def waveform(
        self, time: Float[np.ndarray, "*n"], frequency: float
    ) -> Complex[np.ndarray, "*n"]:
        """Return the analytic signal, of unit amplitude, at times since its start [s].

        `frequency`: the centre as it is received, Doppler shift included [Hz].
        """
        ...


@dataclass(frozen=True, slots=True)
class ToneBurst:
    """A tone switched on and off (Bradley & Abaid, Sec. II-A): the answer is a triangle."""

    frequency: float
    """[Hz]."""
    duration: float
    """[s]."""

    def waveform(
        self, time: Float[np.ndarray, "*n"], frequency: float
    ) -> Complex[np.ndarray, "*n"]:
        """Return the tone as it is received.

        >>> ToneBurst(35e3, 2.8e-3).waveform(np.array([0.0, 1e-5]), 50e3).round(9)
        array([ 1.+0.j, -1.+0.j])
        """
        return np.exp(2j * np.pi * frequency * time)


@dataclass(frozen=True, slots=True)
class Sweep:
    """A tone that passes through a band, by a law of its frequency or period."""

    start: float
    end: float
    """`start` and `end`: frequency at which it begins and ends; alike, it is a tone [Hz]."""
    duration: float
    """[s]."""
    law: Literal["linear", "hyperbolic"] = "linear"
    """Whether the frequency or the period is linear in time."""
    taper: float = 0.0
    """Share of the call in which it rises and falls as a cosine does (Tukey's window): 0 switches
    it on and off, 1 is Hann's window."""

    @property
    def frequency(self) -> float:
        """Centre of the band [Hz]."""
        return 0.5 * (self.start + self.end)

    def waveform(
        self, time: Float[np.ndarray, "*n"], frequency: float
    ) -> Complex[np.ndarray, "*n"]:
        """Return the sweep as it is received; silence before and after.

        >>> slow = Sweep(60e3, 35e3, 2.8e-3, taper=1.0)
        >>> abs(slow.waveform(np.array([0.0, 1.4e-3, 2.8e-3]), 47.5e3)).round(9)
        array([0., 1., 0.])
        """
        own = np.asarray(time) * (frequency / self.frequency)
        share = own / self.duration
        if self.law == "linear" or self.start == self.end:
            turns = own * (self.start + 0.5 * (self.end - self.start) * share)
        else:
            bend = (1.0 / self.end - 1.0 / self.start) / self.duration
            turns = np.log1p(bend * self.start * np.clip(own, 0.0, self.duration)) / bend
        return tapered(share, self.taper) * np.exp(2j * np.pi * turns)


def tapered(share: Float[np.ndarray, "*n"], taper: float) -> Float[np.ndarray, "*n"]:
    """Return Tukey's window at shares of the call; 0 outside it.

    >>> tapered(np.array([0.0, 0.1, 0.5, 1.1]), 0.4).round(3)
    array([0. , 0.5, 1. , 0. ])
    """
    edge = np.minimum(share, 1.0 - share)
    inside = edge >= 0.0
    if taper == 0.0:
        return inside.astype(np.float64)
    rise = np.clip(2.0 * edge / taper, 0.0, 1.0)
    return np.where(inside, 0.5 - 0.5 * np.cos(np.pi * rise), 0.0)


def coupling(call: Call) -> float:
    r"""Return by how much a call's echo seems later for a Doppler shift [s].

    By the call's matched filter, per unit of a - 1, where a is the ratio of received to sent
    frequency. What is not known is 0: tones and files have none to first order, or none stated.

    >>> round(1e3 * coupling(Sweep(60e3, 35e3, 2.8e-3)), 2), coupling(ToneBurst(35e3, 2.8e-3))
    (3.92, 0.0)
    """
    if not isinstance(call, Sweep) or call.start == call.end:
        return 0.0
    return -call.end * call.duration / (call.end - call.start)
