"""Missions and logs on trial: worlds drawn, heard, mapped, scored and kept.

Read `runs.trial` first: a mission from the drawn world to its scores (Bradley & Abaid, Sec. IV).
`hearing` draws a world and simulates its scans. `drives` holds the input of an estimator and the
truth. `runs` runs estimators on a simulated mission or a recorded log, `results` scores and stores
their estimates, and `studies` repeats this in many worlds.
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
