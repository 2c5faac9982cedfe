r"""
Three strategies
================

The vehicle calls ahead only, and hears what stands in its beam. But it is not alone: a beacon
calls, too, from where it stands, and its sound comes back from every post around. What does the
vehicle know that listens to someone else's calls as well as its own?
"""

import pipistrelle

# %%
# *Active* sensing is that of :doc:`03_one_mission`: its own echoes, range and bearing. *Passive*
# sensing takes the beacon's calls and their echoes, bearings alone, for nobody tells it when or
# where the beacon called. *Fused* sensing takes both. One world, one drive, one recording: what
# differs is what is made of it.

done = pipistrelle.run(settings="paper", seed=7, duration=62.5)
figure = done.figure()

# %%
# A landmark that was only ever heard passively is a *ray*, drawn as the row of Gaussians that it
# is: somewhere along there. When the vehicle has moved, other bearings cross it, and one of the row
# is left. The beam is drawn as a wedge, the beacon as a star.

for score in done.summary.iter_rows(named=True):
    print(
        f"{score['strategy']:<8}"
        f"{score['measurements_per_frame']:5.1f} measurements a frame, "
        f"{score['landmarks_full']} landmarks placed, "
        f"position {score['position_rmse_m']:.2f} m off"
    )

# %%
# Six times as many measurements, a fuller map, and yet, in this world, no better track: a bearing
# says less than a range, and this filter trusts bearings too much. Without ``settings="paper"`` the
# one that serves best is taken, :doc:`/estimators` says why. Whether listening makes a *better* map
# is no question for one world; :doc:`08_your_own_study` asks several.
#
# How many landmarks has the fused vehicle heard of that its own calls never found?

heard = done.landmarks.drop_nulls("x_m")
known = {way: set(rows["landmark"]) for (way,), rows in heard.group_by("strategy")}
answer = len(known["fused"] - known["active"])
print(answer)

# %%
# Chance has placed these landmarks. In :doc:`05_your_own_world` you do.
