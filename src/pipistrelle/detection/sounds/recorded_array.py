"""The array of a recording, and which channel of the sound each of its microphones is."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from pipistrelle.arrays.array_file import read_array
from pipistrelle.arrays.layout import Layout, Scattered, at_one_centre, scattered
from pipistrelle.refusals import refusal

FILE = "array.csv"


class RecordedArray(NamedTuple):
    """Microphones, and where they are in a sound file."""

    layout: Layout | Scattered
    channel: Int[np.ndarray, "f e"]
    """Numbers of the channels in a sound file, from 0 on."""
    face: tuple[str, ...]
    """Names of the groups of microphones that are scanned together."""

    @property
    def used(self) -> Int[np.ndarray, " m"]:
        """The channels that are microphones, in order."""
        return np.unique(self.channel)


def recorded_array(folder: Path, channels: int, *, one_centre: bool) -> RecordedArray:
    """Read ``array.csv`` of a recording that has some channels.

    `one_centre`: whether faces are heard as if all stood at the vehicle's point.
    """
    path = folder / FILE
    microphones = read_array(path, some=True)
    if (most := int(microphones.channel.max())) > channels:
        found, expected = f"channel {most}, of sound that has {channels}", f"1 to {channels}"
        raise refusal(path, found, expected, "correct the channels")
    if one_centre:
        layout, which = at_one_centre(microphones, str(path))
        names = tuple(microphones.face[first] for first in which[:, 0])
        return RecordedArray(layout, microphones.channel[which] - 1, names)
    free = scattered(microphones, str(path))
    names = tuple(name or "those without a face" for name in free.name)
    return RecordedArray(free, microphones.channel[np.newaxis] - 1, names)
