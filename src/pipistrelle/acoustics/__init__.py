"""How a call leaves, spreads, fades and comes back (Bradley & Abaid, Secs. II-A and II-B).

`emitter` shapes the vehicle's call by the aperture that sends it; `propagation` takes from it what
distance and air take, and shifts its tone by the motion; `target` says how much of it a landmark
throws in each direction. `callers` lists who calls: the vehicle, the beacon. `arrivals` puts all
together, over the `paths` that sound takes: every echo and call that one emission brings to the
vehicle, as plain arrays for the ears of `arrays`.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "arrivals": ["Arrivals", "arrivals_of_emission", "through_piston"],
        "emitter": ["beamwidth", "piston_directivity", "piston_radius", "target_strength_db"],
        "propagation": ["absorption_db_per_m"],
    },
)
