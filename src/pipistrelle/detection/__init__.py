"""Samples, or a recorded log, to scans; the truth is never seen.

`matched` filters a recording for calls, `snapshots` finds them with their bearings and times of
arrival (`onset`), and `scans` makes of them what a sensing strategy hands to a filter (Bradley &
Abaid, Sec. II-D). Recorded drives take the place of all: `logs` reads this project's own folders
and `mrclam` those of UTIAS MRCLAM, their tables by way of `columns`.
"""

from importlib import import_module

_DOOR = {
    "Scan": "scans",
    "average_faces": "scans",
    "detect": "snapshots",
    "detector": "snapshots",
    "filter_blocks": "matched",
    "read_log": "logs",
    "scan_of": "scans",
    "write_log": "logs",
}


def __dir__() -> list[str]:
    return sorted([*globals(), *_DOOR])


def __getattr__(name: str) -> object:
    if name not in _DOOR:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_DOOR[name]}"), name)
