r"""
A piston's beam
===============

The vehicle calls through a round opening, a piston. The wider the piston is, measured in waves,
the narrower its beam. The paper names its twelve emitters by their half-power beamwidth: the full
angle within which more than half of the power on the axis is sent.

Nothing is sent backwards: the piston has a baffle behind it.
"""

import matplotlib.pyplot as plt
import numpy as np

from pipistrelle.acoustics.emitter import beamwidth, piston_directivity, piston_radius

call = {"frequency": 35e3, "speed_of_sound": 343.0}

# %%
# Three of the paper's pistons, in power relative to the axis. The dotted circle is half power:
# a beam is as wide as its arc on it.

angle = np.radians(np.linspace(-180.0, 180.0, 1441))
figure, axes = plt.subplots(figsize=(6.0, 4.6), subplot_kw={"projection": "polar"})
for radius in (2.5e-3, 8.8e-3, 25e-3):
    width = np.degrees(beamwidth(radius, **call))
    power = piston_directivity(angle, radius=radius, **call) ** 2
    axes.plot(angle, power, label=f"{1e3 * radius:.1f} mm: {width:.1f}°")
axes.plot(angle, np.full_like(angle, 0.5), ":", color="grey", lw=1.0)
axes.set_theta_zero_location("N")
axes.set_yticks([0.5, 1.0], ["½", "1"])
axes.legend(loc="lower center", title="radius: beamwidth")
plt.show()

# %%
# The way back, from a beamwidth to the piston that makes it, is how ``--beamwidth 33`` chooses a
# radius.

print(f"33° needs {1e3 * piston_radius(np.radians(33.0), **call):.2f} mm")

# %%
# The paper rounds its radii to a tenth of a millimetre. The sixth narrowest of its list:

answer = float(np.degrees(beamwidth(8.8e-3, **call)))
print(f"8.8 mm: {answer:.1f}°")
