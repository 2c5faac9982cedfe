"""Samples, or a recorded log, to scans; the truth is never seen.

`matched` filters a recording for calls, `snapshots` finds them where they are loudest (`loudness`)
with their bearings, one by one or several at once (`overlaps`), and times of arrival (`onset`),
`faces` and `merging` average what faces and tones say of one landmark, `noise` states how surely,
and `scans` are what a filter is handed (Bradley & Abaid, Sec. II-D). Recorded drives take the place
of all: `logs`.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "front_end": ["average_faces"],
        "logs.folder": ["read_log", "write_log"],
        "matched": ["filter_blocks"],
        "scans": ["scan_of", "Scan"],
        "snapshots": ["detect", "detector"],
    },
)
