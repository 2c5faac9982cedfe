"""Where the microphones are: line arrays on the faces of a vehicle."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.config import Config, ReceiverConfig


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

    def phases(
        self,
        angle: Float[np.ndarray, "*n"] | float,
        frequency: float,
        speed_of_sound: float,
    ) -> Float[np.ndarray, "*n e"]:
        r"""Return the phases at the elements of a plane wave from an angle off a face's normal.

        .. math:: \varphi_e(\theta) = 2\pi f \, y_e \sin\theta / c

        `angle` [rad]; `frequency` [Hz]; `speed_of_sound` [m/s]. Returns [rad].

        >>> pair = Layout(normal=np.zeros(1), position=np.array([0.0, 0.0049]))
        >>> pair.phases(np.pi / 2, 35e3, 343.0).round(9)
        array([0.        , 3.14159265])
        """
        lead = np.multiply.outer(np.sin(angle), self.position) / speed_of_sound
        return 2.0 * np.pi * frequency * lead


def layout_of(config: Config) -> Layout:
    """Return the arrays of the settings: the only place that chooses them."""
    return square_of_four(config.receiver)


def square_of_four(receiver: ReceiverConfig) -> Layout:
    """Return four faces, to the front, left, back and right.

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
