"""Numbers to pictures. Nothing is computed here that a result does not already say.

`mission` draws one world as each strategy saw it, with the errors below; a `recorder` keeps what a
filter believes while it runs and `animation` plays it back. Both put together the pieces of `maps`
in the one look of `style`. `chart` says what a figure of a study holds, `chart_plot` prints it.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "animation": ["animate_mission"],
        "mission": ["draw_mission"],
        "recorder": ["MissionRecorder"],
        "style": ["save_figure"],
    },
)
