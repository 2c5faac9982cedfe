r"""
One echo
========

A vehicle calls, and a post reflects the sound. How can a robot detect an echo that is weaker than
the noise of its microphones? This tutorial follows a single call.
"""

import matplotlib.pyplot as plt
import numpy as np

from pipistrelle import Config
from pipistrelle.acoustics import propagation
from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.acoustics.emitter import piston_directivity
from pipistrelle.acoustics.paths import callers_of
from pipistrelle.arrays.layout import square_of_four
from pipistrelle.arrays.receiver import record_samples
from pipistrelle.arrays.sampling import blocks_to_hear, sampling
from pipistrelle.figures.style import STRATEGY_COLOURS, STYLE, TRUTH

config = Config()
tone, c = config.emitter.frequency, config.air.sound_speed
distance, angle, speed = 8.0, np.radians(10.0), 0.75

# %%
# A vehicle drives along x and calls through a circular piston. A post is 8 m away, 10° to the
# left. The sound spreads on both ways, the air absorbs a part of it, and the beam is weaker to
# the side. The reflection by the post is part of the call's level. 0 dB is the noise of a sample.
# The echo is below it.

piston = {"radius": config.emitter.radius, "frequency": tone, "speed_of_sound": c}
air = config.air.model_dump(exclude={"speed_of_sound", "spreading"})
account = {
    "call": config.emitter.level_db,
    "spreading": -propagation.spreading_loss_db(2.0 * distance, ways=2),
    "absorption": -propagation.absorption_db_per_m(tone, **air) * 2.0 * distance,
    "beam": 20.0 * np.log10(piston_directivity(angle, **piston)),
}
closing = dict.fromkeys(("receiver_speed", "source_speed"), speed * np.cos(angle))
heard_tone = propagation.doppler_frequency(tone, **closing, speed_of_sound=c)
delay, level_db = 2.0 * distance / c, sum(account.values())
print(*(f"{name} {part:.1f} dB" for name, part in account.items()), sep=", ")
print(f"after {1e3 * delay:.1f} ms, {heard_tone - tone:+.0f} Hz: {level_db:.1f} dB")

# %%
# The *matched filter* correlates the samples with the call. It adds the 560 samples of the call's
# 2.8 ms in phase, so the echo grows and the noise hardly does: a gain of 10 log₁₀ 560 = 27.5 dB.
# The Doppler shift of the echo costs 2.7 dB of it.

echo = Arrivals(
    delay=np.array([delay]),
    level_db=np.array([level_db]),
    bearing=np.array([angle]),
    frequency=np.array([heard_tone]),
    caller=np.array([0], dtype=np.int8),
    landmark=np.array([1]),
)
vehicle, _ = callers_of(config, np.zeros(2))
settled, rng = sampling(config, [vehicle]), np.random.default_rng(7)
blocks, layout = blocks_to_hear(echo, settled) + 30, square_of_four(config.receiver)
samples = record_samples(blocks, echo, layout, settled)
samples += rng.normal(scale=0.5**0.5, size=(*samples.shape, 2)) @ (1.0, 1.0j)
length, rate = settled.pulse * settled.block, settled.rate
called = settled.calls[0].waveform(np.arange(length) / rate, tone)
matched = np.correlate(samples[:, 0, 0], called) / np.sqrt(length)
heard = {"microphone": samples[:, 0, 0], "matched filter": matched}

plt.rcParams.update(STYLE)
figure, (beam, *axes) = plt.subplots(3, figsize=(7.0, 5.0), layout="constrained")
side, blue = np.linspace(-90.0, 90.0, 361), STRATEGY_COLOURS["active"]
beam.plot(side, piston_directivity(np.radians(side), **piston) ** 2, color=blue)
beam.plot(10.0, piston_directivity(angle, **piston) ** 2, "o", color=blue)
beam.set(xlabel="angle off the axis [°]; dot: the post", ylabel="power sent", ylim=0.0)
for panel, (name, signal) in zip(axes, heard.items(), strict=True):
    time = 1e3 * (length + np.arange(signal.size)) / rate
    panel.plot(time, np.abs(signal), color=blue, lw=0.5)
    panel.axvline(1e3 * delay, color=TRUTH, ls=":", zorder=0)
    panel.set(ylabel=name, xlim=(0.0, 52.0), ylim=(0.0, None))
panel.set_xlabel("time since the call [ms]; dotted: the echo begins")
plt.show()

# %%
# What is the level of the peak over the noise?

answer = float(20.0 * np.log10(np.abs(heard["matched filter"]).max()))
print(f"{answer:.1f} dB")

# %%
# A microphone gives the distance of the post, not its direction. :doc:`02_one_frame` uses forty.
