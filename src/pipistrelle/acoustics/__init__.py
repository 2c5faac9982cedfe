"""How a call leaves, spreads, fades and comes back (Bradley & Abaid, Secs. II-A and II-B).

`call`: waveforms; `emitter`: the vehicle's directivity and the target strength of landmarks;
`propagation`: spreading, absorption and Doppler shift; `paths`: callers and the sound paths to the
vehicle; `arrivals`: all echoes and calls of an emission, as arrays for `arrays`.
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
