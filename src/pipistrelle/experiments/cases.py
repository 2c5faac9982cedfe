"""A case: who is to map a world from what it hears, by its own calls, another's, or both."""

from dataclasses import dataclass

from pipistrelle.config import Strategy


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One combination to try: a sensing strategy and a filter, in one world.

    Attributes
    ----------
    strategy : "active", "fused" or "passive"
    filter : str
        The name of an estimator (`estimation.catalogue.entry`).
    iteration : int
        Number of the world.
    """

    strategy: Strategy
    filter: str
    iteration: int = 0
