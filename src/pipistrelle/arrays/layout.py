"""Array geometry: line arrays on the faces of a vehicle, or microphones in any positions."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.arrays.array_file import Microphones, microphones_of, read_array
from pipistrelle.config import SQUARE, Config, InputError, ReceiverConfig
from pipistrelle.geometry import wrap

LINE_TOLERANCE = 1e-5
"""Largest deviation of a microphone from its position on a line [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Equal, back-baffled line arrays around one phase centre, the vehicle's position.

    An element receives within 90 degrees of its face's normal. The faces' offsets from the centre
    (some 25 mm) are neglected: they would shift delays by less than 0.1 ms.
    """

    normal: Float[np.ndarray, " f"]
    """Direction of each face's normal, relative to the heading [rad]."""
    position: Float[np.ndarray, " e"]
    """Elements along a face, positive to the left of its normal, centred on 0 [m]."""

    @property
    def shape(self) -> tuple[int, int]:
        """Number of faces, and elements of each."""
        return self.normal.size, self.position.size

    def members(self, g: int) -> tuple[int, Int[np.ndarray, " k"]]:
        """Return the row of a face in a recording, and the indices of its microphones there."""
        return g, np.arange(self.position.size)

    def places(self, g: int) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
        """Return positions of a face's microphones in the vehicle's frame [m], and their gains."""
        left = np.array([-np.sin(self.normal[g]), np.cos(self.normal[g])])
        return np.outer(self.position, left), np.ones(self.position.size)

    def phases(
        self,
        angle: Float[np.ndarray, "*n"] | float,
        frequency: float,
        speed_of_sound: float,
    ) -> Float[np.ndarray, "*n e"]:
        r"""Return the phases [rad] at the elements of a plane wave at an angle off a face's normal.

        .. math:: \varphi_e(\theta) = 2\pi f \, y_e \sin\theta / c

        `angle` [rad]; `frequency` [Hz]; `speed_of_sound` [m/s].

        >>> pair = Layout(normal=np.zeros(1), position=np.array([0.0, 0.0049]))
        >>> pair.phases(np.pi / 2, 35e3, 343.0).round(9)
        array([0.        , 3.14159265])
        """
        lead = np.multiply.outer(np.sin(angle), self.position) / speed_of_sound
        return 2.0 * np.pi * frequency * lead


@dataclass(frozen=True, slots=True, kw_only=True)
class Scattered:
    """Microphones in any positions on the vehicle, in groups that are scanned together.

    A plane wave reaches a microphone at p earlier than the vehicle's centre by p . u / c, with u
    the unit vector to the source. Sound travels horizontally: heights are ignored.
    """

    position: Float[np.ndarray, "e 2"]
    """In the vehicle's frame, x ahead and y to the left [m]."""
    amplitude: Float[np.ndarray, " e"]
    """Gain of each microphone; the noise of all is the same."""
    group: Int[np.ndarray, " e"]
    """Number of each microphone's group."""
    normal: Float[np.ndarray, " f"]
    """Normal of each group [rad]: a line on a face receives within 90 degrees of it; NaN for a
    group that receives from all directions."""
    name: tuple[str, ...]
    """Name of the face of each group; empty for microphones without a face."""

    @property
    def shape(self) -> tuple[int, int]:
        """One row, and the number of microphones."""
        return 1, len(self.position)

    def members(self, g: int) -> tuple[int, Int[np.ndarray, " k"]]:
        """Return the row of a group in a recording, and the indices of its microphones there."""
        return 0, np.flatnonzero(self.group == g)

    def places(self, g: int) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
        """Return positions of a group's microphones in the vehicle's frame [m], and their gains."""
        _, members = self.members(g)
        return self.position[members], self.amplitude[members]

    def lead(self, bearing: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n e"]:
        """Return the microphones' positions along the direction to a bearing [rad], in metres.

        >>> pair = scattered(microphones_of([(0.1, 0, 0, 0, ""), (0, 0.2, 0, 0, "")]))
        >>> pair.lead(np.pi / 2).round(9)
        array([0. , 0.2])
        """
        toward = np.stack((np.cos(bearing), np.sin(bearing)), axis=-1)
        return toward @ self.position.T


def layout_of(config: Config) -> Layout | Scattered:
    """Return the array of the settings, as lines on a square or scattered microphones."""
    if config.receiver.array == SQUARE:
        return square_of_four(config.receiver)
    return scattered(microphones_in(config))


def microphones_in(config: Config) -> Microphones:
    """Return the microphones of the settings."""
    array = config.receiver.array
    if array == SQUARE:
        return square_microphones(config.receiver)
    return read_array(Path(array)) if isinstance(array, str) else microphones_of(array)


def scattered(microphones: Microphones, where: str = "receiver.array") -> Scattered:
    """Group the microphones of an array by face; microphones without a face form a group.

    A face whose microphones have equal gains and form an equally spaced line receives on one side,
    away from the middle of the array; for a line through the middle, the side with its last channel
    on the left. `where`: origin of the microphones, for errors.

    >>> front = [(0.03, -0.02, 0, 0, "front"), (0.03, 0.02, 0, 0, "front")]
    >>> stern = [(-0.05, 0.0, 0, 0, ""), (-0.05, 0.01, 0, 0, "")]
    >>> array = scattered(microphones_of([*front, *stern]))
    >>> array.name, abs(array.normal.round(9)), array.group
    (('', 'front'), array([nan,  0.]), array([1, 1, 0, 0]))
    """
    place, names = microphones.position[:, :2], tuple(sorted(set(microphones.face)))
    group = np.array([names.index(face) for face in microphones.face])
    for name, count in zip(names, np.bincount(group), strict=True):
        if count < 2:
            found = "on face " + name if name else "that hangs free"
            expected = "two or more, as one alone hears no direction; add one, or leave it out"
            raise InputError(f"{where}: found one microphone {found}, expected {expected}")
    middle, gain = place.mean(axis=0), microphones.gain_db
    normal = [
        _normal(place[group == g], middle) if name and np.ptp(gain[group == g]) == 0.0 else np.nan
        for g, name in enumerate(names)
    ]
    return Scattered(
        position=place,
        amplitude=10.0 ** (gain / 20.0),
        group=group,
        normal=np.array(normal),
        name=names,
    )


def at_one_centre(microphones: Microphones, where: str) -> tuple[Layout, Int[np.ndarray, "f e"]]:
    """Return faces of equal lines as if at the vehicle's position, and each element's microphone.

    Faces are sorted by their first channels; `where`: their origin, for errors.

    >>> layout, microphone = at_one_centre(square_microphones(ReceiverConfig(elements=2)), "")
    >>> layout.shape, microphone.tolist()
    ((4, 2), [[0, 1], [2, 3], [4, 5], [6, 7]])
    """
    array = scattered(microphones, where)
    if np.isnan(array.normal).any():
        odd = array.name[int(np.argmax(np.isnan(array.normal)))]
        found = f"{odd!r}, which is no evenly spaced line of them" if odd else "microphones alone"
        raise InputError(f"{where}: found {found}, expected lines on faces where one_centre is set")
    lines = sorted((along_line(array, g) for g in range(array.normal.size)), key=_first)
    positions = [line.position for _, line in lines]
    alike = len({place.size for place in positions}) == 1
    if not alike or np.ptp(positions, axis=0).max() > LINE_TOLERANCE:
        expected = "lines of one length and spacing where one_centre is set"
        raise InputError(f"{where}: found faces that are not alike, expected {expected}")
    normal = np.array([line.normal[0] for _, line in lines])
    members = np.array([numbers for numbers, _ in lines])
    return Layout(normal=normal, position=np.mean(positions, axis=0)), members


def _first(line: tuple[Int[np.ndarray, " k"], Layout]) -> int:
    """Return the smallest index of a line's microphones."""
    return int(line[0].min())


def square_microphones(receiver: ReceiverConfig) -> Microphones:
    """Return the microphones of the square, on four faces around the vehicle's centre.

    >>> square_microphones(ReceiverConfig()).position.shape
    (40, 3)
    """
    square, rows = square_of_four(receiver), []
    reach = 0.5 * (np.ptp(square.position) + receiver.spacing)
    for name, normal in zip(("front", "left", "back", "right"), square.normal, strict=True):
        ahead, left = np.array([np.cos(normal), np.sin(normal)]), (-np.sin(normal), np.cos(normal))
        for along in square.position:
            x, y = reach * ahead + along * np.array(left)
            rows.append((float(x), float(y), 0.0, 0.0, name))
    return microphones_of(rows)


def along_line(layout: Scattered, g: int) -> tuple[Int[np.ndarray, " k"], Layout]:
    """Return the indices of a line's microphones from right to left, and its layout."""
    _, members = layout.members(g)
    left = np.array([-np.sin(layout.normal[g]), np.cos(layout.normal[g])])
    along = layout.position[members] @ left
    order = np.argsort(along)
    return members[order], Layout(
        normal=layout.normal[g : g + 1],
        position=(np.arange(along.size) - 0.5 * (along.size - 1))
        * np.ptp(along)
        / (along.size - 1),
    )


def _normal(place: Float[np.ndarray, "k 2"], middle: Float[np.ndarray, "2"]) -> float:
    """Return the direction of a line's outward normal; NaN if microphones are not on a line."""
    centre = place.mean(axis=0)
    far = place[np.argmax(np.linalg.norm(place - place[0], axis=1))] - place[0]
    along = far / max(np.linalg.norm(far), LINE_TOLERANCE)
    order = np.argsort(place @ along)
    regular = np.linspace(place[order[0]], place[order[-1]], len(place))
    if np.abs(place[order] - regular).max() > LINE_TOLERANCE:
        return np.nan
    along *= np.sign((place[-1] - place[0]) @ along)
    normal = np.array([along[1], -along[0]])
    outward = (centre - middle) @ normal
    if outward < -LINE_TOLERANCE:
        normal = -normal
    return float(wrap(np.arctan2(normal[1], normal[0])))


def square_of_four(receiver: ReceiverConfig) -> Layout:
    """Return the layout of four faces, to the front, left, back and right.

    `receiver` has the number of elements and their spacing [m]. Bradley & Abaid, Sec. II-C.

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
