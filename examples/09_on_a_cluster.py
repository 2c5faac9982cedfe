r"""
The same on a cluster
=====================

A thousand worlds are too many for a laptop. Worlds are independent, so any number of machines can
run them. Is the result the same? Every random number is keyed by seed, world and purpose, so it
does not depend on the workers or their order.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import pipistrelle
from pipistrelle.figures.style import STRATEGY_COLOURS, STYLE, TRUTH

# %%
# A study as in :doc:`08_your_own_study`: does a louder beacon fill the map?

plan = """
format = 1
name = "loud"
iterations = 6
strategies = ["fused"]
filters = ["ekf"]
config.scenario.steps = 160
grid."beacon.level_db" = [36.0, 48.0]
"""

# %%
# It runs three times: in a single process; in three *shards*, each with every third world of a
# shared folder, as on machines with a shared disk (``pipistrelle study PLAN --shard 0/16``); and
# on a Dask cluster (``pip install '.[cluster]'``) of two workers on this machine. For
# another cluster, ``scheduler`` is its address, ``tcp://HOST:PORT``.
#
# Workers are processes that import the script, so the study is started below ``if __name__ ==
# "__main__"``.

if __name__ == "__main__":
    found = {}
    with TemporaryDirectory() as folder:
        path = Path(folder, "loud.toml")
        path.write_text(plan)
        found["one process"] = pipistrelle.study(path).trials
        for i in range(3):
            part = pipistrelle.study(path, shard=(i, 3), output=Path(folder, "shards"))
            print(f"shard {i}: {part.trials['iteration'].n_unique()} worlds are done")
        found["three shards"] = part.trials
        found["Dask"] = pipistrelle.study(path, scheduler="local", workers=2).trials

    plt.rcParams.update(STYLE)
    figure, axes = plt.subplots(figsize=(6.0, 3.4), layout="constrained")
    looks = (14, TRUTH), (9, STRATEGY_COLOURS["passive"]), (4, STRATEGY_COLOURS["fused"])
    for (name, trials), (size, colour) in zip(found.items(), looks, strict=True):
        placed = trials["iteration"], trials["landmarks_full"]
        axes.plot(*placed, "o", ms=size, color=colour, label=name)
    for row in trials.filter(iteration=5).iter_rows(named=True):
        axes.annotate(f"  {row['beacon.level_db']:.0f} dB", (5.15, row["landmarks_full"]))
    axes.set(xlabel="world", ylabel="landmarks placed", xlim=(-0.3, 5.8))
    figure.legend(loc="outside upper center", ncols=3)
    plt.show()

    tables = [t.drop("wall_s", "cpu_s").sort("iteration", "case") for t in found.values()]
    answer = sum(not table.equals(tables[0]) for table in tables)
    print(f"{answer} of {len(tables)} differ in any bit of {tables[0].width} columns")

# %%
# The next tutorial uses the delay of an echo, which the paper does not:
# :doc:`10_when_not_only_where`.
