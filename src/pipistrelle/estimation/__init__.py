"""Scans to beliefs: where the vehicle is, where the landmarks are, and how surely.

`models` moves the vehicle and measures from it, and holds the records that every filter speaks
(Bradley & Abaid, Sec. II-E). `ekf` keeps one Gaussian over pose and map (Sec. III-A), `fastslam` a
swarm of sampled paths with a map each (Sec. III-B); both place a landmark of which only the bearing
is known as one of `rays` (Sec. III-C). The other modules are their kernels.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "ekf": ["EkfSlam"],
        "fastslam": ["FastSlam"],
        "models": ["Gaussian", "Landmarks", "Motion", "Track", "motion_step"],
        "rays": ["ray_members"],
    },
)
