r"""
One frame
=========

Every half second the vehicle and a beacon call at the same time, and forty microphones record the
echoes: a *frame*. The detector finds the caller, bearing and delay of each sound. This tutorial
computes a frame, sample by sample.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.signal import fftconvolve

from pipistrelle import Config
from pipistrelle.acoustics.arrivals import arrivals_of_emission, through_piston
from pipistrelle.acoustics.paths import callers_of
from pipistrelle.arrays.layout import square_of_four
from pipistrelle.arrays.receiver import record_samples
from pipistrelle.arrays.sampling import BLOCK, blocks_to_hear, sampling
from pipistrelle.detection.snapshots import detect, detector
from pipistrelle.figures.style import STRATEGY_COLOURS, STYLE

config = Config()
own, c = config.emitter, config.air.sound_speed

# %%
# The vehicle is at the origin and heads along x, among three landmarks and the beacon. An
# *arrival* is a sound on a single path: an echo of the vehicle's call, as in :doc:`01_one_echo`,
# or the beacon's call, direct or by way of a landmark. Landmark 3 is behind the vehicle, which
# calls forwards, so it gives only an echo of the beacon's call. Landmark 4 is the beacon itself.

pose, velocity = np.zeros(3), np.array([0.75, 0.0])
landmarks = np.array([[6.0, 1.5], [4.0, -1.0], [-5.0, 3.0]])
callers = callers_of(config, beacon=np.array([9.0, 10.0]))
arrivals = arrivals_of_emission(pose, velocity, landmarks, callers, config)
piston = {"radius": own.radius, "frequency": own.frequency, "speed_of_sound": c}
arrivals = through_piston(arrivals, **piston)
for i in np.argsort(arrivals.delay):
    print(
        f"{callers[arrivals.caller[i]].name:<7} landmark {arrivals.landmark[i]}: "
        f"{1e3 * arrivals.delay[i]:5.1f} ms, {np.degrees(arrivals.bearing[i]):6.1f}°, "
        f"{arrivals.level_db[i]:5.1f} dB"
    )

# %%
# There are four arrays of ten microphones, a face to each side. The two calls have different
# tones, so a matched filter for each separates them. Its energy over the ten microphones of a
# face is compared with a threshold that noise passes once in a million tests. Where it passes,
# the phases between the microphones give the bearing.

layout, settled = square_of_four(config.receiver), sampling(config, callers)
rng = np.random.default_rng(config.seed)
blocks = blocks_to_hear(arrivals, settled)
samples = record_samples(blocks, arrivals, layout, settled)
samples += rng.normal(scale=0.5**0.5, size=(*samples.shape, 2)) @ (1.0, 1.0j)
length, start = settled.pulse * settled.block, settled.pulse * BLOCK
sent = np.exp(2j * np.pi * np.outer(np.arange(length) / settled.rate, settled.tones))
matched = fftconvolve(samples[:, :, None], sent[::-1, None, :, None].conj(), "valid", axes=0)
matched /= np.sqrt(length)
finder = detector(config, layout, settled.tones)
found = detect(matched, finder, start=start, interval=1.0 / settled.rate, pulse=length)

# %%
# The figure shows the front face; dots are detections. At the start and end of a call its tone
# leaks into the other filter, 33 dB weaker. The detector discards this leakage.

plt.rcParams.update(STYLE)
figure, axes = plt.subplots(figsize=(8.0, 3.2), layout="constrained")
energy = np.sum(np.abs(matched[:, 0]) ** 2, axis=-1)
lag = 1e3 * (start + np.arange(len(matched)) / settled.rate)
for tone, strategy in enumerate(("active", "passive")):
    here, colour = (found.face == 0) & (found.caller == tone), STRATEGY_COLOURS[strategy]
    label = f"{callers[tone].name}, {callers[tone].frequency / 1e3:.0f} kHz"
    axes.semilogy(lag, energy[:, tone], color=colour, lw=0.8, label=label)
    axes.plot(1e3 * found.delay[here], found.power[here], "o", color=colour)
axes.axhline(finder.threshold, color="black", ls=":", lw=1.0, label="threshold")
axes.set(xlabel="time since the calls [ms]", ylabel="energy of ten microphones", ylim=1.0)
figure.legend(loc="outside upper center", ncols=3)
plt.show()

# %%
# A detection of the vehicle's own call has a range: half the distance that sound travels in its
# delay. Landmark 1 is 6.18 m away. What is the error of its range?

ranges = 0.5 * c * found.delay[found.caller == 0]
answer = float(np.min(np.abs(ranges - np.hypot(6.0, 1.5))))
print(f"{100 * answer:.1f} cm")

# %%
# The next step is a map from bearings and ranges, twice a second: :doc:`03_one_mission`.
