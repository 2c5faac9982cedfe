r"""
Your own world
==============

Until now landmarks were random and the course a circle. A world of your own is a folder of small
text files; missing parts are drawn. This world is a corridor with twelve posts, driven to and fro.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import pipistrelle

# %%
# ``landmarks.csv`` has the reflectors; by a further column a post is a drum of 20 cm radius and
# much louder. ``path.csv`` has way-points, and the vehicle steers along them. ``world.toml`` has
# the settings of the world and its callers: a caller behind the wall instead of the beacon.

posts = [(x, y) for x in (-10, -6, -2, 2, 6, 10) for y in (-2.5, 2.5)]
rows = [f"{i},{x},{y},{0.2 if i == 7 else 0.025}" for i, (x, y) in enumerate(posts, 1)]
files = {
    "landmarks.csv": "\n".join(["landmark,x,y,radius", *rows]),
    "path.csv": "x,y\n-11,-0.7\n11,-0.7\n11,0.7\n-11,0.7\n",
    "world.toml": """
format = 1

[config]
air.relative_humidity = 0.8

[[callers]]
name = "siren"
frequency = 30e3
level_db = 42.8
place = [0.0, 9.0]
""",
}

# %%
# The questions of :doc:`04_three_strategies` can be asked of this world. A setting is a keyword,
# with two underscores between section and name: here the wheels slip less.

with TemporaryDirectory() as folder:
    for name, text in files.items():
        Path(folder, name).write_text(text)
    heard = ["active", "fused"]
    asked = {"settings": "paper", "strategies": heard, "motion__steering_std": 0.02}
    done = pipistrelle.run(world=folder, **asked)
figure = done.figure()

# %%
# See :doc:`/worlds` for the other parts of a world, such as moving callers. What is the largest
# error of the twelve posts on the fused map?

mapped = done.landmarks.filter(strategy="fused", status="full")
answer = mapped.filter(mapped["landmark"] <= len(posts))["error_m"].max()
print(f"{answer:.2f} m; map RMSE {done.summary['map_rmse_m'].round(2).to_list()} m")

# %%
# Here the sound is simulated. For measurements of your own sonar see :doc:`06_your_own_log`.
