"""Where the ears are and what they hear.

`layout` puts the microphones on the faces of a square and `receiver` lets them hear (Bradley &
Abaid, Sec. II-C): arrivals become a recording, sample by sample or, with the same statistics, as
sums over 0.2 ms blocks (`sampling` settles how). `beamforming` says what such an array can tell of
a direction: its scan, its beampattern and the smallest error of a bearing.
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
