r"""
Your own question
=================

One world proves nothing: another draw of landmarks, and the other strategy wins. A question is put
to many worlds, and answered with error bars. Here is one: how sparse must a world be, for a vehicle
to need someone else's calls?
"""

from textwrap import fill

import pipistrelle

# %%
# A *plan* is a table of settings, and of lists of values to combine: three numbers of posts, two
# strategies, one filter, that is six *cases*. The cases of an iteration share a drive, with all
# slips of its wheels, and the strategies a recording: what differs is what is asked. (In a file,
# the same table is for ``pipistrelle study sparse.toml``.)

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
# Each value beside the sparsest, in the same world: dots are means over the worlds, bars their 95 %
# intervals, filled where the difference is significant. The first lines of the report, which
# ``tried.report()`` writes as a page, say it in words:

for line in tried.answer:
    print(fill(line, 84))

# %%
# The vehicle's own echoes want posts. Someone else's calls are a landmark by themselves, that is
# heard from everywhere, so fused sensing minds an empty world less. The report compares values of
# a setting; any other comparison is a line on the table ``trials``, a row for each world and case.
# What does listening gain where five posts stand?

few = tried.trials.filter(tried.trials["scenario.landmarks"] == 5)
error = {way: rows["position_rmse_m"] for (way,), rows in few.group_by("strategy")}
gain = error["active"] - error["fused"]
answer = gain.mean()
print(f"{answer:.2f} m, ± {gain.std() / len(gain) ** 0.5:.2f} m, in {len(gain)} worlds")

# %%
# :doc:`/study` says what else a plan may hold. Twelve worlds take seconds, a thousand take hours:
# :doc:`09_on_a_cluster`.
