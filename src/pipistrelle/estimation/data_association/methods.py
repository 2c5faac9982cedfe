"""The methods of association by name."""

import math
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from pipistrelle.config import Config, InputError
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.association import KNOWN, Association
from pipistrelle.estimation.data_association.compatibility import jointly_compatible
from pipistrelle.estimation.data_association.matching import marginal, nearest
from pipistrelle.estimation.data_association.pairs import BARELY, Chances
from pipistrelle.estimation.data_association.rows import rows_of_scan
from pipistrelle.estimation.data_association.sequential import Limits, Sequential
from pipistrelle.estimation.outside import ASSOCIATION, build, class_of, names_class

METHODS = {"nearest": nearest, "joint": jointly_compatible, "marginal": marginal}
"""How rows of a scan are matched with landmarks, by ``association.method``."""
GATE = 25.0
"""Largest squared distance of a row from its landmark: 0.5 to 1 % of right rows are beyond."""

VAGUE = 0.0012
"""The clutter that a pair may cover: `Chances.vague` times the clutter per radian and metre."""


def left_out(config: Config, scans: Iterable[Scan]) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the deviations of rows that an association leaves out as too unsure.

    By the setting that decides it, ``bearing_std`` [rad] or ``way_std`` [m]; no entry where no row
    is left out. `scans` have the deviations that the estimator is given where none is stated.
    """
    if config.association.method not in METHODS:
        return {}
    settings, found = config.association, {"bearing_std": [], "way_std": []}
    for scan in scans:
        for name, limits in (
            ("bearing_std", (settings.bearing_std, math.inf, math.inf)),
            ("way_std", (math.inf, settings.way_std, math.inf)),
        ):
            rows = rows_of_scan(scan, limits, _assumed(config))
            found[name].append(getattr(rows, name)[~rows.usable])
    joined = {name: np.concatenate([np.empty(0), *parts]) for name, parts in found.items()}
    return {name: stds for name, stds in joined.items() if stds.size}


def _assumed(config: Config) -> tuple[float, float, float]:
    """Return the deviations that are assumed of rows which state none."""
    told = config.filter
    return told.bearing_std, told.range_std, told.excess_path_std


def association_of(config: Config) -> Association | None:
    """Return the association that ``association.method`` names; None for known labels.

    A class from outside, ``module:Class``, is built by its ``from_config(config)`` where it has
    one; else it is a dataclass, and may have a field ``config``, all settings.

    It raises InputError for a class that is not there, is no `Association` or cannot be built.
    """
    name, settings = config.association.method, config.association
    if name == KNOWN:
        return None
    if name in METHODS:
        told, vague = config.filter, VAGUE / settings.clutter
        if told.noise == "constant":  # the estimator knows no more of what was heard once
            vague = max(vague, BARELY * told.bearing_std * told.range_std)
        chances = Chances(
            gate=GATE,
            clutter=settings.clutter,
            bearing_clutter=20.0 * settings.clutter,
            detection=settings.detection,
            vague=vague,
        )
        limits = Limits(
            bearing_std=settings.bearing_std,
            way_std=settings.way_std,
            assumed=_assumed(config),
            sight=(settings.max_range or 0.0, settings.field_of_view),
        )
        return Sequential(match=METHODS[name], chances=tuple(chances), limits=limits)
    if not names_class(name):
        expected = ", ".join(map(repr, [KNOWN, *METHODS]))
        raise InputError(f"association.method: found {name!r}, expected {expected} or module:Class")
    return build(ASSOCIATION, name, class_of(ASSOCIATION, name), (config,), {"config": config})
