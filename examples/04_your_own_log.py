r"""
Your own log
============

The filters run on any drive whose vehicle knows roughly how it moves and measures bearings, or
bearings and ranges, of landmarks that it can tell apart. This example makes such a drive up,
writes it down as a log folder, reads it back and solves it. For a real one, write the same files
by any means; :doc:`/log_format` says what they hold.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from pipistrelle.config import Config
from pipistrelle.detection.logs.folder import write_log
from pipistrelle.detection.logs.recording import Log
from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.experiments.drives import Truth
from pipistrelle.experiments.runs.replay import load, replay
from pipistrelle.experiments.runs.truth_files import write_truth
from pipistrelle.figures.mission import draw_mission
from pipistrelle.geometry import range_and_bearing

# %%
# A robot drives two rounds among six posts, with noise on its speed and its turning rate. It sees
# posts up to 60° off its heading: how far away they are only up to 4 m, else their bearing alone.

rng = np.random.default_rng(7)
posts = np.array([[4.0, 0.0], [6.0, 5.0], [1.0, 7.0], [-3.0, 5.0], [-4.0, 1.0], [0.0, -2.0]])
labels = np.arange(1, 7)
motion = Motion(model="unicycle", control_std=(0.05, 0.05))
time = 0.1 * np.arange(601)
controls = np.tile([0.6, 0.21], (600, 1))

path = np.zeros((601, 3))
for k, noise in enumerate(rng.normal(0.0, motion.control_std, (600, 2))):
    path[k + 1] = motion_step(motion, path[k], controls[k] + noise, 0.1)

scans = []
for k in range(5, 601, 5):
    distance, bearing = range_and_bearing(path[k], posts)
    seen = np.abs(bearing) < np.radians(60.0)
    distance, bearing = distance + rng.normal(0.0, 0.1, 6), bearing + rng.normal(0.0, 0.03, 6)
    distance = np.where(distance < 4.0, distance, np.nan)
    scans.append(make_scan(time[k], labels[seen], bearing[seen], range=distance[seen]))

# %%
# Written as a log, it is a folder of plain text files. The truth lies beside it, for scoring: no
# filter ever reads it.

log = Log(
    name="posts",
    time=time,
    controls=controls,
    dt=np.diff(time),
    scans=tuple(scans),
    motion="unicycle",
    control_std=motion.control_std,
    initial_pose=(0.0, 0.0, 0.0),
    initial_pose_std=(0.01, 0.01, 0.01),
    range_std=0.1,
    bearing_std=0.03,
    range_bounds=(0.5, 12.0),
    ignored_rows={},
)
with TemporaryDirectory() as place:
    folder = Path(place) / "posts"
    write_log(folder, log)
    write_truth(folder, Truth(time=time, path=path, landmarks=(labels, posts)))
    for file in sorted(folder.iterdir()):
        print(file.name)
    print()
    print("".join((folder / "measurements.csv").read_text().splitlines(keepends=True)[:4]))
    log, truth = load(folder)

# %%
# On the command line the rest is ``pipistrelle slam posts``.

(trial,) = replay(log, truth, ["fused"], ["ekf"], None, Config())
figure = draw_mission([trial], truth=truth)

# %%
# How far off are the posts on the map?

answer = trial.scores.map_rmse_m
print(f"{answer:.3f} m, of {trial.scores.landmarks_full} posts")
