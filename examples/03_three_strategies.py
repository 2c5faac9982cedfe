r"""
One mission, three strategies
=============================

One world, one drive, one recording; what differs is what the vehicle makes of it. *Active* sensing
takes its own calls' echoes, range and bearing, from within its beam. *Passive* sensing takes the
beacon's calls and their echoes from all around, bearings alone. *Fused* sensing takes both.
"""

from pipistrelle.acoustics.emitter import beamwidth
from pipistrelle.config import STRATEGIES, Config, ScenarioConfig
from pipistrelle.experiments.runs.trial import run_mission
from pipistrelle.figures.mission import draw_mission

# %%
# The first 62.5 s of the paper's drive, one round among fifty landmarks. The command line does the
# same: ``pipistrelle run --seed 7 --duration 62.5``.

config = Config(seed=7, scenario=ScenarioConfig(steps=500))
mission = run_mission(config, STRATEGIES)

# %%
# A landmark that was only ever heard passively is a ray, drawn as the row of Gaussians that it is,
# until the vehicle has moved far enough to tell how far away it stands.

width = beamwidth(
    config.emitter.radius,
    frequency=config.emitter.frequency,
    speed_of_sound=config.air.celerity,
)
figure = draw_mission(
    mission.trials,
    truth=mission.drive.truth,
    callers=mission.scenario.callers[1:],
    beamwidth=float(width),
)

# %%
# In numbers:

for trial in mission.trials:
    scores = trial.scores
    print(
        f"{trial.strategy:<8} position {scores.position_rmse_m:.2f} m, "
        f"{scores.landmarks_full} of {scores.landmarks_total} landmarks placed, "
        f"{scores.measurements_per_frame:.1f} measurements a frame"
    )

# %%
# How many more landmarks does a vehicle know that listens to the beacon, too?

known = {trial.strategy: set(trial.track.landmarks.landmark.tolist()) for trial in mission.trials}
answer = len(known["fused"] - known["active"])
print(answer)
