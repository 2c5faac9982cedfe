"""Samples, or a recorded log, to scans; the truth is never seen.

`matched` filters a recording for calls, `snapshots` finds them with their bearings and times of
arrival (`onset`), `merging` averages what faces and tones say of one landmark, and `scans` are what
a filter is handed (Bradley & Abaid, Sec. II-D). Recorded drives take the place of all: `logs`.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "logs.folder": ["read_log", "write_log"],
        "matched": ["filter_blocks"],
        "merging": ["average_faces", "scan_of"],
        "scans": ["Scan"],
        "snapshots": ["detect", "detector"],
    },
)
