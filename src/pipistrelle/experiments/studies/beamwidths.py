"""Beamwidths in a plan's grid: each stands for the piston that makes it.

A plan may vary `beamwidth` [deg] in place of `emitter.radius` [m]. What is kept and compared is the
radius alone, so that both ways of writing a plan are one study.
"""

from collections.abc import Mapping, Sequence
from decimal import ROUND_FLOOR, Context
from math import isfinite, radians
from typing import Any

from pipistrelle.config import Config, InputError
from pipistrelle.experiments.studies.plan import RADIUS
from pipistrelle.refusals import refusal, shown
from pipistrelle.settings import Given, Layer, resolve

BEAMWIDTH = "beamwidth"
MAKERS = (
    *("emitter.call", "emitter.band", "emitter.frequency"),
    *("air.speed_of_sound", "air.temperature_c"),
)
"""Settings that change the beamwidth; the last one unless the speed of sound is set."""
DIGITS = Context(prec=12, rounding=ROUND_FLOOR)
"""Digits of a radius on which machines agree; rounded down, so that no beam exceeds the widest."""


def with_radii(
    where: str, grid: Mapping[str, Any], strategies: Sequence[str], layer: Layer
) -> dict[str, Any]:
    """Replace the beamwidths of a grid by piston radii, in the same order.

    The layer holds the plan's settings, which give the tone and the speed of sound.

    >>> with_radii("grid", {"beamwidth": [180, 11.4], "seed": []}, ["active"], {})
    {'emitter.radius': [0.0025210352264, 0.0253830203249], 'seed': []}
    """
    if BEAMWIDTH not in grid:
        return dict(grid)
    _check_alone(where, grid, strategies, layer)
    widths, place = grid[BEAMWIDTH], f"{where}.{BEAMWIDTH}"
    if not isinstance(widths, list) or not widths:
        raise refusal(place, shown(widths), "a list of degrees", "write it as [180, 33, 11]")
    config = resolve(layer)
    radii: dict[float, Any] = {}
    for width in widths:
        radius = _radius(place, width, config)
        if radius in radii:
            raise refusal(place, f"{shown(width)} twice", "each value once", "leave one out")
        radii[radius] = width
    widest = max(radii)
    resolve(layer | {("emitter", "radius"): Given(widest, f"{place}: radius of {radii[widest]}")})
    varied = {RADIUS if name == BEAMWIDTH else name: values for name, values in grid.items()}
    return varied | {RADIUS: [*radii]}


def _check_alone(
    where: str, grid: Mapping[str, Any], strategies: Sequence[str], layer: Layer
) -> None:
    """Refuse beamwidths beside radii or settings that decide them, or if all is passive."""
    emitter = grid.get("emitter")
    if RADIUS in grid or (isinstance(emitter, dict) and "radius" in emitter):
        raise InputError(f"{where}.{BEAMWIDTH}: is {RADIUS} in other words; vary one of them")
    given = ("air", "speed_of_sound") in layer
    for name in MAKERS[: -1 if given else None]:
        section, _, leaf = name.partition(".")
        table = grid.get(section)
        if name in grid or (isinstance(table, dict) and leaf in table):
            why = f"a beamwidth is no one radius where {name} varies too; vary {RADIUS}"
            raise InputError(f"{where}.{BEAMWIDTH}: {why}")
    if set(strategies) == {"passive"}:
        why = "the beam is that of the vehicle's call, which passive sensing does not hear"
        raise InputError(f"{where}.{BEAMWIDTH}: {why}; add another strategy or take it out")


def _radius(where: str, width: Any, config: Config) -> float:
    """Find the piston that makes a beamwidth [deg]."""
    from pipistrelle.acoustics.emitter import piston_radius

    number = isinstance(width, (int, float)) and not isinstance(width, bool)
    if not number or not isfinite(width) or not 0.0 < width <= 180.0:
        expected = "degrees above 0 and up to 180, the widest beam of a back-baffled piston"
        raise refusal(where, shown(width), expected, "correct the value")
    tone = {"frequency": config.emitter.centre, "speed_of_sound": config.medium.sound_speed}
    return float(DIGITS.create_decimal_from_float(float(piston_radius(radians(width), **tone))))
