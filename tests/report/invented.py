"""A study that never ran: worlds in which the paper is right, to the last claim."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl

from pipistrelle.acoustics.emitter import beamwidth
from pipistrelle.config import Config
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.experiments.studies.plan import cases_of, find_plan, read_plan
from pipistrelle.experiments.studies.study import open_store
from pipistrelle.experiments.studies.world import TABLES, with_sums, world_file, world_schemas
from pipistrelle.report.study import COMMON, NEES, READ, Study, Trials
from pipistrelle.report.variables import beam_variable

RADII = (
    0.0025, 0.0031, 0.0038, 0.0047, 0.0058, 0.0071, 0.0088, 0.0108, 0.0133, 0.0164, 0.0203, 0.025,
)  # fmt: skip
BEAMWIDTH = np.degrees(beamwidth(np.array(RADII[::-1]), frequency=35e3, speed_of_sound=343.0))
"""Of the paper's radii, narrowest first [deg]."""
FRAMES = 375
ERROR = "Traceback\nValueError: <script>alert(1)</script>"
LANDMARKS = 51
FILTERS, STRATEGIES = ("ekf", "fastslam"), ("active", "fused", "passive")
PLAN = """\
format = 1
name = "invented"
iterations = {iterations}
[config]
{settings}
[grid]
"emitter.radius" = {radii}
"""


def noise(rng, worlds, *shape):
    """Draws over worlds whose means are 0 and whose standard deviations are 1, exactly."""
    draws = rng.normal(size=(worlds, *shape))
    if worlds < 2:
        return np.zeros_like(draws)
    draws -= draws.mean(axis=0)
    return draws / draws.std(axis=0, ddof=1)


def position(name, strategy):
    """Mean position RMSE over the beamwidth as the paper tells it [m]."""
    passive = {"ekf": 0.7, "fastslam": 1.0}[name]
    if strategy == "passive":
        return np.array([passive])
    fused = passive - 0.05 - 0.05 * np.log2(BEAMWIDTH / BEAMWIDTH[0])
    gain = {"ekf": np.where(BEAMWIDTH < 42.0, 0.004, -0.02), "fastslam": -0.1}[name]
    return fused if strategy == "fused" else fused + gain


def nees_of(rng, worlds, beams, name):
    """NEES that swings with the laps and rises, EKF's nearer to 3."""
    tau = 0.5 * np.arange(1, FRAMES + 1) / 62.06
    size = {"ekf": 1.0, "fastslam": 15.0}[name]
    curve = 2.5 + size * (0.8 * tau + 0.5 * (1.0 - np.cos(2.0 * np.pi * tau)))
    factor = 1.0 + 0.2 * noise(rng, worlds, beams, 1)
    return np.float32(curve * factor).astype(np.float64)


def trials_of(rng, world, name, strategy):
    """Scores of one filter and strategy, with the worlds' own hardness in the errors."""
    worlds, beams = len(world), 1 if strategy == "passive" else len(BEAMWIDTH)

    def about(mean, own, shared=0.0):
        return mean + shared * world[:, None] + own * noise(rng, worlds, beams)

    where = position(name, strategy)
    turned = {"active": 0.06, "fused": 0.05, "passive": 0.055}[strategy]
    seen, full = np.full(beams, 40.0), np.full(beams, 27.0)
    if strategy == "active":
        full = np.linspace(20.0, 36.0, beams)
        seen = np.where(BEAMWIDTH < 64.0, full, 38.6)
    if strategy == "fused":
        seen = np.interp(BEAMWIDTH, [11.6, 33.3, 180.0], [40.1, 40.8, 43.7])
        full = np.interp(BEAMWIDTH, [11.6, 33.3, 180.0], [30.0, 31.9, 37.7])
    if name == "fastslam":
        full = full + {"active": 0.0, "fused": 1.0, "passive": -4.9}[strategy]
    nees = nees_of(rng, worlds, beams, name)
    scores = {
        "position_rmse_m": about(where, 0.03, 0.1),
        "heading_rmse_rad": about(turned, 0.004, 0.01),
        "landmarks_full": about(full, 2.0),
        "landmarks_total": about(seen, 2.0),
        "nees_mean": nees.mean(axis=2),
        "nees_max": nees.max(axis=2),
    }
    scores["landmarks_full_mean"] = scores["landmarks_full"] + 0.1
    scores["position_rmse_aligned_m"] = 0.2 * scores["position_rmse_m"]
    scores["map_rmse_aligned_m"] = scores["position_rmse_aligned_m"] + 0.01
    scores["position_bound_m"] = np.tile(0.23 + 0.05 * world[:, None], beams)
    scores["heading_bound_rad"] = 0.1 * scores["position_bound_m"]
    placed = {"active": 0.5, "fused": 0.52, "passive": 0.6}[strategy]
    scores[COMMON] = placed + 0.2 * world[:, None] + 0.05 * noise(rng, worlds, len(BEAMWIDTH))
    scores["map_rmse_m"] = np.tile(placed + 0.2 * world[:, None], beams)
    scores |= {name: np.full((worlds, beams), np.nan) for name in READ if name not in scores}
    no = np.zeros((worlds, beams), dtype=bool)
    ideal = np.full((2, beams, FRAMES), 3.0)
    ideal[1] = 6.0
    return Trials(
        at=np.arange(len(BEAMWIDTH)) % beams,
        failed=no,
        diverged=no.copy(),
        scores=scores,
        placed=np.ones((worlds, beams, 1), dtype=bool),
        off=scores["map_rmse_m"][:, :, None],
        nees=nees,
        consistent=ideal,
    )


def invent(worlds=60, seed=1, planned=None):
    """A study whose every claim is the paper's."""
    rng = np.random.default_rng(seed)
    world = noise(rng, worlds)
    config = Config(seed=2022)
    return Study(
        name="invented",
        variables=(beam_variable("emitter.radius", RADII[::-1], BEAMWIDTH),),
        grid={"emitter.radius": (0.0025, 0.025)},
        planned=worlds if planned is None else planned,
        worlds=np.arange(worlds),
        config=config,
        configs=(config,) * len(BEAMWIDTH),
        beamwidth=BEAMWIDTH,
        drawing=np.zeros(len(BEAMWIDTH), dtype=int),
        example=world_of(config),
        trials={
            (name, strategy): trials_of(rng, world, name, strategy)
            for name in FILTERS
            for strategy in STRATEGIES
        },
        errors=(),
        cpu_s=60.0,
    )


def changed(study, way, score, change):
    """The same study with one score of one way changed by a function."""
    trials = study.trials[way]
    scores = trials.scores | {score: change(trials.scores[score])}
    return replace(study, trials=study.trials | {way: replace(trials, scores=scores)})


def plant(score, strategy, change, names=FILTERS):
    """Change a score of a strategy by a function."""

    def planted(study):
        for name in names:
            study = changed(study, (name, strategy), score, change)
        return study

    return planted


def add(score, strategy, more, names=FILTERS):
    """Add to a score of a strategy."""
    return plant(score, strategy, lambda numbers: numbers + more, names)


def spread(score, strategy, by, names=FILTERS):
    """Multiply the deviations of a score from its means over the worlds."""
    return plant(score, strategy, lambda s: s.mean(axis=0) + by * (s - s.mean(axis=0)), names)


def nees(name, strategy, factor=1.0, step=1):
    """Multiply the NEES of a way, or reverse it in time."""

    def planted(study):
        trials = study.trials[name, strategy]
        curve = factor * trials.nees[:, :, ::step]
        trials = replace(trials, nees=curve, scores=trials.scores | {NEES: curve.mean(axis=2)})
        return replace(study, trials=study.trials | {(name, strategy): trials})

    return planted


def diverging(trials, rows, columns=slice(None)):
    """The same trials, of which some have a NEES far above every limit."""
    lost = np.zeros_like(trials.diverged)
    lost[rows, columns] = True
    nees = np.where(lost[:, :, np.newaxis], 1e6, trials.nees)
    return replace(trials, diverged=trials.diverged | lost, nees=nees)


def losing(name, count):
    """Let a filter diverge in so many worlds."""

    def planted(study):
        trials = diverging(study.trials[name, "active"], np.arange(len(study.worlds)) < count)
        return replace(study, trials=study.trials | {(name, "active"): trials})

    return planted


def with_all(study, plants):
    """The same study with several changes."""
    for one in plants:
        study = one(study)
    return study


def only(study, ways):
    """The same study with some ways alone."""
    return replace(study, trials={way: study.trials[way] for way in ways})


def narrowed(study, columns):
    """The same study at some of its beamwidths alone."""
    columns = list(columns)
    (beam,) = study.variables
    few = beam_variable(beam.setting, [beam.given[i] for i in columns], BEAMWIDTH[columns])
    trials = {}
    for way, mine in study.trials.items():
        b = [0] if way[1] == "passive" else columns
        fields = ("failed", "diverged", "placed", "off", "nees", "consistent")
        cut = {name: getattr(mine, name)[:, b] for name in fields}
        scores = {
            score: table[:, columns if score == COMMON else b]
            for score, table in mine.scores.items()
        }
        trials[way] = replace(mine, at=np.arange(len(columns)) % len(b), scores=scores, **cut)
    return replace(
        study,
        variables=(few,),
        configs=study.configs[: len(columns)],
        beamwidth=study.beamwidth[columns],
        drawing=study.drawing[columns],
        trials=trials,
    )


def turning(study, **scenario):
    """The same study with another drive."""
    setup = study.config.scenario.model_copy(update=scenario)
    config = study.config.model_copy(update={"scenario": setup})
    return replace(study, config=config, configs=(config,) * len(study.configs))


def with_third(study, name):
    """The same study with a further filter, as FastSLAM but worse everywhere and often diverged."""
    third = {}
    for strategy in STRATEGIES:
        trials = study.trials["fastslam", strategy]
        diverged = trials.diverged.copy()
        diverged[::3] = True
        scores = {score: 1.5 * table for score, table in trials.scores.items()}
        third[name, strategy] = replace(trials, diverged=diverged, scores=scores)
    return replace(study, trials=dict(sorted({**study.trials, **third}.items())))


def write_store(
    folder: Path, study: Study, *, iterations=None, seed=3, failed=(), grid="", name="invented",
    radii=RADII,
):  # fmt: skip
    """Write a study at some of its radii into a folder as `pipistrelle study` does.

    `failed` holds pairs of a world's row and a case's number, `grid` further lines of the plan's
    grid, each combination of which then holds the same results. Returns the plan and, by world and
    case, which landmarks are fully initialised and how far off each is (NaN: not in the map).
    """
    rng = np.random.default_rng(seed)
    text = folder.parent / f"{folder.name}.toml"
    settings = find_plan("paper").read_text().split("[config]\n")[1].split("\n\n")[0]
    worlds = max(iterations or 0, study.planned)
    plan = PLAN.format(iterations=worlds, radii=list(radii), settings=settings) + grid
    text.write_text(plan.replace("invented", name))
    plan = read_plan(text, iterations=iterations or len(study.worlds))
    open_store(folder, plan)
    cases = cases_of(plan)
    shape = (len(study.worlds), len(cases), LANDMARKS)
    full = rng.uniform(size=shape) < 0.7
    error = np.where(rng.uniform(size=shape) < 0.9, rng.rayleigh(0.4, shape), np.nan)
    error = np.float32(error).astype(np.float64)
    full &= np.isfinite(error)
    for row, iteration in enumerate(study.worlds.tolist()):
        broken = {number for world, number in failed if world == row}
        tables = world_tables_of(study, row, cases, broken, full[row], error[row])
        write_tables(folder, plan, iteration, tables)
    for row, number in failed:
        full[row, number], error[row, number] = False, np.nan
    return plan, full, error


def write_tables(folder, plan, world, tables):
    """Write the rows of a world's tables with their sums."""
    schemas = world_schemas(replace(plan, filters=("ekf",)))  # those from outside are not there
    frames = {
        name: pl.DataFrame(
            [{"iteration": world} | row for row in tables[name]], schema=schemas[name]
        )
        for name in TABLES
    }
    for name, file in with_sums(frames, plan, world).items():
        world_file(folder, name, world).write_bytes(file)


def world_tables_of(study, row, cases, broken, full, error):
    """Rows of one world's three tables."""
    tables = {"trials": [], "steps": [], "landmarks": []}
    for case in cases:
        head = {"case": case.number}
        radius = case.values["emitter.radius"]
        column = 0 if radius is None else RADII[::-1].index(radius)
        trials = study.trials[case.filter, case.strategy]
        trial = head | dict(case.values)
        trial |= {
            "strategy": case.strategy,
            "filter": case.filter,
            "beamwidth_deg": None if radius is None else float(BEAMWIDTH[column]),
            "seed": study.config.seed,
            "status": "done",
            "wall_s": 1.0,
            "cpu_s": 0.5,
        }
        if case.number in broken:
            tables["trials"].append(trial | {"status": "failed", "error": ERROR})
            continue
        for score in READ:
            value = float(trials.scores[score][row, column])
            whole = score in ("landmarks_full", "landmarks_total")
            trial[score] = round(value) if whole else value
        tables["trials"].append(trial | {"diverged": bool(trials.diverged[row, column])})
        nees = trials.nees[row, column]
        ideal = trials.consistent[:, column].T
        tables["steps"] += [
            head | {"frame": k, "nees": v, "nees_expected": mean, "nees_variance": variance}
            for k, (v, (mean, variance)) in enumerate(zip(nees, ideal, strict=True), start=1)
        ]
        tables["landmarks"] += [
            head | {"landmark": k + 1, "full": bool(full[case.number, k]), "error_m": off}
            for k, off in enumerate(error[case.number].tolist())
            if np.isfinite(off)
        ]
    return tables
