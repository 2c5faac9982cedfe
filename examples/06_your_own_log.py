r"""
Your own log
============

Nobody needs the simulator who has a robot. Whoever knows roughly how a vehicle moved, and has
bearings, or bearings and ranges, of landmarks that can be told apart, has all that the filters ask
for. This drive is made up in plain NumPy, without a line of Pipistrelle, and written down as a log:
a folder of text files, as your own recorder may write it.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import pipistrelle

# %%
# A robot drives two rounds among six posts; its wheels do not quite do as they are told. It sees
# posts up to 60° off its heading: how far away they are only up to 4 m, else their bearing alone,
# and the field of the range stays empty. Places are complex numbers here.

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
# Three files make a log. Two more hold the truth, where somebody knows it: for scoring, no filter
# ever reads it. What else may stand there, and poses as odometry, :doc:`/log_format` says.

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
# On a command line it is ``pipistrelle slam FOLDER``. What comes back is what a mission gives, and
# what :doc:`03_one_mission` said of it holds. How far off are the posts on the map?

answer = done.summary["map_rmse_m"][0]
print(f"{answer:.3f} m, {done.summary['landmarks_full'][0]} posts")

# %%
# So a drive is at hand, simulated or recorded. :doc:`07_your_own_filter` maps it by other means.
