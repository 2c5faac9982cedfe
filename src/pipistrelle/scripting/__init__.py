"""The Python interface: `run`, `hear`, `look`, `slam`, `study`, `load`, and their results.

The command line (`verbs`) takes its options and their help from these functions. `arguments`
resolves settings and names, `missions` conducts missions, `log_warnings` checks logs, `live` is a
vehicle that drives now and `saved_state` its file.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "hearing": ["Heard", "hear"],
        "results": ["Results", "load", "run", "slam"],
        "studies": ["StudyResults", "study"],
    },
)
