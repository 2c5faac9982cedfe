r"""
Your own log
============

Recorded drives need no simulator. The estimators need the approximate motion of a vehicle, and
bearings, ranges or both of landmarks with labels. This drive is made in plain NumPy,
without Pipistrelle, and written as a log: a folder of text files, as your own recorder may write
it.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import pipistrelle

# %%
# A robot drives two rounds among six posts with noise on its wheels. It measures posts up to 60°
# off its heading. Ranges are measured up to 4 m; beyond that the field of the range is empty.
# Positions are complex numbers here.

rng = np.random.default_rng(7)
posts = np.array([4.0, 6.0 + 5.0j, 1.0 + 7.0j, -3.0 + 5.0j, -4.0 + 1.0j, -2.0j])
told, measured, truth = ["0.0,0.6,0.21"], [], ["0.0,0.0,0.0,0.0"]
place, heading = 0.0j, 0.0
for k in range(1, 601):
    speed, rate = rng.normal((0.6, 0.21), 0.05)
    place += 0.1 * speed * np.exp(1j * (heading + 0.05 * rate))
    heading += 0.1 * rate
    told.append(f"{0.1 * k:.1f},0.6,0.21")
    truth.append(f"{0.1 * k:.1f},{place.real},{place.imag},{heading}")
    for label, way in enumerate((posts - place) * np.exp(-1j * heading), start=1):
        if k % 5 == 0 and abs(np.angle(way)) < np.radians(60.0):
            bearing, distance = np.angle(way) + rng.normal(0.0, 0.03), abs(way)
            near = f"{distance + rng.normal(0.0, 0.1):.3f}" if distance < 4.0 else ""
            measured.append(f"{0.1 * k:.1f},{label},{bearing:.4f},{near}")

# %%
# Three files make a log. Two more contain the truth, if it is known: they are for scoring, and no
# filter reads them. See :doc:`/your_log` for poses as odometry and other options.

files = {
    "log.toml": """format = 1
motion = "unicycle"
velocity_std = 0.05
angular_rate_std = 0.05
initial_pose = [0.0, 0.0, 0.0]
initial_pose_std = [0.01, 0.01, 0.01]
range_std = 0.1
bearing_std = 0.03
range_bounds = [0.5, 12.0]""",
    "odometry.csv": "\n".join(["time,velocity,angular_rate", *told]),
    "measurements.csv": "\n".join(["time,landmark,bearing,range", *measured]),
    "truth.csv": "\n".join(["time,x,y,heading", *truth]),
    "landmarks.csv": "\n".join(
        ["landmark,x,y", *(f"{i},{z.real},{z.imag}" for i, z in enumerate(posts, 1))]
    ),
}
with TemporaryDirectory() as folder:
    for name, text in files.items():
        Path(folder, name).write_text(text + "\n")
    done = pipistrelle.slam(folder)
print("\n".join(files["measurements.csv"].splitlines()[:5]))
figure = done.figure()

# %%
# The command is ``pipistrelle slam FOLDER``. The result has the same form as that of
# :doc:`03_one_mission`. What is the error of the posts on the map?

answer = done.summary["map_rmse_m"][0]
print(f"{answer:.3f} m, {done.summary['landmarks_full'][0]} posts")

# %%
# A simulated or recorded drive can be mapped by other estimators: :doc:`07_your_own_filter`.
