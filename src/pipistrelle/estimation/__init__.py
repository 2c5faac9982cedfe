"""Scans to beliefs: where the vehicle is, where the landmarks are, and how surely.

`models` moves the vehicle and measures from it, and holds the records that every filter speaks
(Bradley & Abaid, Sec. II-E). `ekf` keeps one Gaussian over pose and map (Sec. III-A), `fastslam` a
swarm of sampled paths with a map each (Sec. III-B); both place a landmark of which only the bearing
is known as one of `rays` (Sec. III-C). The other modules are their kernels.
"""

from importlib import import_module

_DOOR = {
    "EkfSlam": "ekf",
    "FastSlam": "fastslam",
    "Gaussian": "models",
    "Landmarks": "models",
    "Motion": "models",
    "Track": "models",
    "motion_step": "models",
    "ray_members": "rays",
}


def __dir__() -> list[str]:
    return sorted([*globals(), *_DOOR])


def __getattr__(name: str) -> object:
    if name not in _DOOR:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_DOOR[name]}"), name)
