r"""
Your own world
==============

So far, chance has placed the landmarks and a circle was driven. Your question has a place of its
own: a corridor, an orchard, a tank. A world is a folder of small text files, and what they leave
out is drawn as ever. Here are twelve posts in a corridor, driven to and fro.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import pipistrelle

# %%
# ``landmarks.csv`` says what reflects; a column more, and one post is a drum, 20 cm in radius and
# much louder. ``path.csv`` here has way-points, for which a driver steers. ``world.toml`` has the
# settings that belong to the place, and who calls: instead of the beacon, a mate behind the wall.

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
name = "mate"
frequency = 30e3
level_db = 42.8
place = [0.0, 9.0]
""",
}

# %%
# All that :doc:`04_three_strategies` asked can be asked of this place, and answered. A setting of
# yours is a keyword, two underscores between section and name: these wheels slip a little less.

with TemporaryDirectory() as folder:
    for name, text in files.items():
        Path(folder, name).write_text(text)
    heard = ["active", "fused"]
    asked = {"settings": "paper", "strategies": heard, "motion__steering_std": 0.02}
    done = pipistrelle.run(world=folder, **asked)
figure = done.figure()

# %%
# What else a folder may hold, callers on the move among it, :doc:`/worlds` says. How far off is
# the worst of the twelve posts, on the fused map?

mapped = done.landmarks.filter(strategy="fused", status="full")
answer = mapped.filter(mapped["landmark"] <= len(posts))["error_m"].max()
print(f"{answer:.2f} m; map RMSE {done.summary['map_rmse_m'].round(2).to_list()} m")

# %%
# Here the sound is simulated. Where a sonar of yours has heard it: :doc:`06_your_own_log`.
