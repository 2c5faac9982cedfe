"""Numbers to pictures. Nothing is computed here that a result does not already say.

`mission` draws one world as each strategy saw it, with the errors below; `animation` records what
a filter believes while it runs and plays it back. Both put together the pieces of `maps` in the
one look of `style`.
"""

from importlib import import_module

_DOOR = {
    "MissionRecorder": "animation",
    "animate_mission": "animation",
    "draw_mission": "mission",
    "save_figure": "style",
}
__all__ = list(_DOOR)


def __getattr__(name: str) -> object:
    if name not in _DOOR:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_DOOR[name]}"), name)
