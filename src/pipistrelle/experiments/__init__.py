"""Missions and logs on trial: worlds drawn, heard, mapped, scored and kept.

`trial` is the file to read first: a mission on one screen (Bradley & Abaid, Sec. IV). `scenario`
draws its world, `listening` hears it, and `association` labels what was heard, the one place where
the truth does so. `replay` puts a recorded log to the same filters; `results`, with `tables` and
`folder`, scores and keeps what came of either.
"""

from importlib import import_module

_DOOR = {
    "draw_scenario": "scenario",
    "label_detections": "association",
    "listen": "listening",
    "load": "replay",
    "run_filter": "trial",
    "run_mission": "trial",
    "run_trial": "trial",
    "write_results": "results",
}


def __dir__() -> list[str]:
    return sorted([*globals(), *_DOOR])


def __getattr__(name: str) -> object:
    if name not in _DOOR:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_DOOR[name]}"), name)
