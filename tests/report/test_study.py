"""Which worlds count, under each rule."""

import shutil
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from pipistrelle.config import InputError
from pipistrelle.estimation.motion import motion_step
from pipistrelle.experiments.hearing.trajectories import true_motion
from pipistrelle.experiments.studies.plan import cases_of, read_plan
from pipistrelle.experiments.studies.world import TABLES, with_sums, world_file
from pipistrelle.report.study import (
    COMMON,
    READ,
    along,
    case_name,
    combination_name,
    filter_titles,
    kept,
    lap_time,
    lost_worlds,
    mean_std,
    read_study,
    samples,
    select,
    times_the_bound,
    values,
)
from report.invented import (
    BEAMWIDTH,
    ERROR,
    FILTERS,
    RADII,
    STRATEGIES,
    changed,
    diverging,
    invent,
    narrowed,
    only,
    turning,
    with_third,
    write_store,
)
from report.planted import LEVELS, write_planted


@pytest.fixture
def study():
    study = invent(6)
    for way, at in (("fused", (0, 3)), ("passive", (1, 0))):
        study.trials["ekf", way] = diverging(study.trials["ekf", way], *at)
    study.trials["fastslam", "active"].failed[2, 5] = True
    return study


PAIR = [("ekf", "fused", 3), ("ekf", "passive", 3)]


@pytest.mark.parametrize(
    ("rule", "cells", "dropped"),
    [
        ("world", [("ekf", "active", 8)], [0, 1]),
        ("world", [("ekf", "active", 8), ("fastslam", "active", 8)], [0, 1, 2]),
        ("case", [("ekf", "fused", 2)], []),
        ("case", PAIR[:1], [0]),
        ("case", PAIR, [0, 1]),
        ("none", PAIR, []),
        ("none", [("fastslam", "active", 5)], [2]),
    ],
)
def test_worlds_are_dropped_by_the_rule_and_where_a_trial_failed(study, rule, cells, dropped):
    assert np.flatnonzero(~kept(select(study, rule), cells)).tolist() == dropped
    lost = {name: np.flatnonzero(lost_worlds(study, name)).tolist() for name in FILTERS}
    assert lost == {"ekf": [0, 1], "fastslam": [2]}


def test_samples_are_of_the_same_worlds_and_finite(study):
    study.trials["ekf", "active"].scores["position_rmse_m"][4, 3] = np.inf
    study.trials["ekf", "fused"].scores["position_rmse_m"][5, 3] = np.nan
    cells = [("ekf", "active", 3), ("ekf", "fused", 3)]
    first, second = samples(select(study, "none"), "position_rmse_m", cells)
    assert first.tolist() == values(study, "position_rmse_m", cells[0])[:4].tolist()
    assert second.tolist() == values(study, "position_rmse_m", cells[1])[:4].tolist()


def test_passive_has_one_column_but_for_the_landmarks_in_common(study):
    there = study.trials["ekf", "passive"].scores
    assert values(study, "position_rmse_m", ("ekf", "passive", 7)) is not None
    np.testing.assert_array_equal(
        values(study, "position_rmse_m", ("ekf", "passive", 7)), there["position_rmse_m"][:, 0]
    )
    np.testing.assert_array_equal(values(study, COMMON, ("ekf", "passive", 7)), there[COMMON][:, 7])


def test_filters_are_in_the_catalogues_order_then_by_name(study):
    assert filter_titles(study) == {"ekf": "EKF", "fastslam": "FastSLAM 2.0"}
    for name in ("zoo.slam:Graph", "a.slam:Graph", "a.slam:Rays", "a:EKF"):
        study = with_third(study, name)
    assert list(filter_titles(study).items()) == [
        ("ekf", "EKF"),
        ("fastslam", "FastSLAM 2.0"),
        ("a.slam:Graph", "a.slam:Graph"),
        ("a.slam:Rays", "Rays"),
        ("a:EKF", "a:EKF"),
        ("zoo.slam:Graph", "zoo.slam:Graph"),
    ]


def test_moments_of_a_sample_are_known_from_two_worlds_on():
    assert np.isnan(mean_std(np.empty(0))).all()
    assert mean_std(np.array([7.0])) == (7.0, 0.0)
    assert mean_std(np.array([1.0, 3.0, 5.0])) == (3.0, 2.0)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study") / "store"
    study = invent(5, planned=9)
    failed = ((1, 4), (3, 20))
    plan, full, error = write_store(folder, study, iterations=9, failed=failed)
    return folder, study, plan, full, error, failed


def cell_of(case):
    radius = case.values["emitter.radius"]
    return case.filter, case.strategy, 0 if radius is None else RADII[::-1].index(radius)


def test_a_written_study_is_read_back(written):
    folder, study, plan, _, _, _ = written
    read = read_study(folder)
    assert (read.name, read.planned, read.worlds.tolist()) == ("invented", 9, list(range(5)))
    assert read.beamwidth == pytest.approx(BEAMWIDTH, rel=1e-12)
    assert set(read.trials) == {(f, s) for f in FILTERS for s in STRATEGIES}
    assert read.config.seed == plan.config.seed
    (beam,) = read.variables
    assert (beam.name, beam.words[0], beam.words[-1]) == ("beamwidth", "11°", "180°")
    assert list(read.grid) == ["emitter.radius"]
    assert {config.emitter.radius for config in read.configs} == set(RADII)
    for way, trials in read.trials.items():
        there = study.trials[way]
        good = ~trials.failed
        for score in READ:
            expected = there.scores[score]
            if score in ("landmarks_full", "landmarks_total"):
                expected = expected.round()
            np.testing.assert_array_equal(trials.scores[score][good], expected[good])
        np.testing.assert_array_equal(trials.nees[good], there.nees[good])


def test_the_settings_of_a_study_are_the_common_ones_and_no_filters_own(tmp_path):
    own = "[own.fastslam]\nfilter.gate = 0.5\nfastslam.particles = 7\n"
    plan, _, _ = write_store(tmp_path / "store", invent(2), grid=own)
    assert {case.config.fastslam.particles for case in cases_of(plan)} == {100, 7}
    read = read_study(tmp_path / "store")
    assert read.config == plan.config
    assert (read.config.filter.gate, read.config.fastslam.particles) == (1.0, 100)


def test_failed_trials_are_known_and_have_no_numbers(written):
    folder, _, plan, _, _, failed = written
    read = read_study(folder)
    assert sum(int(trials.failed.sum()) for trials in read.trials.values()) == len(failed)
    told = []
    for world, number in failed:
        name, strategy, column = cell_of(cases_of(plan)[number])
        width = float(BEAMWIDTH[column])
        told.append({"iteration": world, "strategy": strategy, "filter": name,
                     "beamwidth_deg": width, "settings": {}, "error": ERROR})  # fmt: skip
        trials = read.trials[name, strategy]
        assert trials.failed[world, column]
        assert np.isnan(trials.scores["position_rmse_m"][world, column])
        assert np.isnan(trials.nees[world, column]).all()
    assert [*read.errors] == told


def test_divergence_and_cost_are_read_trial_by_trial(tmp_path):
    study, rng = invent(4), np.random.default_rng(9)
    diverged = {way: rng.random(t.diverged.shape) < 0.3 for way, t in study.trials.items()}
    spoilt = {way: replace(t, diverged=diverged[way]) for way, t in study.trials.items()}
    plan, _, _ = write_store(tmp_path / "store", replace(study, trials=spoilt))
    read = read_study(tmp_path / "store")
    for way, trials in read.trials.items():
        np.testing.assert_array_equal(trials.diverged, diverged[way])
        assert not trials.failed.any()
    assert read.cpu_s == pytest.approx(4 * len(cases_of(plan)) * 0.5)  # they slept as long


def test_the_common_map_error_is_over_landmarks_that_every_strategy_placed(written):
    folder, _, plan, full, error, _ = written
    read = read_study(folder)
    number = {cell_of(case): case.number for case in cases_of(plan)}
    for world in range(len(read.worlds)):
        for name in FILTERS:
            for column in range(len(BEAMWIDTH)):
                trio = [number[name, s, 0 if s == "passive" else column] for s in STRATEGIES]
                shared = [k for k in range(full.shape[2]) if all(full[world, c, k] for c in trio)]
                for strategy, case in zip(STRATEGIES, trio, strict=True):
                    found = read.trials[name, strategy].scores[COMMON][world, column]
                    if not shared:
                        assert np.isnan(found)
                        continue
                    squares = [error[world, case, k] ** 2 for k in shared]
                    assert found == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-12)


def test_worlds_without_their_file_of_trials_are_left_out(written, spoilt):
    (spoilt / "trials" / "iteration_00002.parquet").unlink()
    whole, read = read_study(written[0]), read_study(spoilt)
    assert read.worlds.tolist() == [0, 1, 3, 4]
    for way, trials in read.trials.items():
        expected = whole.trials[way].scores["position_rmse_m"][[0, 1, 3, 4]]
        np.testing.assert_array_equal(trials.scores["position_rmse_m"], expected)


def test_numbers_that_are_not_finite_stay_so(tmp_path):
    folder, study = tmp_path / "store", invent(2)
    study.trials["ekf", "fused"].scores["position_rmse_m"][0, 3] = np.inf
    study.trials["ekf", "fused"].nees[1, 3, 7] = np.inf
    write_store(folder, study)
    read = read_study(folder)
    assert np.isposinf(read.trials["ekf", "fused"].scores["position_rmse_m"][0, 3])
    assert np.isposinf(read.trials["ekf", "fused"].nees[1, 3, 7])


def test_further_settings_are_further_variables_and_every_combination_has_its_numbers(tmp_path):
    grid = '"air.relative_humidity" = [0.7, 0.3]\nbeamwidth = [33, 180]\n'

    def by_both(case):
        wet, radius = case.values["air.relative_humidity"], case.values["emitter.radius"]
        return {"position_rmse_m": 10.0 * wet + (0.0 if radius is None else 1e3 * radius)}

    plan = write_planted(tmp_path / "s", grid, worlds=2, effect=by_both, spread=0.0,
                         ways='filters = ["ekf"]\n')  # fmt: skip
    read = read_study(tmp_path / "s")
    wet, beam = read.variables
    assert (wet.words, beam.words) == (("0.3", "0.7"), ("33°", "180°")), "rising, both"
    names = [combination_name(read, i) for i in range(4)]
    assert names[:2] == ["air.relative_humidity = 0.3, 33°", "air.relative_humidity = 0.3, 180°"]
    assert along(read, wet).tolist() == [[0, 1], [2, 3]]
    assert along(read, beam).tolist() == [[0, 2], [1, 3]]
    narrow, wide = plan.grid["emitter.radius"]
    bare = 0.8 + 0.2 * np.array([-1.0, 1.0]) / np.sqrt(2.0)
    for i, (moist, radius) in enumerate([(0.3, narrow), (0.3, wide), (0.7, narrow), (0.7, wide)]):
        assert read.configs[i].air.relative_humidity == moist
        assert read.configs[i].emitter.radius == radius
        active = values(read, "position_rmse_m", ("ekf", "active", i))
        assert sorted(active) == pytest.approx(sorted(bare + 10.0 * moist + 1e3 * radius))
        passive = values(read, "position_rmse_m", ("ekf", "passive", i))
        assert sorted(passive) == pytest.approx(sorted(bare + 10.0 * moist))
    assert read.trials["ekf", "passive"].at.tolist() == [0, 0, 1, 1]
    assert case_name(read, ("ekf", "passive"), 3) == "air.relative_humidity = 0.7"
    assert case_name(read, ("ekf", "active"), 3) == "air.relative_humidity = 0.7, 180°"
    assert read.config == plan.config


def test_words_and_lists_keep_the_plans_order_and_single_values_are_no_variable(tmp_path):
    grid = (
        '"rays.range_bounds" = [[2.0, 40.0], [0.5, 20.0]]\n"rays.exponent" = [3.0]\n'
        '"rays.weights" = ["instantaneous", "aggregated"]'
    )
    write_planted(tmp_path / "s", grid, worlds=1)
    read = read_study(tmp_path / "s")
    bounds, weights = read.variables
    assert bounds.words == ("[2, 40]", "[0.5, 20]")
    assert weights.words == ("instantaneous", "aggregated")
    assert (bounds.numbers, weights.numbers) == (None, None)
    assert {config.rays.exponent for config in read.configs} == {3.0}
    assert read.configs[1].rays.weights == "aggregated"
    assert read.configs[1].rays.range_bounds == (2.0, 40.0)


def test_a_radius_is_no_beamwidth_where_the_tone_varies_too_or_all_beams_are_as_wide(tmp_path):
    tones = '"emitter.radius" = [0.0025, 0.025]\n"emitter.frequency" = [35e3, 40e3]'
    write_planted(tmp_path / "tones", tones, worlds=1)
    radius, _ = read_study(tmp_path / "tones").variables
    assert (radius.name, radius.words) == ("emitter.radius", ("0.0025", "0.025"))
    write_planted(tmp_path / "wide", '"emitter.radius" = [0.0025, 0.001]', worlds=1)
    (radius,) = read_study(tmp_path / "wide").variables
    assert (radius.name, radius.words) == ("emitter.radius", ("0.001", "0.0025"))


def test_combinations_know_whether_they_meet_the_same_landmarks(tmp_path):
    write_planted(tmp_path / "level", LEVELS, worlds=1)
    assert read_study(tmp_path / "level").drawing.tolist() == [0, 0, 0]
    grid = '"scenario.landmarks" = [12, 20]\n"rays.exponent" = [1, 2]'
    write_planted(tmp_path / "count", grid, worlds=1)
    assert read_study(tmp_path / "count").drawing.tolist() == [0, 0, 1, 1]
    crowded = '"scenario.radius" = [3.0, 25.0]\n"rays.exponent" = [1, 2]'
    write_planted(tmp_path / "crowded", crowded, worlds=1)
    first, again, other, _ = read_study(tmp_path / "crowded").drawing
    assert first == again != other, "a world that cannot be drawn is one of its own"


def test_combinations_of_named_worlds_meet_the_landmarks_of_these(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        rows = ["landmark,x,y", "1,2,2", f"2,5,{len(name)}", *(["3,1,6"] * (name == "two"))]
        (tmp_path / name / "landmarks.csv").write_text("\n".join(rows) + "\n")
    folders = ", ".join(f'"{(tmp_path / name).as_posix()}"' for name in ("two", "one"))
    write_planted(tmp_path / "named", f'"scenario.world" = [{folders}]', worlds=1)
    study = read_study(tmp_path / "named")
    assert study.variables[0].words == ("two", "one")
    assert study.drawing.tolist() == [0, 1]
    assert study.example.landmarks.tolist() == [[2, 2], [5, 3], [1, 6]]


def test_a_failed_trial_is_listed_with_its_values(tmp_path):
    grid = '"air.relative_humidity" = [0.3, 0.7]\n'
    plan, *_ = write_store(tmp_path / "store", invent(2), grid=grid, failed=((1, 30),))
    (failure,) = read_study(tmp_path / "store").errors
    humid = cases_of(plan)[30].values["air.relative_humidity"]
    assert failure["settings"] == {"air.relative_humidity": f"{humid:g}"}
    assert failure["iteration"] == 1


def rewrite(folder, change, world=0):
    """Write the tables of a world again, changed by a function, with their sums."""
    plan = read_plan(folder / "plan.toml")
    tables = {name: pl.read_parquet(world_file(folder, name, world)) for name in TABLES}
    for name, content in with_sums(change(tables), plan, world).items():
        world_file(folder, name, world).write_bytes(content)


@pytest.mark.parametrize("label", [-1, -100])
def test_entries_of_a_map_that_are_no_true_landmark_count_in_no_map_error(tmp_path, label):
    write_planted(tmp_path / "s", worlds=1)
    before = read_study(tmp_path / "s").trials["ekf", "fused"]

    def with_false_one(tables):
        row = tables["landmarks"][:1]
        row = row.with_columns(landmark=pl.lit(label, pl.Int16), error_m=pl.lit(np.nan, pl.Float32))
        return tables | {"landmarks": pl.concat([tables["landmarks"], row])}

    rewrite(tmp_path / "s", with_false_one)
    after = read_study(tmp_path / "s").trials["ekf", "fused"]
    np.testing.assert_array_equal(after.placed, before.placed)
    np.testing.assert_array_equal(after.off, before.off)
    np.testing.assert_array_equal(after.scores[COMMON], before.scores[COMMON])


def test_a_folder_that_is_no_study_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"plan\.toml"):
        read_study(tmp_path)


@pytest.fixture
def spoilt(written, tmp_path):
    """A copy of a written study."""
    return shutil.copytree(written[0], tmp_path / "store")


def test_a_study_without_a_world_is_refused(spoilt):
    for path in (spoilt / "trials").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="no world is done"):
        read_study(spoilt)


@pytest.mark.parametrize(
    ("table", "content", "flaw"),
    [
        ("trials", slice(100), "could not be read"),
        ("steps", slice(100), "is not as it was written"),
        ("landmarks", slice(100), "is not as it was written"),
        ("steps", None, "is missing"),
        ("landmarks", None, "is missing"),
    ],
)
def test_a_damaged_or_missing_file_is_refused_with_a_remedy(spoilt, table, content, flaw):
    path = spoilt / table / "iteration_00001.parquet"
    whole = path.read_bytes()
    path.unlink()
    if content is not None:
        path.write_bytes(whole[content])
    with pytest.raises(InputError) as refused:
        read_study(spoilt)
    said = str(refused.value)
    assert said.startswith(f"{path}: {flaw}")
    assert "remove trials/iteration_00001.parquet" in said
    assert "its world is run again" in said
    assert said.isprintable()


def test_a_table_of_another_shape_is_refused(spoilt):
    rewrite(spoilt, lambda tables: tables | {"trials": tables["trials"].drop("nees_max")})
    with pytest.raises(InputError, match=r"iteration_00000\.parquet: has not the columns"):
        read_study(spoilt)


def test_multiples_of_the_bound_are_of_root_mean_squares_over_unlike_worlds():
    """Errors of 1 m and 7 m over bounds of 1 m both: 5 by squares, 4 by means."""
    study = narrowed(only(invent(2), [("ekf", "active")]), [5])
    way = "ekf", "active"
    study = changed(study, way, "position_rmse_m", lambda _: np.array([[1.0], [7.0]]))
    study = changed(study, way, "position_bound_m", lambda _: np.array([[1.0], [1.0]]))
    cell = (*way, 0)
    assert times_the_bound(select(study, "none"), cell) == pytest.approx(5.0)
    study = changed(study, way, "position_bound_m", lambda _: np.array([[0.6], [0.8]]))
    assert times_the_bound(select(study, "none"), cell) == pytest.approx(50.0**0.5)


def test_without_a_bound_there_are_no_multiples_of_it():
    study = changed(invent(2), ("ekf", "active"), "position_bound_m", lambda b: np.nan * b)
    assert times_the_bound(select(study, "none"), ("ekf", "active", 0)) is None


def test_a_lap_takes_the_time_of_a_turn_of_the_motion_model():
    study = invent(2)
    config = study.config
    controls = np.array([config.scenario.speed, config.scenario.steering])
    pose = motion_step(true_motion(config.motion), np.zeros(3), controls, config.scenario.step)
    assert lap_time(study) == pytest.approx(2 * np.pi / pose[2] * config.scenario.step, rel=1e-9)
    assert lap_time(study) == pytest.approx(62.1, abs=0.05), "as the paper's drive: three laps"
    assert lap_time(turning(study, steering=0.0)) == np.inf
