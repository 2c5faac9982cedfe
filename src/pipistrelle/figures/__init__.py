"""Figures and films of results.

`mission` draws the maps of a world and the errors below; `recorder` keeps the beliefs of a
running estimator and `film` plays them. Both are built of `maps` in the style of `style`. `chart`
holds and draws the figures of a study, `player` makes the page of a mission.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "film": ["animate_mission"],
        "mission": ["draw_mission"],
        "recorder": ["MissionRecorder"],
        "style": ["save_figure"],
    },
)
