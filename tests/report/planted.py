"""Studies of any plan that never ran: what each setting does is planted, and so is nothing."""

from pathlib import Path

import numpy as np

from pipistrelle.experiments.studies.plan import cases_of, read_plan
from pipistrelle.experiments.studies.study import open_store
from report.invented import noise, write_tables

FRAMES, LANDMARKS = 6, 5
HEAD = "format = 1\niterations = {worlds}\n{ways}[config]\nscenario.steps = 24\n[grid]\n{grid}\n"
LEVELS = '"beacon.level_db" = [36.8, 42.8, 48.8]'
"""The grid of a single number."""
FUSED_EKF = 'strategies = ["fused"]\nfilters = ["ekf"]\n'


def nothing(case):
    """Plant no effect."""
    return {}


def by_level(metres):
    """Plant a rise of the position's error, over the three levels, of so many metres."""

    def effect(case):
        return {"position_rmse_m": metres * (case.values["beacon.level_db"] - 36.8) / 12.0}

    return effect


def write_planted(
    folder: Path, grid=LEVELS, *, worlds=12, ways=FUSED_EKF, effect=nothing, spread=0.02, seed=4,
    diverged=lambda case, world: False, far=0.0, name="planted",
):  # fmt: skip
    """Write a study into a folder, whose scores are a world's hardness, an effect and some noise.

    `effect` is a function of a case, and gives what is added to scores by their names; `spread` is
    the standard deviation of what no two cases share; what diverged is `far` off besides. Returns
    the plan.
    """
    text = folder.parent / f"{name}.toml"
    text.write_text(HEAD.format(worlds=worlds, ways=ways, grid=grid))
    plan = read_plan(text)
    open_store(folder, plan)
    rng, cases = np.random.default_rng(seed), cases_of(plan)
    hard = noise(rng, worlds)
    own = noise(rng, worlds, len(cases), 4)
    for world in range(worlds):
        tables = {"trials": [], "steps": [], "landmarks": []}
        for case in cases:
            scores = scores_of(hard[world], spread * own[world, case.number])
            for score, more in effect(case).items():
                scores[score] += more
            scores["position_rmse_m"] += far * diverged(case, world)
            row = {"case": case.number, "strategy": case.strategy, "filter": case.filter}
            row |= {key: str(v) if isinstance(v, list) else v for key, v in case.values.items()}
            row |= {"beamwidth_deg": None, "seed": 7, "status": "done", "wall_s": 1.0, "cpu_s": 0.5}
            tables["trials"].append(row | scores | {"diverged": diverged(case, world)})
            tables["steps"] += [
                {"case": case.number, "frame": k,
                 "nees": 1e6 if diverged(case, world) else scores["nees_mean"],
                 "nees_expected": 2.5, "nees_variance": 4.0}
                for k in range(1, FRAMES + 1)
            ]  # fmt: skip
            tables["landmarks"] += [
                {"case": case.number, "landmark": k, "full": True, "error_m": scores["map_rmse_m"]}
                for k in range(1, LANDMARKS + 1)
            ]
        write_tables(folder, plan, world, tables)
    return plan


def scores_of(hard, own):
    """Return the scores of a trial in which no setting does anything."""
    position = 0.8 + 0.2 * hard + own[0]
    return {
        "position_rmse_m": position,
        "position_rmse_aligned_m": 0.3 + 0.05 * hard + own[1],
        "heading_rmse_rad": 0.05 + 0.01 * hard + 0.1 * own[2],
        "map_rmse_m": 0.5 + 0.1 * hard + own[3],
        "map_rmse_aligned_m": 0.2 + 0.05 * hard + own[3],
        "position_bound_m": 0.25 + 0.02 * hard,
        "heading_bound_rad": 0.02,
        "nees_mean": float(np.exp(0.5 + 0.2 * hard + own[0])),
        "nees_max": 9.0,
        "landmarks_full": 30,
        "landmarks_total": 40,
        "landmarks_full_mean": 30.0,
        "gated": 0,
    }
