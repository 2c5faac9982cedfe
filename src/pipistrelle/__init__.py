"""Sonar SLAM with the calls of a vehicle, of other emitters, or both: from waveform to scores.

>>> import pipistrelle
>>> done = pipistrelle.run(seed=7, duration=4.0, strategies="fused")
>>> done.summary["landmarks_full"].item() > 0
True
"""

__version__: str
__all__ = ["Config", "InputError", "Slam", "hear", "load", "look", "run", "slam", "study"]
_ROOMS = {
    "Config": "config",
    "InputError": "config",
    "Slam": "scripting.live",
    "hear": "scripting.hearing",
    "load": "scripting.results",
    "look": "scripting.hearing",
    "run": "scripting.results",
    "slam": "scripting.results",
    "study": "scripting.studies",
}


def __getattr__(name: str) -> object:
    """Import the module of a public name on first access, and return the object of that name."""
    from importlib import import_module

    if name == "__version__":
        return import_module("pipistrelle.version").find_version()
    if name in _ROOMS:
        return getattr(import_module(f"pipistrelle.{_ROOMS[name]}"), name)
    raise AttributeError(f"module 'pipistrelle' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the package's public names, for `dir`."""
    return [*__all__, "__version__"]
