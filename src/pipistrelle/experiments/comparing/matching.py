"""What folders have in common: estimates by their names, and settings by their values."""

from collections.abc import Hashable, Mapping, Sequence
from typing import Any, TypeVar

from pipistrelle.estimation.catalogue import short_name
from pipistrelle.experiments.results.reading import Estimate

K = TypeVar("K", bound=Hashable)


def alike(folders: Sequence[Sequence[Estimate]]) -> tuple[bool, bool]:
    """Return whether strategies and whether filters distinguish the estimates of any folder.

    What does not is no part of an estimate's name: then a folder of one filter is compared with
    another of one, whichever they are, strategy by strategy.

    Returns: of the strategy, of the filter.

    Examples
    --------
    >>> both = [("active", "ekf"), ("fused", "ekf")]
    >>> alike([both, [("fused", "smoother")]])
    (True, False)
    """
    strategy, name = (
        any(len({estimate[part] for estimate in estimates}) > 1 for estimates in folders)
        for part in (0, 1)
    )
    return strategy, name


def named(estimate: Estimate, parts: tuple[bool, bool] = (True, True)) -> Estimate:
    """Drop the strategy or filter from an estimate's key if it distinguishes nothing.

    `parts`: as `alike` gives them. Returns: nothing in place of what is left out.

    Examples
    --------
    >>> named(("fused", "ekf"), (True, False))
    ('fused', '')
    """
    strategy, name = estimate
    return strategy * parts[0], name * parts[1]


def worded(estimates: Sequence[Estimate]) -> str:
    """Name the strategy and filter that estimates share.

    Examples
    --------
    >>> worded([("fused", "ekf"), ("fused", "mine:Own")]), worded([("fused", "mine:Own")])
    ('fused', 'fused Own')
    """
    strategies, filters = ({estimate[part] for estimate in estimates} for part in (0, 1))
    common = [only for (only, *others) in (sorted(strategies), sorted(filters)) if not others]
    return " ".join(map(short_name, common))


def matched(keys: Sequence[Sequence[K]]) -> tuple[tuple[K, ...], dict[K, tuple[int, ...]]]:
    """Split keys into those of all folders and those of some.

    Parameters
    ----------
    keys : sequence of sequences
        Of each folder, no two alike.

    Returns
    -------
    tuple
        Those of all, in the order of the first.
    dict of tuple of int
        Those of some, and which have them.

    Examples
    --------
    >>> matched([["a", "b"], ["c", "b"]])
    (('b',), {'a': (0,), 'c': (1,)})
    """
    owners = {
        key: tuple(i for i, own in enumerate(keys) if key in own) for each in keys for key in each
    }
    everywhere = tuple(key for key, who in owners.items() if len(who) == len(keys))
    return everywhere, {key: who for key, who in owners.items() if len(who) < len(keys)}


def differing(settings: Sequence[Mapping[str, Any]]) -> dict[str, tuple[Any, ...]]:
    """Find the settings that are not the same everywhere.

    Returns: the value of each, by name; None where one says nothing of it.

    Examples
    --------
    >>> differing([{"seed": 1, "rays.power": 2.0}, {"seed": 1, "rays.power": 3.0, "x": 0}])
    {'rays.power': (2.0, 3.0), 'x': (None, 0)}
    """
    found = {
        name: tuple(one.get(name) for one in settings)
        for name in dict.fromkeys(name for one in settings for name in one)
    }
    return {name: values for name, values in found.items() if any(v != values[0] for v in values)}


def section(name: str) -> str:
    """Name the section of a setting; one that is in none is a section of its own.

    `name`: dotted.

    Examples
    --------
    >>> section("rays.power"), section("seed")
    ('rays', 'seed')
    """
    return name.partition(".")[0]
