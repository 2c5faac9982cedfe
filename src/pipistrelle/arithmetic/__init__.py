"""Arithmetic that must give the same bits everywhere: elementary functions, counted noise.

`elementary` has the logarithms, angles and roots that a processor takes many at a time, alike in
every lane; `random_stream` the complex normals of which any sample is known by its number alone.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "random_stream": ["complex_noise", "stream_key"],
    },
)
