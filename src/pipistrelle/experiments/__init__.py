"""Missions and logs on trial: worlds drawn, heard, mapped, scored and kept.

`trial` is the file to read first: a mission on one screen (Bradley & Abaid, Sec. IV). `scenario`
draws its world, `listening` hears it, and `association` labels what was heard, the one place where
the truth does so. `replay` puts a recorded log to the same filters; `results`, with `tables` and
`folder`, scores and keeps what came of either.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "association": ["label_detections"],
        "listening": ["listen"],
        "replay": ["load"],
        "results": ["write_results"],
        "scenario": ["draw_scenario"],
        "trial": ["run_filter", "run_mission", "run_trial"],
    },
)
