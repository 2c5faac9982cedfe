r"""
Your own filter
===============

What is a range worth, and what is the sonar worth at all? A filter without it shows this. An
estimator has three methods: ``init`` takes the start, ``predict`` the controls of a frame,
``update`` the scan. Each returns a new belief. Such a class runs in missions, on logs and in
studies.
"""

from dataclasses import dataclass

import numpy as np

import pipistrelle
from pipistrelle.detection.scans import with_columns
from pipistrelle.estimation.ekf.filter import EkfSlam

# %%
# The EKF's first two methods serve both new filters. *Dead reckoning* ignores all scans: every
# filter should be better. The other uses bearings and ignores ranges.


@dataclass(frozen=True, slots=True, kw_only=True)
class DeadReckoning(EkfSlam):
    def update(self, belief, scan, rng=None):
        return belief


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingsOnly(EkfSlam):
    def update(self, belief, scan, rng=None):
        return EkfSlam.update(self, belief, with_columns(scan, range=np.nan), rng)


# %%
# With the EKF they map the world of :doc:`03_one_mission` from the same recording.

filters = ["ekf", BearingsOnly, DeadReckoning]
asked = {"settings": "paper", "seed": 7, "strategies": "active", "duration": 62.5}
done = pipistrelle.run(filters=filters, **asked)
figure = done.figure()

# %%
# Ranges determine the scale of the map. Without them it drifts, most posts remain rays, and
# placed ones have large errors, because bearings of a narrow beam hardly cross. Dead reckoning
# has the largest errors, and they are within their band.
#
# What is the ratio of its error to that of the EKF?

error = dict(done.summary.select("filter", "position_rmse_m").iter_rows())
for name, value in error.items():
    print(f"{name:<24} {value:.2f} m")
answer = error["__main__:DeadReckoning"] / error["ekf"]
print(f"{answer:.1f} times")

# %%
# A class in ``mine.py`` has the name ``mine:DeadReckoning`` on the command line and in plans. See
# :doc:`/extending` for the interface, and for the other parts that can be replaced.
#
# A single world is an anecdote: :doc:`08_your_own_study`.
