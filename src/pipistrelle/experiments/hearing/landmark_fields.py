"""Layouts of landmarks: the paper's disc, the rows of an orchard, the corners of rooms."""

import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from pipistrelle.config import InputError, ScenarioConfig

MAX_DRAWS = 2000
"""Draws of one landmark after which a position counts as impossible."""
MAX_ROW_OFFSET = 0.1
"""Largest offset of a tree along and across its row, as a share of the distance between trees."""
ROOM_SIZE = (0.75, 1.5)
"""Bounds of the drawn width and depth of rooms, in widths of the corridor."""

Points = Float[np.ndarray, "_ 2"]


def landmarks_in(
    setup: ScenarioConfig, path: Points, callers: Points, rng: np.random.Generator
) -> Points:
    """Generate a world's landmarks at random, clear of the vehicle's path and fixed callers.

    `path` and `callers` are positions [m]. Orchards and rooms give the landmarks nearest the
    centre, in rising distance. Returns positions [m].

    Bradley & Abaid, Sec. IV: the disc.

    >>> setup, nowhere = ScenarioConfig(field="rows", lane=4.0, landmarks=8), np.empty((0, 2))
    >>> trees = landmarks_in(setup, nowhere, nowhere, np.random.default_rng(7))
    >>> np.unique(np.rint(trees[:, 1]))
    array([-2.,  2.])
    """
    _refuse_crowd(setup)
    if setup.field == "disc":
        return _scattered(setup, path, callers, rng)
    grown = _rows(setup, rng) if setup.field == "rows" else _corners(setup, rng)
    places = np.array([place for place in grown if math.hypot(*place) <= setup.radius])
    placed = np.empty((0, 2))
    for place in places[np.argsort(np.hypot(*places.reshape(-1, 2).T), kind="stable")]:
        if len(placed) == setup.landmarks:
            break
        if _is_clear(place, setup, path, callers) and nearest(placed, place) >= setup.clearance:
            placed = np.vstack((placed, place))
    if len(placed) < setup.landmarks:
        raise _too_many(setup, f"room was found for {len(placed)}")
    return placed


def nearest(points: Points, place: Float[np.ndarray, "2"]) -> float:
    """Return the distance from a position to the nearest of some points; infinity without any."""
    offset = points - place
    return math.sqrt(np.min(np.sum(offset * offset, axis=1), initial=math.inf))


def _scattered(
    setup: ScenarioConfig, path: Points, callers: Points, rng: np.random.Generator
) -> Points:
    """Scatter landmarks at random over the disc or annulus, with the required distances."""
    placed, inner = np.empty((setup.landmarks, 2)), setup.inner_radius / setup.radius
    for i in range(setup.landmarks):
        for _ in range(MAX_DRAWS):
            share = rng.uniform()
            if setup.density == "area":
                distance = setup.radius * math.sqrt(inner**2 + (1.0 - inner**2) * share)
            else:
                distance = setup.radius * (inner + (1.0 - inner) * share)
            direction = rng.uniform(-math.pi, math.pi)
            place = distance * np.array([math.cos(direction), math.sin(direction)])
            apart = nearest(placed[:i], place) >= setup.spacing
            if apart and _is_clear(place, setup, path, callers):
                placed[i] = place
                break
        else:
            raise _too_many(setup, f"room was found for {i}")
    return placed


def _rows(setup: ScenarioConfig, rng: np.random.Generator) -> Iterator[tuple[float, float]]:
    """Yield tree positions in rows along x, halfway between the lanes of a lawn-mower course."""
    if setup.spacing == 0.0:
        expected = "the distance of two trees of a row [m]"
        raise InputError(f"scenario.spacing: found 0, expected {expected}")
    first = math.ceil((setup.radius - setup.extent) / setup.lane)
    across = np.arange(-setup.extent - (first - 0.5) * setup.lane, setup.radius, setup.lane)
    along = np.arange(-setup.radius, setup.radius, setup.spacing) + rng.uniform() * setup.spacing
    for y in across.tolist():
        for x in along.tolist():
            off = MAX_ROW_OFFSET * setup.spacing * rng.uniform(-1.0, 1.0, 2)
            yield x + off[0], y + off[1]


def _corners(setup: ScenarioConfig, rng: np.random.Generator) -> Iterator[tuple[float, float]]:
    """Yield the corner positions of rooms of random size on both sides of a corridor along x."""
    for side in (-1.0, 1.0):
        x, wall = -setup.radius, 0.5 * side * setup.lane
        while x < setup.radius:
            width, depth = setup.lane * rng.uniform(*ROOM_SIZE, 2)
            yield from ((x, wall), (x, wall + side * depth), (x + width, wall + side * depth))
            x += width


def _is_clear(
    place: tuple[float, float] | Float[np.ndarray, "2"],
    setup: ScenarioConfig,
    path: Points,
    callers: Points,
) -> bool:
    """Return whether a position keeps the clearance from the vehicle's path and the callers."""
    at, least = np.asarray(place), setup.clearance
    return nearest(path, at) >= least and nearest(callers, at) >= least


def _refuse_crowd(setup: ScenarioConfig) -> None:
    """Raise if the disc of the settings has no room for the requested number of landmarks."""
    if setup.field == "disc" and setup.inner_radius >= setup.radius:
        found, most = f"{setup.inner_radius:g} m", f"scenario.radius, {setup.radius:g} m"
        raise InputError(f"scenario.inner_radius: found {found}, expected less than {most}")
    half = 0.5 * setup.spacing
    most = math.pi / math.sqrt(12.0)  # the largest share of the plane that equal discs can cover
    most *= ((setup.radius + half) / max(half, 1e-100)) ** 2
    if setup.field == "disc" and setup.landmarks > max(most, 1.0):
        raise _too_many(setup, f"at most {max(int(most), 1)} fit")


def _too_many(setup: ScenarioConfig, limit: str) -> InputError:
    """Return the InputError for more landmarks than fit into the world."""
    return InputError(
        f"scenario.landmarks: found {setup.landmarks}, but {limit} at {setup.spacing:g} m from "
        f"each other within {setup.radius:g} m of the centre; expected fewer landmarks, a smaller "
        "scenario.spacing or scenario.clearance, or a larger scenario.radius"
    )
