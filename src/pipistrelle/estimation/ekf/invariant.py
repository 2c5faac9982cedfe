"""Right-invariant EKF-SLAM: EKF-SLAM that keeps another error (`ekf.invariant_error`)."""

from dataclasses import dataclass

from pipistrelle.estimation.ekf.filter import EkfSlam
from pipistrelle.estimation.ekf.gaussian import INVARIANT


@dataclass(frozen=True, slots=True, kw_only=True)
class InvariantEkfSlam(EkfSlam):
    """EKF-SLAM with the right-invariant error; its fields and methods are those of `EkfSlam`.

    Examples
    --------
    A vehicle that stands, unsure of its heading, learns nothing of it from what it hears.

    >>> import numpy as np
    >>> from pipistrelle.config import RayConfig
    >>> from pipistrelle.detection.scans import make_scan
    >>> from pipistrelle.estimation.beliefs import Gaussian
    >>> from pipistrelle.estimation.motion import Motion
    >>> motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
    >>> slam = InvariantEkfSlam(motion=motion, rays=RayConfig())
    >>> belief = slam.init(Gaussian(mean=np.zeros(3), covariance=np.eye(3) * 1e-2))
    >>> known = {"range": np.array([2.0, 9.0]), "range_std": 0.2, "bearing_std": 0.15}
    >>> scan = make_scan(0.0, np.array([4, 9]), np.array([0.1, 0.7]), **known)
    >>> for _ in range(100):
    ...     belief = slam.update(belief, scan)
    >>> belief.pose().covariance[2, 2]
    np.float64(0.01)
    """

    error: float = INVARIANT
