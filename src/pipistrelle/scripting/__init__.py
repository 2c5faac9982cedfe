"""What a person asks for, from Python: `run`, `slam`, `study`, `load`, and what comes of it.

`asking` reads the words, `missions` does what they say, `recorded` is what a log decides of it;
`results` and `studies` are what is handed back. The command line (`verbs`) asks in the same words.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "loading": ["load"],
        "results": ["Results", "run", "slam"],
        "studies": ["StudyResults", "study"],
    },
)
