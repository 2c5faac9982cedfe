r"""
One mission
===========

A frame is half a second. A mission is a drive of such frames through a world that the vehicle does
not know: it calls, hears, draws a map of what it hears, and tells from the same map where it is.
How well does that go, and how well could it go?
"""

import pipistrelle

# %%
# One call does over and over what :doc:`02_one_frame` did once. A world is drawn, fifty landmarks
# at random; the vehicle drives one round among them, with noise on its wheels; of each frame its
# own echoes (*active* sensing) become ranges and bearings, and an extended Kalman filter, the one
# of the paper's settings, makes a track and a map of these. The same seed gives the same bits. On a
# command line this is
# ``pipistrelle run --settings paper --seed 7 --strategy active --duration 62.5``.

done = pipistrelle.run(settings="paper", seed=7, strategies="active", duration=62.5)
figure = done.figure()

# %%
# Above, the truth is grey and the estimate blue; a thin line ties each landmark to where the filter
# has it. Below are the errors, and the band in which the filter believes them to be. The *NEES* is
# error over belief in one number: within its band, the filter knows how wrong it is.
#
# What comes back is no picture alone. Scores, tracks, maps and measurements are tables:

print(done.measurements.head(3))
score = done.summary.row(0, named=True)
print(f"{score['landmarks_full']} landmarks placed, {score['map_rmse_m']:.2f} m off")
for name in ("position_rmse_m", "position_rmse_aligned_m", "nees_mean"):
    print(f"{name:<24} {score[name]:.2f}")

# %%
# The map is the right shape and turned as a whole: before its first scan the vehicle has already
# turned unseen, and no echo of an unknown post can tell it. *Aligned* errors are those after the
# rigid motion that fits best.
#
# Nor can any other filter tell. The *bound* is the least error that an estimator without bias can
# have with this sound on this path. How far above it is ours?

answer = score["position_rmse_m"] / score["position_bound_m"]
print(f"{answer:.2f} times the bound of {score['position_bound_m']:.2f} m")

# %%
# So what is left to gain lies less in the filter than in the ears: :doc:`04_three_strategies`.
