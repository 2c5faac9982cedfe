r"""Calls: what a caller sends, and how near two echoes may be and still be two.

A `Call` is all that recorder and matched filter know of a waveform. The engine ``block`` has closed
forms for a `ToneBurst` alone; ``dense`` takes any.
"""

from dataclasses import dataclass
from typing import Protocol

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

    @property
    def resolution(self) -> float:
        """Half the width of the matched filter's answer: what arrives nearer is one echo [s]."""
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

    @property
    def resolution(self) -> float:
        """The whole call: a triangle has no narrower peak [s]."""
        return self.duration

    def waveform(
        self, time: Float[np.ndarray, "*n"], frequency: float
    ) -> Complex[np.ndarray, "*n"]:
        """Return the tone as it is received.

        >>> ToneBurst(35e3, 2.8e-3).waveform(np.array([0.0, 1e-5]), 50e3).round(9)
        array([ 1.+0.j, -1.+0.j])
        """
        return np.exp(2j * np.pi * frequency * time)
