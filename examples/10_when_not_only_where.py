r"""
When, not only where
====================

Someone else's echo tells a bearing and no range, for nobody knows when he called. But his call also
comes straight, before all its echoes, and how much later an echo is tells how much longer its way
was: a *detour*. No clock is asked.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.ekf.invariant import InvariantEkfSlam
from pipistrelle.estimation.measurement import detour_of
from pipistrelle.estimation.motion import Motion
from pipistrelle.figures.outlines import RAY, detour_ellipse, ellipses
from pipistrelle.figures.style import INK, STRATEGY_COLOURS, STYLE
from pipistrelle.geometry import range_and_bearing

# %%
# The vehicle stands at the origin. It has placed two callers, labels 1 and 2, to some decimetres,
# and hears of landmark 3 for the first time, by an echo of each of their calls.

vehicle = np.zeros(3)
callers, landmark = np.array([[8.0, 1.0], [-3.0, 6.0]]), np.array([4.0, 7.0])
motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
slam = InvariantEkfSlam(motion=motion, rays=RayConfig())
start = slam.init(Gaussian(mean=vehicle, covariance=np.diag([0.05, 0.05, 0.02]) ** 2))
ranges, bearings = range_and_bearing(vehicle, callers)
stds = {"range_std": 0.2, "bearing_std": 0.05, "detour_std": 0.05}
known = slam.update(start, make_scan(0.0, np.array([1, 2]), bearings, range=ranges, **stds))

# %%
# A bearing alone makes a ray: members, any of which may be the landmark. The first detour, e, draws
# an ellipse about the vehicle and the caller. It crosses the bearing in one place: there the
# landmark is, as surely as the caller is. The ellipse of the second caller crosses there, too.

detours = np.array([detour_of(vehicle[:2], landmark, caller) for caller in callers])
_, bearing = range_and_bearing(vehicle, landmark[None])
labels = np.array([-1, 1, 2])  # of the vehicle, and of the callers by their numbers
heard = {"a bearing alone: a ray": 0, "one detour: an ellipse": 1, "two detours": 2}
beliefs = []
for count in heard.values():
    rows = max(count, 1)  # a further detour is a row without a bearing
    said = np.where(np.arange(2) < count, detours, np.nan)[:rows]
    whence = np.array([bearing[0], np.nan])[:rows]
    who = {"caller": np.array([1, 2])[:rows], "detour": said}
    scan = make_scan(0.5, np.full(rows, 3), whence, **who, **stds)
    beliefs.append(slam.update(known, replace(scan, callers=labels)))

# %%
# Dotted: the bearing. Outlines: one standard deviation of each member.

plt.rcParams.update(STYLE)
figure, panels = plt.subplots(1, 3, figsize=(8.0, 3.1), layout="constrained", sharey=True)
colour = STRATEGY_COLOURS["passive"]
for axes, (title, count), belief in zip(panels, heard.items(), beliefs, strict=True):
    mapped = belief.landmarks()
    for outline in ellipses(mapped.mean, mapped.covariance, RAY):
        axes.plot(*outline.T, color=colour, lw=1.0)
    for caller, detour in zip(callers[:count], detours, strict=False):
        axes.plot(*detour_ellipse(vehicle[:2], caller, detour).T, color=INK, lw=0.8, ls="--")
    axes.plot(*np.outer([0.0, 3.0], landmark).T, color=colour, lw=0.8, ls=":")
    axes.plot(*callers.T, "*", color=INK, ms=8)
    axes.plot(0.0, 0.0, ">", color=INK, ms=7)
    axes.plot(*landmark, "o", mfc="none", mec="black", ms=8)
    axes.set(title=title, xlim=(-10.0, 13.0), ylim=(-8.0, 15.0), aspect="equal", xlabel="x [m]")
panels[0].set_ylabel("y [m]")
plt.show()

# %%
# How surely is the landmark's place known, with two detours?

mapped = beliefs[-1].landmarks()
spread = mapped.covariance[mapped.landmark == 3][0]
answer = float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))
print(f"{answer:.2f} m")
