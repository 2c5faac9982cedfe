"""A study's folder, read back: what was written is what is found."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from pipistrelle.config import InputError
from pipistrelle.experiments.studies.plan import cases_of
from pipistrelle.experiments.studies.plan_file import read_plan
from pipistrelle.experiments.studies.world_files import TABLES, with_sums, world_file
from pipistrelle.report.reading import read_study
from pipistrelle.report.studied import COMMON, SCORES
from report.invented import BEAMWIDTH, ERROR, FILTERS, RADII, STRATEGIES, invent, write_store


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


def test_what_was_written_is_read(written):
    folder, study, _, _, _, _ = written
    (read,) = read_study(folder)
    assert (read.name, read.planned, read.worlds.tolist()) == ("invented", 9, list(range(5)))
    assert read.beamwidth == pytest.approx(BEAMWIDTH, rel=1e-12)
    assert set(read.trials) == {(f, s) for f in FILTERS for s in STRATEGIES}
    assert read.config.seed == 2022
    assert read.settings == {}
    assert list(read.grid) == ["emitter.radius"]
    for way, trials in read.trials.items():
        there = study.trials[way]
        good = ~trials.failed
        for score in SCORES:
            expected = there.scores[score]
            if score in ("landmarks_full", "landmarks_total"):
                expected = expected.round()
            np.testing.assert_array_equal(trials.scores[score][good], expected[good])
        np.testing.assert_array_equal(trials.nees[good], there.nees[good])


def test_the_settings_of_a_study_are_the_common_ones_and_no_filters_own(tmp_path):
    own = "[own.fastslam]\nfilter.gate = 0.5\nfastslam.particles = 7\n"
    plan, _, _ = write_store(tmp_path / "store", invent(2), grid=own)
    assert {case.config.fastslam.particles for case in cases_of(plan)} == {100, 7}
    (read,) = read_study(tmp_path / "store")
    assert read.config == plan.config
    assert (read.config.filter.gate, read.config.fastslam.particles) == (1.0, 100)


def test_failed_trials_are_known_and_have_no_numbers(written):
    folder, _, plan, _, _, failed = written
    (read,) = read_study(folder)
    assert sum(int(trials.failed.sum()) for trials in read.trials.values()) == len(failed)
    told = []
    for world, number in failed:
        name, strategy, column = cell_of(cases_of(plan)[number])
        told.append((world, strategy, name, float(BEAMWIDTH[column]), ERROR))
        trials = read.trials[name, strategy]
        assert trials.failed[world, column]
        assert np.isnan(trials.scores["position_rmse_m"][world, column])
        assert np.isnan(trials.nees[world, column]).all()
    assert [*read.errors] == told


def test_what_diverged_and_what_it_cost_is_read_trial_by_trial(tmp_path):
    study, rng = invent(4), np.random.default_rng(9)
    diverged = {way: rng.random(t.diverged.shape) < 0.3 for way, t in study.trials.items()}
    spoilt = {way: replace(t, diverged=diverged[way]) for way, t in study.trials.items()}
    plan, _, _ = write_store(tmp_path / "store", replace(study, trials=spoilt))
    (read,) = read_study(tmp_path / "store")
    for way, trials in read.trials.items():
        np.testing.assert_array_equal(trials.diverged, diverged[way])
        assert not trials.failed.any()
    assert read.cpu_s == pytest.approx(4 * len(cases_of(plan)) * 0.5)  # they slept as long


def test_the_map_error_is_that_of_the_landmarks_every_strategy_has_placed(written):
    folder, _, plan, full, error, _ = written
    (read,) = read_study(folder)
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


def test_worlds_without_their_file_of_trials_are_left_out(written, tmp_path):
    folder, study = tmp_path / "store", written[1]
    write_store(folder, study)
    (folder / "trials" / "iteration_00002.parquet").unlink()
    (read,) = read_study(folder)
    assert read.worlds.tolist() == [0, 1, 3, 4]
    expected = study.trials["ekf", "fused"].scores["position_rmse_m"][[0, 1, 3, 4]]
    np.testing.assert_array_equal(read.trials["ekf", "fused"].scores["position_rmse_m"], expected)


def test_what_is_not_finite_stays_so(written, tmp_path):
    folder, study = tmp_path / "store", invent(2)
    study.trials["ekf", "fused"].scores["position_rmse_m"][0, 3] = np.inf
    study.trials["ekf", "fused"].nees[1, 3, 7] = np.inf
    write_store(folder, study)
    (read,) = read_study(folder)
    assert np.isposinf(read.trials["ekf", "fused"].scores["position_rmse_m"][0, 3])
    assert np.isposinf(read.trials["ekf", "fused"].nees[1, 3, 7])


def test_further_settings_make_studies_of_their_own(tmp_path):
    folder = tmp_path / "store"
    write_store(folder, invent(3), grid='"air.relative_humidity" = [0.3, 0.7]\n')
    dry, moist = read_study(folder)
    assert dry.settings == {"air.relative_humidity": 0.3}
    assert moist.settings == {"air.relative_humidity": 0.7}
    assert moist.config.air.relative_humidity == 0.7
    assert len(dry.beamwidth) == len(moist.beamwidth) == len(RADII)
    assert dry.config.emitter.radius == moist.config.emitter.radius


def test_a_folder_that_is_no_study_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"plan\.toml"):
        read_study(tmp_path)


def test_a_study_without_a_world_is_refused(tmp_path):
    folder = tmp_path / "store"
    write_store(folder, invent(1))
    (folder / "trials" / "iteration_00000.parquet").unlink()
    with pytest.raises(InputError, match="no world is done"):
        read_study(folder)


@pytest.mark.parametrize("table", ["trials", "steps", "landmarks"])
def test_a_damaged_file_is_refused_with_what_to_do(tmp_path, table):
    folder = tmp_path / "store"
    write_store(folder, invent(2))
    path = folder / table / "iteration_00001.parquet"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError) as refused:
        read_study(folder)
    said = str(refused.value)
    flaw = "could not be read" if table == "trials" else "is not as it was written"
    assert said.startswith(f"{path}: {flaw}")
    assert "remove trials/iteration_00001.parquet" in said
    assert "its world is done anew" in said
    assert said.isprintable()


@pytest.mark.parametrize("table", ["steps", "landmarks"])
def test_a_table_that_is_gone_is_named(tmp_path, table):
    folder = tmp_path / "store"
    write_store(folder, invent(2))
    path = folder / table / "iteration_00000.parquet"
    path.unlink()
    with pytest.raises(InputError, match="is missing; remove trials/iteration_00000") as refused:
        read_study(folder)
    assert str(refused.value).startswith(f"{path}:")


def test_a_table_of_another_shape_is_refused(tmp_path):
    folder = tmp_path / "store"
    write_store(folder, invent(1))
    tables = {name: pl.read_parquet(world_file(folder, name, 0)) for name in TABLES}
    lacking = tables | {"trials": tables["trials"].drop("nees_max")}
    world_file(folder, "trials", 0).write_bytes(
        with_sums(lacking, read_plan(folder / "plan.toml"), 0)["trials"]
    )
    with pytest.raises(InputError, match=r"iteration_00000\.parquet: has not the columns"):
        read_study(folder)
