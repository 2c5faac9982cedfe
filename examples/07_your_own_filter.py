r"""
Your own filter
===============

What is a range worth, and what is the sonar worth at all? Ask a filter that does not use it. An
estimator has three methods: ``init`` takes the start, ``predict`` the controls of a frame,
``update`` what was heard in it. Each gives back a new belief. Whatever has the three is tried as
the package's own are: in missions, on logs, in studies.
"""

from dataclasses import dataclass

import numpy as np

import pipistrelle
from pipistrelle.detection.scans import with_columns
from pipistrelle.estimation.ekf.filter import EkfSlam

# %%
# The EKF's first two methods will do for both. *Dead reckoning* hears nothing: it is what every
# filter must beat. The other takes its bearings and forgets its ranges, as if it did not know when
# it had called.


@dataclass(frozen=True, slots=True, kw_only=True)
class DeadReckoning(EkfSlam):
    def update(self, belief, scan, rng=None):
        return belief


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingsOnly(EkfSlam):
    def update(self, belief, scan, rng=None):
        return EkfSlam.update(self, belief, with_columns(scan, range=np.nan), rng)


# %%
# Beside the EKF they map the world of :doc:`03_one_mission`, from one and the same recording.

filters = ["ekf", BearingsOnly, DeadReckoning]
asked = {"settings": "paper", "seed": 7, "strategies": "active", "duration": 62.5}
done = pipistrelle.run(filters=filters, **asked)
figure = done.figure()

# %%
# Ranges hold the size of the map; without them it drifts, most posts stay rays, and those that are
# placed are far off: bearings of a narrow beam, all ahead, hardly cross. Dead reckoning knows that
# it knows little: its errors are the largest, and within their band.
#
# How many times as far off is who does not listen?

error = dict(done.summary.select("filter", "position_rmse_m").iter_rows())
for name, value in error.items():
    print(f"{name:<24} {value:.2f} m")
answer = error["__main__:DeadReckoning"] / error["ekf"]
print(f"{answer:.1f} times")

# %%
# A class in a file of your own, ``mine.py``, goes by the name ``mine:DeadReckoning`` on the command
# line and in plans. :doc:`/extending` has the contract, and the other parts that can be replaced.
#
# One world, though, is an anecdote: :doc:`08_your_own_study`.
