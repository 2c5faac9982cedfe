"""The methods of association by name."""

from pipistrelle.config import Config, InputError
from pipistrelle.estimation.association import KNOWN, Association
from pipistrelle.estimation.data_association.compatibility import jointly_compatible
from pipistrelle.estimation.data_association.matching import marginal, nearest
from pipistrelle.estimation.data_association.pairs import BARELY, Chances
from pipistrelle.estimation.data_association.sequential import Limits, Sequential
from pipistrelle.estimation.outside import ASSOCIATION, build, class_of, names_class

METHODS = {"nearest": nearest, "joint": jointly_compatible, "marginal": marginal}
"""How rows of a scan are matched with landmarks, by ``association.method``."""
GATE = 25.0
"""Largest squared distance of a row from its landmark: 0.5 to 1 % of right rows are beyond."""

VAGUE = 0.0012
"""The clutter that a pair may cover: `Chances.vague` times the clutter per radian and metre."""


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
            assumed=(told.bearing_std, told.range_std, told.excess_path_std),
            sight=(settings.max_range or 0.0, settings.field_of_view),
        )
        return Sequential(match=METHODS[name], chances=tuple(chances), limits=limits)
    if not names_class(name):
        expected = ", ".join(map(repr, [KNOWN, *METHODS]))
        raise InputError(f"association.method: found {name!r}, expected {expected} or module:Class")
    return build(ASSOCIATION, name, class_of(ASSOCIATION, name), (config,), {"config": config})
