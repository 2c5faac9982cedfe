"""The array, checked by the loudest sound: orders, signs and mirror images that would fit better.

A plane wave's phases rise evenly along a line of microphones. What of the energy of a loud echo
the best beam misses is the line's *misfit*; two channels that are swapped, or one whose sign is,
raise it. A line that is counted from the wrong end fits as well, but says the mirror image of each
angle: then two faces that hear one echo disagree, as they do where faces are swapped.
"""

from collections.abc import Iterator
from itertools import combinations, permutations

import numpy as np
from jaxtyping import Complex, Float

from pipistrelle.detection.sounds.hearing import Frame, Hearing
from pipistrelle.geometry import wrap

CALLS, SNAPSHOTS = 64, 60
"""Most calls that are listened to, and snapshots of a face that are kept."""
MIN_SNAPSHOTS, MIN_PAIRS = 5, 10
MOST_FACES = 4
"""Most faces of which all orders are tried."""
LOUD = 300.0
"""Least power of an echo over the noise of a steered beam."""
MISFIT, BETTER = 0.02, 0.5
"""Least misfit that asks for another order, and the share of it that one leaves which is named."""
DISAGREE = 0.15
"""Least median difference between the bearings of two faces that asks for other faces [rad]."""


def array_faults(hearing: Hearing) -> Iterator[str]:
    """Say which other order of the channels would explain the loudest sounds better."""
    faces = len(hearing.microphones.channel)
    heard: list[list[tuple[int, Complex[np.ndarray, " e"]]]] = [[] for _ in range(faces)]
    pairs: list[tuple[int, float, int, float]] = []
    last = hearing.calls.sample.size - 1
    for frame in hearing.frames(np.unique(np.linspace(0, last, CALLS).astype(np.int64)).tolist()):
        _collect(frame, heard)
        pairs += _pairs(frame, hearing)
    for face, some in enumerate(heard):
        if len(some) >= MIN_SNAPSHOTS:
            yield from _order(hearing, face, some)
    if len(pairs) >= MIN_PAIRS:
        yield from _faces(hearing, np.array(pairs))


def _collect(frame: Frame, heard: list[list[tuple[int, Complex[np.ndarray, " e"]]]]) -> None:
    """Keep the matched filters' outputs of the loudest echo of each face and caller."""
    found = frame.detections
    for face, some in enumerate(heard):
        for caller in np.unique(found.caller):
            rows = np.flatnonzero((found.face == face) & (found.caller == caller))
            if rows.size == 0 or len(some) >= SNAPSHOTS:
                continue
            d = rows[found.power[rows].argmax()]
            lag = round((found.delay[d] - frame.start) / frame.interval)
            if found.power[d] >= LOUD and 0 <= lag < len(frame.matched):
                some.append((int(caller), frame.matched[lag, face, caller].copy()))


def _pairs(frame: Frame, hearing: Hearing) -> list[tuple[int, float, int, float]]:
    """Pair detections of one echo by two faces: the loudest of each within a quarter of a call."""
    found, pairs = frame.detections, []
    late = 0.25 * hearing.about.call.duration
    for one, other in combinations(np.flatnonzero(found.power >= LOUD).tolist(), 2):
        same = found.caller[one] == found.caller[other] and found.face[one] != found.face[other]
        if same and abs(found.delay[one] - found.delay[other]) < late:
            face, angle = found.face[[one, other]].tolist(), found.angle[[one, other]].tolist()
            pairs.append((face[0], angle[0], face[1], angle[1]))
    return pairs


def _order(
    hearing: Hearing, face: int, heard: list[tuple[int, Complex[np.ndarray, " e"]]]
) -> Iterator[str]:
    """Try to swap two channels of a face, or the sign of one."""
    caller = np.array([number for number, _ in heard])
    output = np.array([one for _, one in heard])
    position = hearing.microphones.layout.position
    wave = 2.0 * np.pi * hearing.blocks.tones / hearing.config.assumed_sound_speed
    sine = np.linspace(-1.0, 1.0, 201)
    beams = np.exp(-1j * wave[:, None, None] * np.multiply.outer(sine, position))

    def misfit(changed: Complex[np.ndarray, "n e"]) -> float:
        power = np.abs(np.einsum("nbe,ne->nb", beams[caller], changed)) ** 2
        energy = (np.abs(changed) ** 2).sum(axis=1) * position.size
        return float(np.median(1.0 - power.max(axis=1) / energy))

    now = misfit(output)
    if now < MISFIT:
        return
    channel, tried = hearing.microphones.channel[face] + 1, []
    for i, j in combinations(range(position.size), 2):
        order = np.arange(position.size)
        order[[i, j]] = j, i
        tried.append((misfit(output[:, order]), f"swap channels {channel[i]} and {channel[j]}"))
    for i in range(position.size):
        sign = np.where(np.arange(position.size) == i, -1.0, 1.0)
        tried.append((misfit(output * sign), f"turn the sign of channel {channel[i]} round"))
    best, what = min(tried)
    misses = f"face {face + 1}: the best beam misses {now:.1%} of the loudest echoes' energy"
    if best <= BETTER * now:
        yield f"{misses}, {best:.1%} if you {what} in array.csv"
    else:
        yield f"{misses}, and no swap of two channels would help: are places and tone right?"


def _faces(hearing: Hearing, pairs: Float[np.ndarray, "n 4"]) -> Iterator[str]:
    """Try other orders of the faces, and lines that are counted from the other end."""
    normal, count = hearing.microphones.layout.normal, len(hearing.microphones.channel)
    face, angle = pairs[:, [0, 2]].astype(np.int64), pairs[:, [1, 3]]

    def differ(order: tuple[int, ...], side: float) -> float:
        bearing = normal[np.array(order)][face] + side * angle
        return float(np.median(np.abs(wrap(bearing[:, 0] - bearing[:, 1]))))

    as_it_is = tuple(range(count))
    now = differ(as_it_is, 1.0)
    if now < DISAGREE:
        return
    moved = sorted(permutations(as_it_is), key=lambda o: sum(map(int.__ne__, o, as_it_is)))
    orders = moved if count <= MOST_FACES else [as_it_is]
    tried = {(order, side): differ(order, side) for side in (-1.0, 1.0) for order in orders}
    said, best = f"two faces that hear one echo differ by {now:.2f} rad", min(tried.values())
    if best > BETTER * now:
        yield f"{said}, and no order of the faces would help"
        return
    fits = [change for change, left in tried.items() if left <= best + 0.02]
    firsts = [next((f for f in fits if f[1] == side), None) for side in (-1.0, 1.0)]
    words = " or ".join(_change(*first) for first in firsts if first is not None)
    yield f"{said}, by {best:.2f} rad if in array.csv you {words}"


def _change(order: tuple[int, ...], side: float) -> str:
    """Say what makes the faces stand in an order, and their lines turn round."""
    changes = ["count each face's channels from its other end"] if side < 0 else []
    moved = [(f, o) for f, o in enumerate(order) if f != o]
    changes += [f"let face {f + 1} be where face {o + 1} is" for f, o in moved]
    return " and ".join(changes)
