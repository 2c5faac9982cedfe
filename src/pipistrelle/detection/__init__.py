"""Samples, or a recorded log, to scans; the truth is never seen.

`matched` filters a recording for calls, `snapshots` finds them with their bearings and times of
arrival (`onset`), and `scans` makes of them what a sensing strategy hands to a filter (Bradley &
Abaid, Sec. II-D). Recorded drives take the place of all: `logs` reads this project's own folders
and `mrclam` those of UTIAS MRCLAM, their tables by way of `columns`.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "logs": ["read_log", "write_log"],
        "matched": ["filter_blocks"],
        "scans": ["Scan", "average_faces", "scan_of"],
        "snapshots": ["detect", "detector"],
    },
)
