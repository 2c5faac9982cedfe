r"""
One frame: from samples to detections
=====================================

Every half second the vehicle and the beacon call at once, and forty microphones record what comes
back. Here is one such frame, sample by sample: what arrives, what a microphone hears of it, and
what the detector makes of that.
"""

import matplotlib.pyplot as plt
import numpy as np

from pipistrelle.acoustics.arrivals import arrivals_of_emission, through_piston
from pipistrelle.acoustics.callers import callers_of
from pipistrelle.arrays.layout import square_of_four
from pipistrelle.arrays.receiver import record_samples
from pipistrelle.arrays.sampling import BLOCK, blocks_to_hear, sampling
from pipistrelle.config import Config
from pipistrelle.detection.matched import filter_samples
from pipistrelle.detection.snapshots import detect, detector

config = Config()
speed_of_sound = config.air.celerity

# %%
# The world: the vehicle at the origin, heading along x, three landmarks and the beacon. An
# *arrival* is one sound on one path: the echo of the vehicle's own call (35 kHz), or the beacon's
# call (30 kHz), straight or by way of a landmark. Landmark 3 is behind the vehicle, which calls
# forward only: of that one it hears nothing but the beacon's echo.

pose, velocity = np.zeros(3), np.array([0.75, 0.0])
landmarks, beacon = np.array([[6.0, 1.5], [4.0, -1.0], [-5.0, 3.0]]), np.array([9.0, 10.0])
callers = callers_of(config, beacon)
arrivals = through_piston(
    arrivals_of_emission(pose, velocity, landmarks, callers, config),
    radius=config.emitter.radius,
    frequency=config.emitter.frequency,
    speed_of_sound=speed_of_sound,
)
for i in np.argsort(arrivals.delay):
    print(
        f"{'passive' if arrivals.caller[i] else 'active':<8} landmark {arrivals.landmark[i]}: "
        f"{1e3 * arrivals.delay[i]:5.1f} ms, {np.degrees(arrivals.bearing[i]):6.1f}°, "
        f"{arrivals.level_db[i]:6.1f} dB"
    )

# %%
# Four arrays of ten microphones record at 200 kHz. A matched filter per tone gathers each call
# into one peak, and the energy over the ten microphones of a face is compared with a threshold
# that noise alone passes once in a million tests.

layout, settled = square_of_four(config.receiver), sampling(config, callers)
rng = np.random.default_rng(config.seed)
samples = record_samples(blocks_to_hear(arrivals, settled), arrivals, layout, settled, rng)
length = settled.pulse * settled.block
matched = filter_samples(
    samples,
    tones=settled.tones,
    rate=settled.rate,
    length=length,
    noise_std=settled.noise_std,
)
finder = detector(config, layout, settled.tones)
start = settled.pulse * BLOCK
found = detect(matched, finder, start=start, interval=1.0 / settled.rate, pulse=length)

# %%
# The front face. Above, what one microphone hears; most echoes are below its noise. Below, the
# energy of both tones after the matched filter; dots are detections. Where a call of one tone
# begins and ends it leaks into the other, 33 dB weaker but above the threshold: the detector must
# know.

front = found.face == 0
names, colours = ("own, 35 kHz", "beacon's, 30 kHz"), ("#1f4e96", "#d99a00")
figure, (above, below) = plt.subplots(2, sharex=True, figsize=(8.0, 5.0), layout="constrained")
heard_at = 1e3 * (start + np.arange(len(samples)) / settled.rate)
above.plot(heard_at, samples[:, 0, 0].real, color="grey", lw=0.3)
above.set_ylabel("one microphone")
energy = np.sum(np.abs(matched[:, 0]) ** 2, axis=-1)
lag = 1e3 * (start + np.arange(len(matched)) / settled.rate)
for tone in (0, 1):
    here = front & (found.caller == tone)
    below.semilogy(lag, energy[:, tone], color=colours[tone], lw=0.8, label=names[tone])
    below.plot(1e3 * found.delay[here], found.power[here], "o", color=colours[tone])
below.axhline(finder.threshold, color="black", ls=":", lw=1.0, label="threshold")
below.set(xlabel="time since the calls [ms]", ylabel="energy of ten", ylim=(1.0, None))
figure.legend(loc="outside upper center", ncols=3)
plt.show()

# %%
# Each detection has a bearing and, where the vehicle itself called, a range: half the way that
# sound goes in its delay. Landmark 1 stands 6.18 m away. How far off is its range?

own = found.caller == 0
ranges = 0.5 * speed_of_sound * found.delay[own]
true = np.hypot(6.0, 1.5)
answer = float(np.min(np.abs(ranges - true)))
print(f"{100 * answer:.1f} cm")
