r"""Data association: which landmark each row of a scan is of, between prediction and correction.

An `Association` sees the predicted belief and a scan without labels, and answers with an
`Assignment`: a label for each row, and landmarks to remove or to merge. It has a memory, handed in
and out as beliefs are, for what is tentative. Rows of one label are merged, rows without a label
are left out (`pipistrelle.detection.scans.labelled`), and the filter is corrected with the rest.

What a row ought to be, were it of a landmark, and how surely, the belief's joint Gaussian tells
(`expected`): of several rows at once, since all share the error of the pose.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError
from pipistrelle.detection.scans import NO_CALLERS, Scan
from pipistrelle.estimation.beliefs import B, Belief, JointGaussian
from pipistrelle.estimation.measurement import excess_path_slopes, observe
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import kernel

KNOWN = "known"
"""The method that takes the labels that come with a scan (Bradley & Abaid, Sec. III-B)."""

M = TypeVar("M")


@dataclass(frozen=True, slots=True, kw_only=True)
class Assignment:
    """Labels of one scan's rows, and changes of the map."""

    label: Int[np.ndarray, " m"]
    """Label of each row: a landmark of the map, a new number for one that is not in it, or
    UNLABELLED for clutter."""
    remove: tuple[int, ...] = ()
    """Landmarks that are none, to remove from the map before the correction, where it holds them:
    their rows are taken back, as far as the session remembers."""
    merge: tuple[tuple[int, int], ...] = ()
    """Pairs of landmarks that are one: the first label stays, the second goes."""
    scan: Scan | None = None
    """The scan as the association states it, where it states more than came: the labels of callers,
    or how far away one is. With as many rows."""
    again: Any = None
    """News about earlier scans, or None: all scans that the session remembers are associated again
    with memories that have it (`informed`)."""
    earlier: Mapping[int, Scan] = field(default_factory=dict)
    """Earlier scans, by their numbers from 0, stated otherwise, or with labels for rows that had
    none: the session hears again those that it remembers, and all since, before it corrects by
    this one."""


class Association(Protocol[M]):
    """A stage that decides which landmark each row of a scan is of; a frozen record of settings.

    Three methods are optional. ``informed(memory, news)`` returns an earlier memory with what has
    become known (`Assignment.again`). ``knowing(memory, known, callers)`` returns a first memory
    with the landmarks and callers that are on the map beforehand. ``tentative(memory)`` returns the
    labels of landmarks that may be none, and are left out of the map.
    """

    def start(self) -> M:
        """Return the memory before the first scan."""
        ...

    def associate(self, memory: M, belief: Belief, scan: Scan) -> tuple[M, Assignment]:
        """Return the memory after a scan, and what is decided; change nothing that is given."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """Rows of a scan held against landmarks of the map, n pairs of a row and a landmark.

    Each pair has three numbers: bearing [rad], range [m], excess path [m]; NaN where the row does
    not have one, or its caller is not on the map.
    """

    difference: Float[np.ndarray, "n 3"]
    """Measured minus expected."""
    covariance: Float[np.ndarray, "n 3 n 3"]
    """Joint covariance of all differences: of pose and map, and, in the diagonal, of the rows."""


def expected(
    joint: JointGaussian,
    scan: Scan,
    row: Int[np.ndarray, " n"],
    landmark: Int[np.ndarray, " n"],
    callers: Int[np.ndarray, " c"] = NO_CALLERS,
) -> Candidates:
    r"""Compare rows of a scan with what is expected of landmarks of the map.

    .. math:: \nu_i = z_i - h_i(\hat x), \qquad S_{ij} = H_i P H_j^T + \delta_{ij} R_i

    Parameters
    ----------
    joint : JointGaussian
        ``belief.joint()``.
    scan : Scan
        With standard deviations.
    row, landmark : (n)
        Pairs of a row of the scan and the label of a landmark of ``joint``.
    callers : (c)
        Label of each caller as a landmark, by its number, for excess paths.

    Returns
    -------
    Candidates

    Raises
    ------
    InputError
        For a landmark that ``joint`` does not hold.

    Notes
    -----
    The innovations that joint compatibility tests: Neira & Tardos, IEEE Transactions on Robotics
    and Automation 17 (2001).

    Examples
    --------
    Two landmarks ahead of a vehicle whose heading alone is uncertain are off by the same angle.

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
    """Return a mask of labels that are among some others: of few, sooner than `np.isin`."""
    among = np.zeros(label.size, np.bool_)
    for m in range(label.size):
        for other in labels:
            among[m] |= label[m] == other
    return among


@kernel
def how_many_among(label: Int[np.ndarray, " m"], labels: Int[np.ndarray, " n"]) -> int:
    """Return how many labels are among some others."""
    return int(np.count_nonzero(is_among(label, labels)))


def edited(belief: B, remove: Sequence[int] = (), merge: Sequence[tuple[int, int]] = ()) -> B:
    """Return a belief without some landmarks, and with the two of each pair as one.

    It raises InputError for a belief that has no ``edited``.
    """
    if not (remove or merge):
        return belief
    if not hasattr(belief, "edited"):
        raise InputError(
            f"association: found landmarks to remove or to merge, but a {type(belief).__name__} "
            "cannot; expected a belief with edited(remove, merge) and labels(), as the EKFs' have"
        )
    return belief.edited(remove, merge)
