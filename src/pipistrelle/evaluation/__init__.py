"""Beliefs to numbers: how far from the truth, and whether the filter knows how far.

`accuracy` measures the errors of path and map, as they are and after the rigid motion that fits
best; `consistency` asks by the NEES whether they are as large as the filter believes, over one run
or over many (Bradley & Abaid, Sec. V-A).
"""

from importlib import import_module

_DOOR = {
    "alignment": "accuracy",
    "anees": "consistency",
    "anees_bounds": "consistency",
    "diverged": "consistency",
    "heaviest": "accuracy",
    "nees": "consistency",
    "pose_error": "accuracy",
    "rmse": "accuracy",
}


def __dir__() -> list[str]:
    return sorted([*globals(), *_DOOR])


def __getattr__(name: str) -> object:
    if name not in _DOOR:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_DOOR[name]}"), name)
