r"""
Your own question
=================

A single world proves nothing: another draw can reverse the result. A study asks many worlds and
answers with intervals. The question here: how few landmarks must a world have before a vehicle
needs the calls of others?
"""

from textwrap import fill

import pipistrelle

# %%
# A *plan* is a table of settings and of lists of values to combine: three numbers of landmarks,
# two strategies and a filter are six *cases*. The cases of an iteration share the drive, with all
# its noise, and the strategies share the recording. (In a file, the same table is for
# ``pipistrelle study sparse.toml``.)

sparse = {
    "name": "sparse",
    "iterations": 12,
    "strategies": ["active", "fused"],
    "filters": ["iekf"],
    "config": {"filter": {"noise": "measured"}, "scenario": {"steps": 320}},
    "grid": {"scenario.landmarks": [5, 15, 45]},
}
tried = pipistrelle.study(sparse)
figure = tried.figure()

# %%
# Each value is compared with the sparsest in the same world. Dots are means over the worlds, bars
# their 95 % intervals, filled if the difference is significant. The first lines of the report,
# which ``tried.report()`` writes as a page, are the answer:

for line in tried.answer:
    print(fill(line, 84))

# %%
# Own echoes need landmarks. A caller is a landmark that is measured from everywhere, so fused
# sensing depends less on the number of landmarks. The report compares values of a setting; other
# comparisons use the table ``trials``, with a row for each world and case. What is the gain of
# listening with five landmarks?

few = tried.trials.filter(tried.trials["scenario.landmarks"] == 5)
error = {way: rows["position_rmse_m"] for (way,), rows in few.group_by("strategy")}
gain = error["active"] - error["fused"]
answer = gain.mean()
print(f"{answer:.2f} m, ± {gain.std() / len(gain) ** 0.5:.2f} m, in {len(gain)} worlds")

# %%
# See :doc:`/study` for other options of a plan. Twelve worlds take seconds, a thousand take
# hours: :doc:`09_on_a_cluster`.
