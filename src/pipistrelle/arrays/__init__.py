"""Where the ears are and what they hear.

`layout` puts the microphones on the faces of a square and `receiver` lets them hear (Bradley &
Abaid, Sec. II-C): arrivals become a recording, sample by sample or, with the same statistics, as
sums over 0.2 ms blocks, in the noise of `noise`, any sample of which is known by its number alone.
`beamforming` says what such an array can tell of a direction: its scan, its beampattern and the
smallest error of a bearing.
"""

from importlib import import_module

_DOOR = {
    "add_echo_blocks": "receiver",
    "beampattern": "beamforming",
    "beamscan": "beamforming",
    "bearing_bound": "beamforming",
    "noise_blocks": "receiver",
    "record_samples": "receiver",
    "sampling": "receiver",
    "square_of_four": "layout",
}


def __dir__() -> list[str]:
    return sorted([*globals(), *_DOOR])


def __getattr__(name: str) -> object:
    if name not in _DOOR:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_DOOR[name]}"), name)
