"""Accuracy and consistency of estimates: errors, NEES, bounds and comparisons of cases.

`accuracy`: errors of path and map, also after the best rigid alignment; `association`: errors of
labels, and GOSPA of the map; `consistency`: NEES and ANEES (Bradley & Abaid, Sec. V-A); `bound`:
the posterior Cramér-Rao bound, and the NEES of a consistent filter; `comparison`: tests over
worlds; `scores`: the list of all scores.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "accuracy": ["alignment", "heaviest", "pose_error", "rmse"],
        "consistency": ["anees", "anees_bounds", "diverged", "nees"],
    },
)
