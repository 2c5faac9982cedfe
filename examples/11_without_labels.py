r"""
A log without labels
====================

A lidar or a radar detects posts without identifying them, and some rows belong to no post. This
simulated drive is like that of :doc:`06_your_own_log` without the labels. An association decides
which landmark each row belongs to.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

import pipistrelle
from pipistrelle.evaluation.association import gospa

# %%
# A robot drives two rounds among twelve posts. Its lidar is 0.3 m ahead of the axle and detects
# posts nearer than 6 m, within 80° to either side. It misses a tenth of them, and each scan has a
# row of clutter on average. The field of the label is empty. Positions are complex numbers here.

rng = np.random.default_rng(7)
posts = rng.uniform(-7.0, 8.0, 12) + 1j * rng.uniform(-5.0, 10.0, 12)
told, measured, place, heading = ["0.0,0.6,0.21"], [], 0.0j, 0.0
for k in range(1, 601):
    speed, rate = rng.normal((0.6, 0.21), 0.05)
    place += 0.1 * speed * np.exp(1j * (heading + 0.05 * rate))
    heading += 0.1 * rate
    told.append(f"{0.1 * k:.1f},0.6,0.21")
    ways = (posts - place) * np.exp(-1j * heading) - 0.3
    bearing, far = np.angle(ways), np.abs(ways)
    seen = (far < 6.0) & (np.abs(bearing) < np.radians(80.0)) & (rng.random(12) < 0.9)
    rows = [*zip(bearing[seen], far[seen], strict=True)]
    rows += [(rng.uniform(-1.4, 1.4), rng.uniform(0.5, 6.0)) for _ in range(rng.poisson(1.0))]
    if k % 5 == 0:
        for angle, distance in rng.normal(rows, (0.02, 0.05)).reshape(-1, 2):
            measured.append(f"{0.1 * k:.1f},,{angle:.4f},{max(distance, 0.1):.3f}")

# %%
# ``log.toml`` describes the lidar (:doc:`/log_format`).

files = {
    "log.toml": """format = 1
motion = "unicycle"
velocity_std = 0.05
angular_rate_std = 0.05
initial_pose = [0.0, 0.0, 0.0]
initial_pose_std = [0.01, 0.01, 0.01]
sensor_pose = [0.3, 0.0, 0.0]
range_std = 0.05
bearing_std = 0.02
range_bounds = [0.5, 12.0]

[association]
detection_rate = 0.9
clutter_rate = 0.06""",
    "odometry.csv": "\n".join(["time,velocity,angular_rate", *told]),
    "measurements.csv": "\n".join(["time,landmark,bearing,range", *measured]),
}
with TemporaryDirectory() as folder:
    for name, text in files.items():
        Path(folder, name).write_text(text + "\n")
    done = pipistrelle.slam(folder, filters="iekf", association={"method": "marginal"})

# %%
# The command is ``pipistrelle slam FOLDER --filter iekf --association.method marginal``.
# Landmarks are numbered in the order of their first measurement.

found = np.array([*zip(done.landmarks["x_m"], done.landmarks["y_m"], strict=True)])
figure, axes = plt.subplots(figsize=(5.0, 5.0), layout="constrained")
axes.plot(posts.real, posts.imag, "o", mfc="none", ms=11, label="posts")
axes.plot(*found.T, "+", ms=9, label="the map")
axes.plot(done.tracks["x_m"], done.tracks["y_m"], lw=0.8, label="the track")
axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
axes.legend()
plt.show()

# %%
# What is the error of the posts on the map, and are any missing or false?

_, error, missed, false = gospa(found, np.column_stack((posts.real, posts.imag)), cutoff=1.0)
answer = error / np.sqrt(len(found) - false)
print(f"{answer:.3f} m, {missed} missed, {false} false")
