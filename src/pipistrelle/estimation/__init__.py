"""Estimators: beliefs about pose and map from scans, with covariances.

`motion` and `measurement` are the models (Bradley & Abaid, Sec. II-E), `rays` the partially
initialised landmarks of passive sensing (Sec. III-C), `beliefs` the records and protocols of all
estimators, which `catalogue` lists: `ekf` (Sec. III-A), `fastslam` (Sec. III-B) and `smoother`.
`session` runs an estimator over control steps and scans, with `data_association`, input checks
(`checking`) and recovery from odometry failures (`recovery`).
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
