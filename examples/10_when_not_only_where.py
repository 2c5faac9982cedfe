r"""
Excess paths
============

The echo of a beacon's call gives a bearing and no range, as the time of the call is unknown. But
the call also arrives directly, before its echoes. The delay of an echo after it gives the *excess
path*: how much longer the path of the echo is. No common clock is needed.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.ekf.filter import InvariantEkfSlam
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.observations.excess_path import excess_path_of
from pipistrelle.figures.maps import RAY, ellipses, excess_path_ellipse
from pipistrelle.figures.style import INK, STRATEGY_COLOURS, STYLE
from pipistrelle.geometry import range_and_bearing

# %%
# The vehicle is at the origin. It has placed two callers, labels 1 and 2, to some decimetres, and
# measures landmark 3 for the first time, by an echo of each call.

vehicle = np.zeros(3)
callers, landmark = np.array([[8.0, 1.0], [-3.0, 6.0]]), np.array([4.0, 7.0])
motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
slam = InvariantEkfSlam(motion=motion, rays=RayConfig())
start = slam.init(Gaussian(mean=vehicle, covariance=np.diag([0.05, 0.05, 0.02]) ** 2))
ranges, bearings = range_and_bearing(vehicle, callers)
stds = {"range_std": 0.2, "bearing_std": 0.05, "excess_path_std": 0.05}
known = slam.update(start, make_scan(0.0, np.array([1, 2]), bearings, range=ranges, **stds))

# %%
# A bearing without range makes a ray of hypotheses. The first excess path, e, gives an ellipse
# around vehicle and caller. It crosses the bearing at the landmark, with the uncertainty of the
# caller. The second caller's ellipse crosses there as well.

excess_paths = np.array([excess_path_of(vehicle[:2], landmark, caller) for caller in callers])
_, bearing = range_and_bearing(vehicle, landmark[None])
labels = np.array([-1, 1, 2])  # of the vehicle, and of the callers by their numbers
beliefs = []
for count in range(3):
    rows = max(count, 1)  # a further excess path is a row without a bearing
    heard = np.where(np.arange(2) < count, excess_paths, np.nan)[:rows]
    who = {"caller": np.array([1, 2])[:rows], "excess_path": heard}
    scan = make_scan(0.5, np.full(rows, 3), np.append(bearing, np.nan)[:rows], **who, **stds)
    beliefs.append(slam.update(known, replace(scan, callers=labels)))

# %%
# Left: the bearing (dotted), its ray, and the point where the ellipse crosses both. Right:
# without bearing, two ellipses cross at the landmark and at a second point, which a coarse
# bearing excludes. Faint: other positions of the callers. Dashed: the sound path.

plt.rcParams.update(STYLE)
figure, panels = plt.subplots(1, 2, figsize=(8.0, 4.2), layout="constrained", sharey=True)
colour, at = STRATEGY_COLOURS["passive"], {"textcoords": "offset points", "ha": "right"}
(ray, one), rng = [belief.landmarks() for belief in beliefs[:2]], np.random.default_rng(1)
for outline in ellipses(ray.mean, ray.covariance, RAY)[ray.landmark == 3]:
    panels[0].plot(*outline.T, color=colour, lw=1.1)
panels[0].plot(*np.outer([0.0, 2.0], landmark).T, color=colour, lw=1.1, ls=":")
panels[0].fill(*ellipses(one.mean, one.covariance, RAY)[2].T, fc=colour, ec=INK, zorder=3)
for mean, spread, path in zip(one.mean, one.covariance, excess_paths, strict=False):
    for caller in rng.multivariate_normal(mean, spread, 40):
        panels[1].plot(*excess_path_ellipse(vehicle[:2], caller, path).T, color=colour, alpha=0.1)
panels[1].plot(*landmark, "o", mfc="none", mec=INK, ms=9)
panels[1].annotate("or here", (-1.2, -4.4), (15, -16), **at)
for axes, title, count in zip(panels, ("by bearing", "by two callers"), (1, 2), strict=True):
    for k, caller in enumerate(callers[:count]):
        axes.plot(*excess_path_ellipse(vehicle[:2], caller, excess_paths[k]).T, color=INK, lw=0.9)
        axes.plot(*np.stack([caller, landmark]).T, "--", color=INK, lw=0.8)
        axes.plot(*caller, "*", color=INK, ms=11)
        axes.annotate(f"caller {k + 1}", caller, (9, -17), **at)
    axes.plot(*np.outer([0.0, 1.0], landmark).T, ">--", color=INK, lw=0.8, ms=9, markevery=[0])
    axes.annotate("vehicle", vehicle[:2], (18, -16), **at)
    axes.annotate("landmark", landmark, (56, 6), **at)
    axes.set(title=title, xlim=(-9.5, 13.0), ylim=(-7.5, 13.5), aspect="equal", xlabel="x [m]")
panels[0].set_ylabel("y [m]")
plt.show()

# %%
# What is the standard deviation of its position then? (Next: :doc:`11_without_labels`.)

spread = beliefs[-1].landmarks().covariance[2]
answer = float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))
print(f"{answer:.2f} m")
