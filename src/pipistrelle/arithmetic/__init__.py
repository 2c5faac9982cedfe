"""Arithmetic that must give the same bits everywhere: elementary functions, counted noise.

`elementary`: vectorisable logarithms, angles and roots, equal in every lane; `random_stream`:
complex normal noise, each sample computed from its number.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__, submod_attrs={"random_stream": ["complex_noise", "stream_key"]}
)
