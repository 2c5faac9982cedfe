"""Beliefs to numbers: how far from the truth, and whether the filter knows how far.

`accuracy` measures the errors of path and map, as they are and after the rigid motion that fits
best; `consistency` asks by the NEES whether they are as large as the filter believes, over one run
or over many (Bradley & Abaid, Sec. V-A); `bound` is the least that any estimator could be sure of,
and what NEES a consistent one has.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "accuracy": ["alignment", "heaviest", "pose_error", "rmse"],
        "consistency": ["anees", "anees_bounds", "diverged", "nees"],
    },
)
