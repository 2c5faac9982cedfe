"""The Python interface: `run`, `hear`, `slam`, `study`, `load`, and the results that they return.

`arguments` reads settings and names, `log_settings` is what a log decides of them, `missions` runs
them, `hearing` takes sound to a log, `results` and `studies` are what is returned. The command line
(`verbs`) calls the same.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "hearing": ["Heard", "hear"],
        "loading": ["load"],
        "results": ["Results", "run", "slam"],
        "studies": ["StudyResults", "study"],
    },
)
