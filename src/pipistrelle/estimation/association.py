"""Protocol of data association: label the measurements of a scan between prediction and update.

An `Association` receives the predicted belief and a scan without labels, and returns an
`Assignment` with labels, and landmarks to remove or merge. Its memory of tentative landmarks is
passed in and out like a belief. Measurements of the same label are merged, and unlabelled
measurements are discarded (`pipistrelle.detection.scans.labelled`) before the update. `expected`
predicts measurements from the joint Gaussian of the belief, as they share the error of the pose.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError
from pipistrelle.detection.scans import NO_CALLERS, Scan
from pipistrelle.estimation.beliefs import Belief, JointGaussian, Landmarks
from pipistrelle.estimation.measurement import excess_path_slopes, observe
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import kernel

KNOWN = "known"
"""Method that uses the labels of the scan (Bradley & Abaid, Sec. III-B)."""

M = TypeVar("M")


@dataclass(frozen=True, slots=True, kw_only=True)
class Assignment:
    """Result of data association: a label for each measurement of a scan, and map changes."""

    label: Int[np.ndarray, " m"]
    """Label of each measurement: a mapped landmark, a new number, or UNLABELLED for clutter."""
    remove: tuple[int, ...] = ()
    """Landmarks to remove from the map before the update; the session repeats the scans in its
    memory without their measurements."""
    merge: tuple[tuple[int, int], ...] = ()
    """Pairs of duplicate landmarks: the first label replaces the second."""
    scan: Scan | None = None
    """The scan with changes by the association, such as callers' labels or a caller's range; the
    same measurements in the same order."""
    revised: Mapping[int, Scan | None] = field(default_factory=dict)
    """Earlier scans, by number from 0: with changes, or labels for measurements without; the
    session repeats them, and all later scans, before the update. None makes it associate the scan
    and all later ones again, from the memory before it as changed by ``carried``, and ignore the
    rest of the assignment."""


class Association(ABC, Generic[M]):
    """A method of data association, which assigns each measurement of a scan to a landmark.

    A class need not inherit from it (`beliefs.completed`).
    """

    __slots__ = ()

    @abstractmethod
    def start(self) -> M:
        """Return the memory of data association, its state between scans, before the first scan."""

    @abstractmethod
    def associate(self, memory: M, belief: Belief, scan: Scan) -> tuple[M, Assignment]:
        """Return the new memory and a scan's assignment to landmarks; change no argument."""

    def carried(self, memory: M, later: M) -> M:
        """Return an earlier memory with the facts that a later one adds, as callers' positions."""
        raise InputError(
            f"association: found scans to be associated again, but a {type(self).__name__} has no "
            "carried(memory, later)"
        )

    def knowing(self, memory: M, known: Landmarks, callers: Int[np.ndarray, " c"]) -> M:
        """Return the initial memory, given the landmarks and callers of a known initial map."""
        return memory

    def tentative(self, memory: M) -> Sequence[int]:
        """Return the labels of uncertain landmarks, to be left out of the reported map."""
        return ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """Comparison of n pairs of a measurement and a landmark: differences and their covariance.

    Each pair has three numbers: bearing [rad], range [m], excess path [m]; NaN if not measured, or
    if the caller is not on the map.
    """

    difference: Float[np.ndarray, "n 3"]
    """Measured minus expected values."""
    covariance: Float[np.ndarray, "n 3 n 3"]
    """Joint covariance of all differences: from pose and map, plus the measurement noise in the
    diagonal."""


def expected(
    joint: JointGaussian,
    scan: Scan,
    row: Int[np.ndarray, " n"],
    landmark: Int[np.ndarray, " n"],
    callers: Int[np.ndarray, " c"] = NO_CALLERS,
) -> Candidates:
    r"""Compare measurements of a scan with predictions for landmarks of the map.

    .. math:: \nu_i = z_i - h_i(\hat x), \qquad S_{ij} = H_i P H_j^T + \delta_{ij} R_i

    These are the innovations of joint compatibility tests: Neira & Tardos, IEEE Transactions on
    Robotics and Automation 17 (2001).

    Parameters
    ----------
    joint : JointGaussian
        Result of ``belief.joint()``.
    scan : Scan
        A scan with standard deviations.
    row, landmark : (n)
        Pairs of a measurement's index in the scan and the label of a landmark of ``joint``.
    callers : (c)
        Label of each caller as a landmark, by its number, for excess paths.

    Raises
    ------
    InputError
        If ``joint`` lacks a landmark.

    Examples
    --------
    An uncertain heading correlates the differences of two landmarks.

    >>> from pipistrelle.detection.scans import make_scan
    >>> joint = JointGaussian(
    ...     landmark=np.array([3, 8]), mean=np.array([0.0, 0.0, 0.0, 2.0, 0.0, 4.0, 0.0]),
    ...     covariance=np.diag([0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0]))
    >>> scan = make_scan(0.0, np.array([-1, -1]), np.array([0.1, 0.2]), bearing_std=0.1)
    >>> pairs = expected(joint, scan, np.array([0, 1]), np.array([3, 8]))
    >>> pairs.difference[:, 0], pairs.covariance[:, 0, :, 0].round(6)
    (array([0.1, 0.2]), array([[0.02, 0.01],
           [0.01, 0.02]]))
    """
    place = {label: 3 + 2 * number for number, label in enumerate(joint.landmark.tolist())}
    if missing := sorted(set(np.asarray(landmark).tolist()) - place.keys()):
        raise InputError(f"expected: found the landmarks {missing}, which the belief does not hold")
    size, x, y, heading = len(row), *joint.mean[:3]
    difference, H = np.full((size, 3), np.nan), np.zeros((size, 3, joint.mean.size))
    for n, (m, label) in enumerate(zip(row, landmark, strict=True)):
        i = place[int(label)]
        distance, bearing, c, s, k = observe(x, y, heading, *joint.mean[i : i + 2])
        difference[n, 0] = wrap_angle(scan.bearing[m] - bearing)
        difference[n, 1] = scan.range[m] - distance
        H[n, 0, [0, 1, 2, i, i + 1]] = s * k, -c * k, -1.0, -s * k, c * k
        H[n, 1, [0, 1, i, i + 1]] = -c, -s, c, s
        number = scan.caller[m]
        j = place.get(int(callers[number]), i) if number < callers.size else i
        if j != i:
            path, *slopes = excess_path_slopes(x, y, *joint.mean[i : i + 2], *joint.mean[j : j + 2])
            difference[n, 2] = scan.excess_path[m] - path
            H[n, 2, [i, i + 1, j, j + 1]] = slopes
            H[n, 2, :2] = -slopes[0] - slopes[2], -slopes[1] - slopes[3]
    rows = H.reshape(3 * size, joint.mean.size)
    HP = np.einsum("id,de->ie", rows, joint.covariance, optimize=False)
    S = np.einsum("ie,je->ij", HP, rows, optimize=False)
    stds = np.stack([scan.bearing_std, scan.range_std, scan.excess_path_std], axis=-1)[row].ravel()
    S = (S + np.diag(stds * stds)).reshape(size, 3, size, 3)
    unknown = np.isnan(difference)
    S[unknown], S[:, :, unknown] = np.nan, np.nan
    return Candidates(difference=difference, covariance=S)


@kernel
def is_among(label: Int[np.ndarray, " m"], labels: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " m"]:
    """Return a mask of the labels that are in a set; faster than `np.isin` for few labels."""
    among = np.zeros(label.size, np.bool_)
    for m in range(label.size):
        for other in labels:
            among[m] |= label[m] == other
    return among
