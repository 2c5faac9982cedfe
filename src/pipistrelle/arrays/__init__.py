"""Microphone arrays: geometry, sampling, recording of arrivals and beamforming.

`array_file` reads microphones, and `layout` groups them into faces and lines (Bradley & Abaid, Sec.
II-C). `receiver` makes a recording of arrivals, as sums over 0.2 ms blocks or in each call's band;
`sampling` chooses rate and blocks. `beamforming` computes scan, beam pattern and the bound of a
bearing.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "beamforming": ["beampattern", "beamscan", "bearing_bound"],
        "layout": ["square_of_four"],
        "receiver": ["add_echo_blocks", "noise_blocks", "record_samples"],
    },
)
