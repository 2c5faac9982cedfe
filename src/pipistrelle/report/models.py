"""Charts of a study's models: the emitter's beam patterns and an example world."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.emitter import HALF_POWER, piston_directivity, piston_radius
from pipistrelle.acoustics.paths import VEHICLE, Caller, moves
from pipistrelle.config import Config
from pipistrelle.experiments.hearing.scenario import Scenario
from pipistrelle.figures.chart import Axis, Chart, Panel, Series
from pipistrelle.report.study import Study, combination_name
from pipistrelle.report.variables import listed, width_name


def model_charts(study: Study) -> list[Chart]:
    """Return charts of the emitter's beam patterns and, if it can be drawn, an example world."""
    maps = [] if study.example is None else [example_map(study, study.example)]
    return [piston(study), *maps]


def piston(study: Study) -> Chart:
    """Chart the beam patterns of the vehicle's emitter at all beamwidths of a study.

    Bradley & Abaid, Eq. (1) and Appendix B.
    """
    series = _protractor()
    widths, first = np.unique(study.beamwidth, return_index=True)
    last = max(len(widths) - 1, 1)
    for i in reversed(range(len(widths))):
        config = study.configs[first[i]]
        series += _beam(config, float(widths[i]), 1.0 - 0.75 * i / last)
    panel = Panel(
        title="",
        x=Axis(label="", limits=(-1.15, 1.15), ticks=()),
        y=Axis(label="", limits=(-0.12, 1.15), ticks=()),
        series=tuple(series),
        equal=True,
    )
    return Chart(
        name="piston",
        title="Beams of the vehicle's emitter",
        caption="Pressure of a back-baffled piston over the angle off its axis, relative to the "
        "axis (up); rings at 0.5, 0.71 (half power, the dots) and 1; the stronger a line, the "
        "narrower",
        panels=(panel,),
        columns=("across", "along"),
    )


def example_map(study: Study, world: Scenario) -> Chart:
    """Chart a world of the study: path, landmarks and callers (Bradley & Abaid, Sec. IV)."""
    setup, circle, series = study.configs[0].scenario, "", _world(world)
    if setup.field == "disc" and setup.world is None:
        circle = f"; the dashed circle has a radius of {setup.radius:g} m"
        turn = np.linspace(0.0, 2.0 * np.pi, 181)
        x, y = setup.radius * np.cos(turn), setup.radius * np.sin(turn)
        edge = Series(name="edge", role="grid", x=x, y=y, dashed=True, listed=False)
        series = (edge, *series)
    places = np.array([[part(s.x), part(s.y)] for s in series for part in (np.min, np.max)])
    low, high = places.min(axis=0), places.max(axis=0)
    middle, reach = (low + high) / 2.0, 0.52 * np.max(high - low)  # axes of equal length
    limits = [(float(at - reach), float(at + reach)) for at in middle]
    x, y = (Axis(label="", limits=ends, ticks=()) for ends in limits)
    count, others = len(world.landmarks), [caller.name for caller in world.callers[VEHICLE + 1 :]]
    shown = listed([f"{count} landmarks", *(f"the {name}" for name in others)])
    where = f" where {combination_name(study, 0)}" if study.drawing.any() else ""
    return Chart(
        name="example_map",
        title="A world of the study",
        caption=f"World {study.worlds[0]}{where}: {shown}, and the vehicle's true path of "
        f"{world.time[-1]:g} s{circle}",
        panels=(Panel(title="", x=x, y=y, series=series, equal=True),),
        columns=("x_m", "y_m"),
    )


def _beam(config: Config, width: float, strength: float) -> list[Series]:
    """Return a beam pattern as data series: its outline, and labelled dots at half power."""
    tone = {"frequency": config.emitter.centre, "speed_of_sound": config.medium.sound_speed}
    half = np.radians(np.array([width])) / 2.0
    radius = float(piston_radius(np.radians(width), **tone))
    name, angle = width_name(width), np.radians(np.linspace(-90.0, 90.0, 361))
    pressure, edge = (piston_directivity(at, radius=radius, **tone) for at in (angle, half))
    ka = HALF_POWER / float(np.sin(half[0]))
    tip = f"{name}\nradius: {1e3 * radius:.1f} mm\nka: {ka:.1f}"
    look = {"name": name, "role": "active", "strength": strength}
    return [
        Series(x=pressure * np.sin(angle), y=pressure * np.cos(angle), **look),
        Series(
            x=edge * np.sin(half),
            y=edge * np.cos(half),
            style="marks",
            tips=(tip,),
            listed=False,
            **look,
        ),
    ]


def _protractor() -> list[Series]:
    """Return the rings, spokes and labels of a polar beam chart, as data series."""
    angle = np.radians(np.linspace(-90.0, 90.0, 181))
    spokes = np.radians(np.linspace(-90.0, 90.0, 7))
    rings = (0.5, math.sqrt(0.5), 1.0)
    arcs = [(ring * np.sin(angle), ring * np.cos(angle), ring < 1.0) for ring in rings]
    lines = [(np.array([0.0, np.sin(s)]), np.array([0.0, np.cos(s)]), False) for s in spokes]
    names = [f"{abs(degrees):.0f}°" for degrees in np.degrees(spokes)]
    text = Series(
        name="scale",
        role="grid",
        x=np.append(1.08 * np.sin(spokes), rings),
        y=np.append(1.08 * np.cos(spokes), np.full(len(rings), -0.06)),
        style="text",
        tips=(*names, *(f"{ring:.2g}" for ring in rings)),
        listed=False,
    )
    return [
        *(
            Series(name="scale", role="grid", x=x, y=y, dashed=dashed, listed=False)
            for x, y, dashed in arcs + lines
        ),
        text,
    ]


def _world(world: Scenario) -> tuple[Series, ...]:
    """Return a world's true path, start, landmarks and callers as data series of a map."""
    count = len(world.landmarks)
    look = {"role": "ink", "style": "points", "filled": np.zeros(count, bool)}
    path, start = world.path[:, :2], world.path[:1, :2]
    numbered = [f"landmark {i}" for i in range(1, count + 1)]
    return (
        Series(name="true path", role="truth", x=path[:, 0], y=path[:, 1]),
        _places("start", start, ["start"], role="truth", style="points"),
        _places("landmark", world.landmarks, numbered, **look),
        *(_caller(caller) for caller in world.callers[VEHICLE + 1 :]),
    )


def _caller(caller: Caller) -> Series:
    """Return a caller as a data series: the path if it moves, else a star at its position."""
    place = np.reshape(np.asarray(caller.place), (-1, 2))
    if moves(caller):
        return Series(name=caller.name, role="fused", x=place[:, 0], y=place[:, 1])
    return _places(caller.name, place, [caller.name], role="fused", style="stars")


def _places(
    name: str, points: Float[np.ndarray, "n 2"], labels: Sequence[str], **look: Any
) -> Series:
    """Return points as a data series, each with a label and its coordinates as text."""
    tips = tuple(
        f"{label}\nx: {x:.1f} m\ny: {y:.1f} m" for label, (x, y) in zip(labels, points, strict=True)
    )
    return Series(name=name, x=points[:, 0], y=points[:, 1], tips=tips, **look)
