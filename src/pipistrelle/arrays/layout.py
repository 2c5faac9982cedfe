"""Where the microphones are: uniform line arrays on the faces of a square."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.config import ReceiverConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Equal, back-baffled line arrays around one phase centre, the vehicle's position.

    An element hears within 90 degrees of its face's normal. The faces' own offsets from the
    centre (some 25 mm) are left out: they would shift delays by less than 0.1 ms.
    """

    normal: Float[np.ndarray, " f"]
    """Direction of each face's normal, relative to the heading [rad]."""
    position: Float[np.ndarray, " e"]
    """Elements along a face, positive to the left of its normal, centred on 0 [m]."""


def square_of_four(receiver: ReceiverConfig) -> Layout:
    """Four faces, to the front, left, back and right.

    Parameters
    ----------
    receiver : ReceiverConfig
        Number of elements and their spacing [m].

    Returns
    -------
    Layout
        4 faces.

    Notes
    -----
    Bradley & Abaid, Sec. II-C.

    Examples
    --------
    >>> layout = square_of_four(ReceiverConfig())
    >>> np.degrees(layout.normal).tolist()
    [0.0, 90.0, -180.0, -90.0]
    >>> round(float(np.ptp(layout.position)), 4)
    0.0441
    """
    index = np.arange(receiver.elements)
    return Layout(
        normal=np.array([0.0, 0.5, -1.0, -0.5]) * np.pi,
        position=(index - 0.5 * (receiver.elements - 1)) * receiver.spacing,
    )
