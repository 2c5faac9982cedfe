r"""
One mission
===========

A mission is a drive of many frames through an unknown world. The vehicle calls, measures, maps the
landmarks and estimates its own pose from the same map. What accuracy does it reach, and what is the
best possible?
"""

import pipistrelle

# %%
# A mission repeats :doc:`02_one_frame`. A world of fifty landmarks is drawn at random, and the
# vehicle drives a round among them with noise on its wheels. Its own echoes (*active* sensing)
# give ranges and bearings, and the paper's extended Kalman filter estimates trajectory and map.
# The same seed gives the same bits. The command is ``pipistrelle run --settings paper --seed 7
# --strategy active --duration 62.5``.

done = pipistrelle.run(settings="paper", seed=7, strategies="active", duration=62.5)
figure = done.figure()

# %%
# Above, the truth is grey and the estimate blue; a thin line connects each landmark to its
# estimate. Below are the errors and the band of three standard deviations. The *NEES* is the
# squared error in units of the covariance: within its band the filter is consistent.
#
# Scores, trajectories, maps and measurements are also tables:

print(done.measurements.head(3))
score = done.summary.row(0, named=True)
print(f"{score['landmarks_full']} landmarks placed, {score['map_rmse_m']:.2f} m off")
for name in ("position_rmse_m", "position_rmse_aligned_m", "nees_mean"):
    print(f"{name:<24} {score[name]:.2f}")

# %%
# The map has the right shape and is rotated as a whole: the vehicle turned before its first scan,
# and no echo of an unknown landmark measures that turn. *Aligned* errors are computed after the
# rigid motion that fits best.
#
# No other filter can avoid this error. The *bound* is the smallest error of an unbiased estimator
# with this sound on this trajectory. What is the ratio of the error to the bound?

answer = score["position_rmse_m"] / score["position_bound_m"]
print(f"{answer:.2f} times the bound of {score['position_bound_m']:.2f} m")

# %%
# The remaining gain is in the measurements, not in the filter: :doc:`04_three_strategies`.
