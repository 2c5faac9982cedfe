r"""
One echo
========

A bat calls into the dark, and a twig answers. How does a robot hear an answer that is weaker than
the hiss of its own microphones? All else on this ladder stands on one call, one post and one echo.
"""

import matplotlib.pyplot as plt
import numpy as np

from pipistrelle import Config
from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.acoustics.callers import callers_of
from pipistrelle.acoustics.emitter import beamwidth_of, piston_directivity
from pipistrelle.acoustics.propagation import (
    absorption_db_per_m,
    doppler_frequency,
    spreading_loss_db,
)
from pipistrelle.arrays.layout import square_of_four
from pipistrelle.arrays.receiver import record_samples
from pipistrelle.arrays.sampling import blocks_to_hear, sampling
from pipistrelle.detection.matched import filter_samples
from pipistrelle.figures.style import STRATEGY_COLOURS, STYLE, TRUTH

config = Config()
call, c = config.emitter, config.air.celerity
distance, angle, speed = 8.0, np.radians(10.0), 0.75

# %%
# A vehicle drives along x and calls through a round opening, a piston. A post stands 8 m off, 10°
# to the left. Sound spreads on its way there and again on its way back, the air swallows a share
# of every metre, and the beam sends less to the side than ahead. What the post throws back is
# counted in the call's level; 0 dB is the noise in a sample of a microphone. The echo is below it.

piston = {"radius": call.radius, "frequency": call.frequency, "speed_of_sound": c}
moist = config.air.model_dump(include={"temperature_c", "relative_humidity", "pressure_kpa"})
account = {
    "call": call.level_db,
    "spreading": -float(spreading_loss_db(2.0 * distance, ways=2)),
    "absorption": -2.0 * distance * float(absorption_db_per_m(call.frequency, **moist)),
    "beam": 20.0 * np.log10(float(piston_directivity(angle, **piston))),
}
print(*(f"{name} {level_db:.1f} dB" for name, level_db in account.items()), sep=", ")

closing = {"receiver_speed": speed * np.cos(angle), "source_speed": speed * np.cos(angle)}
echo = Arrivals(
    delay=np.array([2.0 * distance / c]),
    level_db=np.array([sum(account.values())]),
    bearing=np.array([angle]),
    frequency=np.array([doppler_frequency(call.frequency, **closing, speed_of_sound=c)]),
    caller=np.array([0], dtype=np.int8),
    landmark=np.array([1]),
)
shift = echo.frequency[0] - call.frequency
print(f"after {1e3 * echo.delay[0]:.1f} ms, {shift:.0f} Hz too high: {echo.level_db[0]:.1f} dB")

# %%
# The *matched filter* knows what was called. It adds the 560 samples of a call's 2.8 ms up, each
# turned as the call was; the echo grows, noise hardly does. That gains 10 log 560 = 27.5 dB. Who
# drives towards an echo hears it higher than it was called, and loses some of that: here 2.7 dB.

vehicle, _ = callers_of(config, np.zeros(2))
settled, rng = sampling(config, [vehicle]), np.random.default_rng(config.seed)
blocks = blocks_to_hear(echo, settled) + 30
samples = record_samples(blocks, echo, square_of_four(config.receiver), settled, rng)
length, rate = settled.pulse * settled.block, settled.rate
replica = {"tones": settled.tones, "rate": rate, "length": length, "noise_std": settled.noise_std}
matched = filter_samples(samples, **replica)
heard = {"microphone": samples[:, 0, 0], "matched filter": matched[:, 0, 0, 0]}

plt.rcParams.update(STYLE)
panels = {"beam": {"projection": "polar"}}, [["beam", "microphone"], ["beam", "matched filter"]]
figure, at = plt.subplot_mosaic(
    panels[1], per_subplot_kw=panels[0], width_ratios=(1, 2), figsize=(8, 3.2), layout="constrained"
)
side, blue = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 361), STRATEGY_COLOURS["active"]
at["beam"].plot(side, piston_directivity(side, **piston) ** 2, color=blue)
at["beam"].plot(angle, piston_directivity(angle, **piston) ** 2, "o", color=blue)
at["beam"].set(theta_zero_location="N", thetamin=-90, thetamax=90, yticks=[0.5, 1.0])
at["beam"].set_xlabel(f"power sent, {np.degrees(beamwidth_of(config)):.0f}° wide; dot: the post")
for name, signal in heard.items():
    time = 1e3 * (length + np.arange(signal.size)) / rate
    at[name].plot(time, np.abs(signal), color=blue, lw=0.5)
    at[name].axvline(1e3 * echo.delay[0], color=TRUTH, ls=":", zorder=0)
    at[name].set(ylabel=name, xlim=(0.0, 52.0), ylim=(0.0, None))
at[name].set_xlabel("time since the call [ms]; dotted: the echo begins")
plt.show()

# %%
# How high does the peak stand above the noise?

answer = float(20.0 * np.log10(np.abs(heard["matched filter"]).max()))
print(f"{answer:.1f} dB")

# %%
# One microphone knows how far away the post is, not where. :doc:`02_one_frame` asks forty.
