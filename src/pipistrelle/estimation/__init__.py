"""Scans to beliefs: where the vehicle is, where the landmarks are, and how surely.

`motion` moves the vehicle and `measurement` measures from it (Bradley & Abaid, Sec. II-E);
`beliefs` are the records that every filter speaks. `ekf` keeps one Gaussian over pose and map
(Sec. III-A), `fastslam` particles, sampled paths with a map each (Sec. III-B); both place a
landmark of which only the bearing is known as one of `rays` (Sec. III-C).
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "beliefs": ["Gaussian", "Landmarks", "Track"],
        "ekf.filter": ["EkfSlam"],
        "fastslam.filter": ["FastSlam"],
        "motion": ["Motion", "motion_step"],
        "rays": ["ray_members"],
    },
)
