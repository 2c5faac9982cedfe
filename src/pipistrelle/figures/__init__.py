"""Numbers to pictures. Nothing is computed here that a result does not already say.

`mission` draws one world as each strategy saw it, with the errors below; `animation` records what
a filter believes while it runs and plays it back. Both put together the pieces of `maps` in the
one look of `style`.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "animation": ["MissionRecorder", "animate_mission"],
        "mission": ["draw_mission"],
        "style": ["save_figure"],
    },
)
