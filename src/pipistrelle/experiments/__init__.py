"""Missions and logs on trial: worlds drawn, heard, mapped, scored and kept.

`runs.trial` is the file to read first: a mission on one screen (Bradley & Abaid, Sec. IV).
`hearing` draws its world and hears it; a drive (`drives`) is what a filter is given; `runs` puts
it, or a recorded log, to the filters; `results` scores and keeps what came of it; `studies` does
so in many worlds.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "hearing.listening": ["listen"],
        "hearing.oracle": ["label_detections"],
        "hearing.scenario": ["draw_scenario"],
        "results.writing": ["write_results"],
        "runs.replay": ["load"],
        "runs.trial": ["run_filter", "run_mission", "run_trial"],
    },
)
