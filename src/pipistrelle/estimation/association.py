"""Data association: which landmark each row of a scan is of, between prediction and correction.

An association is a function of the predicted belief and of a scan, and returns a label for each
row: that of a landmark in the map, a new number for one that is not, or UNLABELLED for clutter.
Rows of one label are merged, rows without a label are dropped
(`pipistrelle.detection.merging.labelled`), and the filter is corrected with the rest.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Int

from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Belief

Associate = Callable[[Belief, Scan], Int[np.ndarray, " m"]]
"""Takes the predicted belief and a scan of m rows; returns m labels. It must not change either."""


def known_labels(belief: Belief, scan: Scan) -> Int[np.ndarray, " m"]:
    """Return the labels that came with the scan: known association.

    Parameters
    ----------
    belief : Belief
        Not used.
    scan : Scan

    Returns
    -------
    (m)

    Notes
    -----
    Bradley & Abaid, Sec. III-B ("we assumed known data association").
    """
    return scan.landmark
