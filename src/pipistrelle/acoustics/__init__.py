"""How a call leaves, spreads, fades and comes back (Bradley & Abaid, Secs. II-A and II-B).

`emitter` shapes the vehicle's call by the aperture that sends it; `propagation` takes from it what
distance and air take, and shifts its tone by the motion; `target` says how much of it a landmark
throws in each direction. `arrivals` puts the three together: every echo and call that one emission
of vehicle and beacon brings to the vehicle, as plain arrays for the ears of `arrays`.
"""

from importlib import import_module

_DOOR = {
    "Arrivals": "arrivals",
    "absorption_db_per_m": "propagation",
    "arrivals_of_emission": "arrivals",
    "beamwidth": "emitter",
    "piston_directivity": "emitter",
    "piston_radius": "emitter",
    "target_strength_db": "target",
    "through_piston": "arrivals",
}


def __dir__() -> list[str]:
    return sorted([*globals(), *_DOOR])


def __getattr__(name: str) -> object:
    if name not in _DOOR:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_DOOR[name]}"), name)
