r"""
Three strategies
================

The vehicle calls forwards and measures landmarks in its beam. A beacon also calls, and every
landmark reflects its sound. What does the vehicle gain by listening to these calls?
"""

import pipistrelle

# %%
# *Active* sensing, as in :doc:`03_one_mission`, uses the vehicle's own echoes: range and bearing.
# *Passive* sensing uses the beacon's calls and their echoes: only bearings, as the time and
# position of the call are unknown. *Fused* sensing uses both. All three use the same world, drive
# and recording.

done = pipistrelle.run(settings="paper", seed=7, duration=62.5)
figure = done.figure()

# %%
# A landmark with passive measurements only is a *ray*, drawn as a row of Gaussians along its
# bearing. When the vehicle has moved, other bearings cross it, and a single Gaussian remains. The
# beam is a wedge, the beacon a star.

for score in done.summary.iter_rows(named=True):
    print(
        f"{score['strategy']:<8}"
        f"{score['measurements_per_frame']:5.1f} measurements a frame, "
        f"{score['landmarks_full']} landmarks placed, "
        f"position {score['position_rmse_m']:.2f} m off"
    )

# %%
# There are six times as many measurements and more landmarks, and in this world no better
# trajectory: a bearing contains less information than a range, and this filter is overconfident
# in bearings. The default settings are better, see :doc:`/choose_estimator`. A single world
# cannot answer whether listening improves a map; :doc:`08_your_own_study` uses several.
#
# How many landmarks does fused sensing have that active sensing lacks?

heard = done.landmarks.drop_nulls("x_m")
known = {way: set(rows["landmark"]) for (way,), rows in heard.group_by("strategy")}
answer = len(known["fused"] - known["active"])
print(answer)

# %%
# In :doc:`05_your_own_world` you place the landmarks.
