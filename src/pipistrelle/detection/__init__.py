"""Samples, or a recorded log, to scans; the truth is never seen.

`front_end` finds calls and averages faces: `matched` filters a recording for calls and finds times
of arrival, `snapshots` finds bearings on faces, `beams` with microphones anywhere and of sweeps;
`overlaps` resolves several echoes at once, and `direct` finds the direct calls of other
callers. `noise` states standard deviations, and `scans` holds the measurements that an estimator
receives (Bradley & Abaid, Sec. II-D). Recorded drives take the place of all: `logs`, `sounds`.
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
