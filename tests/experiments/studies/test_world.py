"""A study's world: each case is the trial that it would be alone, though heard together."""

import os
import shutil
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pipistrelle.acoustics.emitter import beamwidth
from pipistrelle.config import PARAMETERS, Config, InputError, WaterConfig
from pipistrelle.detection.scans import with_columns
from pipistrelle.evaluation.bound import nees_of_exact_start, pose_bound
from pipistrelle.evaluation.consistency import nees
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.experiments.results.scores import OF_ASSOCIATION, Scores
from pipistrelle.experiments.runs import heard_world
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of
from pipistrelle.experiments.runs.trial import run_mission, run_trial
from pipistrelle.experiments.studies import world
from pipistrelle.experiments.studies.plan import Plan, cases_of
from pipistrelle.experiments.studies.study import load_study, open_store, run_study
from pipistrelle.experiments.studies.world import (
    TABLES,
    check_world,
    done_worlds,
    failed_records,
    read_outcomes,
    refuse_strange,
    run_world,
    sweep,
    world_file,
    world_tables,
    write_world,
)
from pipistrelle.files import write_down
from pipistrelle.settings import Given, from_flags, known_settings, resolve
from reference.studies import SMALL, TIMINGS, as_rows, contents, leftovers, plan_of

BOUNDS = ("position_bound_m", "heading_bound_rad")


@pytest.fixture(scope="module")
def varied(tmp_path_factory):
    grid = '"rays.exponent" = [2.0, 4.0]\n"scenario.landmarks" = [10, 12]\n'
    text = SMALL.replace("landmarks = 12\n", "") + grid
    return plan_of(tmp_path_factory.mktemp("plan"), text)


@pytest.fixture(scope="module")
def ran(varied):
    return run_world(varied, 0)


@pytest.fixture(scope="module")
def alone(varied):
    """The same cases one by one, as `pipistrelle run` would try them."""
    return [run_mission(c.config, (c.strategy,), (c.filter,)) for c in cases_of(varied)]


def scores_of(record):
    """Return the scores in the row of a record, by name."""
    return {field.name: record.row[field.name] for field in fields(Scores)}


def test_each_case_scores_as_in_a_separate_mission(ran, alone):
    assert len(ran) == 2 * 2 * (2 * 2 * 2 + 2)
    for record, mission in zip(ran, alone, strict=True):
        (trial,) = mission.trials
        assert scores_of(record) == asdict(trial.scores)


def test_steps_are_the_errors_and_the_nees_at_the_frames(ran, alone):
    for record, mission in zip(ran, alone, strict=True):
        track, truth = mission.trials[0].track, mission.scenario.path
        assert record.steps.shape == (10, 5)
        for frame in range(10):
            k = 4 * (frame + 1)
            error = track.pose.mean[k] - truth[k]
            error[2] = (error[2] + np.pi) % (2 * np.pi) - np.pi
            expected = [np.hypot(*error[:2]), error[2], nees(error, track.pose.covariance[k])]
            # single precision, after wrapping to 1e-15 of a turn
            np.testing.assert_allclose(record.steps[frame, :3], expected, rtol=1.2e-7, atol=1e-14)


def test_steps_contain_the_expected_nees_of_a_consistent_filter(ran, alone):
    for record, mission in zip(ran, alone, strict=True):
        drive, path = mission.drive, mission.scenario.path
        scans = scans_of(mission.heard, record.case.strategy, mission.config)
        bound = pose_bound(
            drive.motion, drive.controls, drive.time, path, drive.truth.landmarks, scans
        )
        expected = nees_of_exact_start(bound, path, drive.start.covariance)
        np.testing.assert_allclose(record.steps[:, 3:], np.transpose(expected)[4::4], rtol=1e-5)


def test_the_map_is_kept_with_the_distance_of_each_landmark_from_its_place(ran, alone):
    rows = 0
    for record, mission in zip(ran, alone, strict=True):
        hypotheses = mission.trials[0].track.landmarks
        places = dict(zip(*mission.drive.truth.landmarks, strict=True))
        assert set(record.landmark) == set(hypotheses.landmark)
        kept = zip(record.landmark, record.full, record.landmark_error, strict=True)
        for label, full, error in kept:
            mine = np.flatnonzero(hypotheses.landmark == label)
            assert full == (len(mine) == 1)
            best = mine[np.argmax(hypotheses.weight[mine])]
            assert error == pytest.approx(np.hypot(*(hypotheses.mean[best] - places[label])))
            rows += 1
    assert rows > len(ran)


def test_particles_record_their_mean_number_of_full_landmarks(ran, alone):
    for record, mission in zip(ran, alone, strict=True):
        full = mission.trials[0].track.full
        expected = record.row["landmarks_full"] if full is None else full
        assert record.row["landmarks_full_mean"] == expected
        assert (full is None) == (record.case.filter == "ekf")


def beamwidths_of(plan):
    """Return each case of a plan with the beamwidth in its row."""
    rows = as_rows(world_tables(plan, 0, failed_records(plan, "gone\n"))["trials"])
    return zip(cases_of(plan), (row["beamwidth_deg"] for row in rows), strict=True)


def test_only_active_and_fused_cases_have_their_pistons_beamwidth(varied):
    for case, found in beamwidths_of(varied):
        if case.strategy == "passive":
            assert found is None
        else:
            width = beamwidth(case.config.emitter.radius, frequency=35e3, speed_of_sound=343)
            assert found == pytest.approx(np.degrees(width), rel=1e-12)


def test_clutter_per_frame_is_counted_in_the_cases_beam(ran, alone):
    for record, mission in zip(ran, alone, strict=True):
        clutter = [heard.clutter for heard in mission.heard]
        assert record.row["clutter_per_frame"] == pytest.approx(np.mean(clutter), rel=1e-12)
    assert len({record.row["clutter_per_frame"] for record in ran}) > 1


def test_the_beamwidth_uses_the_cases_frequency_and_speed_of_sound():
    for setting, values in (
        ("emitter.frequency", (35e3, 50e3)),
        ("air.speed_of_sound", (343.0, 320.0)),
    ):
        for case, found in beamwidths_of(plan_with(Config(), setting, values)):
            emitter, c = case.config.emitter, case.config.air.sound_speed
            half_power = 1.6163399 / (2.0 * np.pi * emitter.frequency / c * emitter.radius)
            width = 2.0 * np.degrees(np.arcsin(half_power))
            assert found == pytest.approx(width, rel=1e-6)


def test_cases_that_hear_the_same_world_listen_once(varied, monkeypatch):
    heard = []
    listen = world.listen

    def counted(scenario, config, radii, **named):
        heard.append((config.scenario.landmarks, config.rays.exponent, *radii))
        return listen(scenario, config, radii, **named)

    monkeypatch.setattr(world, "listen", counted)
    run_world(varied, 1)
    assert [(landmarks, *radii) for landmarks, _, *radii in heard] == [
        (10, 0.0025, 0.025),
        (12, 0.0025, 0.025),
    ]


OTHERS = {
    "seed": 8, "callers": [{}, {"frequency": 25000.0}],
    "scenario.vehicle": 2, "scenario.medium": "water", "scenario.steps": 24, "scenario.step": 0.1,
    "scenario.steps_per_frame": 5, "scenario.speed": 0.8, "scenario.steering": 0.03,
    "scenario.start": [0.0, -7.0, 0.1], "scenario.course": "corridor", "scenario.extent": 9.0,
    "scenario.lane": 3.0, "scenario.field": "rows", "scenario.landmarks": 10,
    "scenario.radius": 20.0, "scenario.inner_radius": 9.0, "scenario.density": "distance",
    "scenario.spacing": 6.0, "scenario.clearance": 3.0,
    "scenario.beacon_distance": 12.0,
    "air.speed_of_sound": 340.0, "air.temperature_c": 0.0, "air.relative_humidity": 0.1,
    "air.pressure_kpa": 80.0, "air.spreading": "bistatic",
    "water.speed_of_sound": 1500.0, "water.temperature_c": 20.0, "water.salinity": 0.0,
    "water.depth": 100.0, "water.ph": 7.0, "water.spreading": "paper",
    "target.shape": "sphere", "target.radius": 0.05,
    "emitter.call": "sweep", "emitter.sweep": "hyperbolic", "emitter.band": [60000.0, 45000.0],
    "emitter.taper": 0.5, "emitter.frequency": 40000.0, "emitter.radius": 0.02,
    "emitter.level_db": 60.0, "emitter.directivity_law": "power", "emitter.call_duration": 0.002,
    "beacon.call": "sweep", "beacon.sweep": "hyperbolic", "beacon.band": [28000.0, 15000.0],
    "beacon.taper": 0.5, "beacon.frequency": 25000.0, "beacon.level_db": 55.0,
    "receiver.array": [[x, y, 0.0, 0.0, ""] for x, y in ((0.01, 0.0), (0.0, 0.01), (-0.01, 0.0))],
    "receiver.elements": 8, "receiver.spacing": 0.004, "receiver.sample_rate": 250000.0,
    "receiver.noise_level_db": 6.0,
    "detection.false_alarm": 0.01, "detection.snapshots": "runs", "detection.leakage_db": -10.0,
    "detection.peak_db": -0.5, "detection.scan_limit_deg": 76.0,
    "detection.angle_limit_deg": 40.0, "detection.averaging": "weighted",
    "detection.overlaps": "resolve",
    "matching.delay_gate": 0.01, "matching.bearing_gate": 0.01, "matching.margin_db": 0.0,
    "listening.excess_paths": True,
    "motion.model": "unicycle", "motion.wheelbase": 0.3, "motion.speed_std": 0.2,
    "motion.steering_std": 0.06, "motion.angular_rate_std": 0.2, "motion.speed_bias": 0.1,
    "motion.turn_bias": 0.01,
    "assumed.wheelbase": 0.3, "assumed.speed_std": 0.2, "assumed.steering_std": 0.06,
    "assumed.angular_rate_std": 0.3, "assumed.speed_of_sound": 335.0,
    "filter.noise": "measured", "filter.robust": "huber", "filter.range_std": 0.4,
    "filter.bearing_std": 0.05, "filter.excess_path_std": 0.7, "filter.caller_speed_std": 0.3,
    "filter.caller_walk_std": 0.6, "filter.initial_pose_std": [0.1, 0.1, 0.1],
    "filter.first_pose": "drawn", "filter.gate": 0.05,
    "filter.calibrate": ["speed_scale", "turn_bias"], "filter.window": 3.0,
    "prior.speed_scale_std": 0.01, "prior.turn_bias_std": 0.001, "prior.wheelbase_std": 0.3,
    "prior.speed_of_sound_std": 1.0, "prior.sensor_heading_std": 0.01,
    "prior.sensor_place_std": 0.5, "prior.time_offset_std": 0.01,
    "prior.range_scale_std": 0.01, "prior.range_bias_std": 0.01,
    "rays.relative_std": 0.2, "rays.range_ratio": 2.0, "rays.range_bounds": [1.0, 15.0],
    "rays.prune_threshold": 0.3, "rays.exponent": 4.0, "rays.weights": "aggregated",
    "rays.likelihood": "printed",
    "rays.precise_bearings": "auto", "rays.range_update": "moved", "rays.merge": 2.0,
    "fastslam.particles": 30, "fastslam.resample_below": 1.0, "fastslam.mixture": "exact",
    "fastslam.weights": "sampled", "fastslam.resampled_rays": "restart",
    "fastslam.weighed_by": "initialised", "fastslam.estimate": "mixture",
}  # fmt: skip
"""Another value of every setting, far enough from its default to be heard or believed."""
FEW = ("air.spreading", "water.spreading", "target.shape", "emitter.radius", "beacon.level_db",
       "receiver.elements",
       "detection.peak_db", "matching.bearing_gate", "motion.speed_std", "scenario.landmarks",
       "assumed.wheelbase", "listening.excess_paths", "callers",
       "filter.range_std", "prior.wheelbase_std", "rays.exponent", "fastslam.particles",
       "seed")  # fmt: skip
"""One of each section."""


def test_every_setting_is_varied_here_or_listed_as_exempt():
    # Folders (test_worlds_of_ones_own), associations (estimation/data_association), bags, and what
    # holds other settings (test_named_settings).
    known = {".".join(key) for key in known_settings()}
    elsewhere = {
        "scenario.world",
        *("settings", "own"),
        *(key for key in known if key.startswith(("association.", "bag."))),
    }
    assert set(OTHERS) == known - elsewhere
    others = {"settings", "own", "association", "bag"}
    assert {name.split(".")[0] for name in FEW} == set(Config.model_fields) - others


WATER = {"scenario": {"medium": "water"}}
ROAMING = {"listening": {"excess_paths": True}, "callers": [{"course": "circle", "radius": 5.0}]}
NEEDS = {
    **{f"emitter.{name}": {"emitter": {"call": "sweep"}} for name in ("sweep", "band")},
    **{f"beacon.{name}": {"beacon": {"call": "sweep"}} for name in ("sweep", "band")},
    "scenario.vehicle": {"callers": [{"course": "mission"}]},
    **dict.fromkeys((f"water.{name}" for name in WaterConfig.model_fields), WATER),
    "scenario.extent": {"scenario": {"course": "eight"}},
    "scenario.lane": {"scenario": {"field": "rows"}},
    "motion.angular_rate_std": {"motion": {"model": "unicycle"}},
    "filter.excess_path_std": {"listening": {"excess_paths": True}},
    "filter.caller_speed_std": ROAMING,
    "filter.caller_walk_std": ROAMING,
    "filter.robust": {"filter": {"noise": "measured"}},
    "filter.window": {"scenario": {"steps": 640}},
    **{f"prior.{name}_std": {"filter": {"calibrate": [name]}} for name in PARAMETERS},
    "rays.precise_bearings": {"filter": {"bearing_std": 0.003}},
    "rays.merge": {"scenario": {"steps": 80}},
    "assumed.angular_rate_std": {"motion": {"model": "unicycle"}},
}
"""What a setting means something with."""


def plan_with(config, setting="", values=(), filters=("ekf", "fastslam")):
    """A plan of one world, in which a setting may vary."""
    grid = {setting: values} if setting else {}
    ways = {"strategies": ("fused",), "filters": filters}
    return Plan(name="one", iterations=1, config=config, grid=grid, **ways)


def found_in(varied):
    """All that is found in the first world of a plan but for the times that it took, to the bit."""
    return [
        (
            repr({name: value for name, value in record.row.items() if name not in TIMINGS}),
            *(
                getattr(record, name).tobytes()
                for name in ("steps", "landmark", "full", "landmark_error")
            ),
        )
        for record in run_world(varied, 0)
    ]


@pytest.mark.parametrize(
    "setting",
    [name if name in FEW else pytest.param(name, marks=pytest.mark.slow) for name in OTHERS],
)
def test_values_of_a_grid_give_the_results_of_separate_runs(setting):
    short = from_flags({"scenario": {"steps": 40, "landmarks": 20, "radius": 15.0}})
    short |= from_flags(NEEDS.get(setting, {}))
    key = tuple(setting.split("."))
    usual = resolve(short).model_dump(mode="json")
    for name in key:
        usual = usual[name]
    values = (usual, OTHERS[setting])
    smoothers = key[0] == "prior" or key[1:] in (("calibrate",), ("window",))
    tried = {"filters": ("smoother",) if smoothers else ("ekf", "fastslam")}
    alone = [
        found_in(plan_with(resolve(short | {key: Given(value, setting)}), **tried))
        for value in values
    ]
    assert found_in(plan_with(resolve(short), setting, values, **tried)) == alone[0] + alone[1]
    assert alone[0] != alone[1], "or nothing is proved"


def test_different_worlds_have_different_scores(varied, ran):
    again, other = run_world(varied, 0), run_world(varied, 1)
    assert [scores_of(r) for r in again] == [scores_of(r) for r in ran]
    pairs = zip(other, ran, strict=True)
    assert all(a.row["position_rmse_m"] != b.row["position_rmse_m"] for a, b in pairs)


def test_each_case_of_a_later_world_equals_a_separate_trial(varied):
    for record in run_world(varied, 1):
        config, number = record.case.config, replace(record.case, iteration=1)
        scenario = world_of(config, 1)
        (heard,) = listen(scenario, config, [config.emitter.radius], iteration=1)
        scans = scans_of(heard, record.case.strategy, config)
        trial = run_trial(number, drive_of(scenario, config), scans, config)
        bounds = {name: record.row[name] for name in BOUNDS}
        assert scores_of(record) == asdict(trial.scores) | bounds


def test_a_trial_that_raises_is_recorded_and_the_others_go_on(varied, ran, monkeypatch):
    run_trial = world.run_trial

    def moody(case, drive, scans, config, **_):
        if case.filter == "fastslam" and case.strategy == "fused":
            raise ZeroDivisionError("no particles left")
        return run_trial(case, drive, scans, config)

    monkeypatch.setattr(world, "run_trial", moody)
    for record, whole in zip(run_world(varied, 0), ran, strict=True):
        case = record.case
        if (case.strategy, case.filter) == ("fused", "fastslam"):
            assert [*record.row] == ["error"]
            assert record.row["error"].startswith("Traceback")
            assert record.row["error"].endswith("ZeroDivisionError: no particles left\n")
            assert len(record.steps) == len(record.landmark) == 0
        else:
            assert scores_of(record) == scores_of(whole)


def test_a_world_that_cannot_be_drawn_fails_only_its_cases(tmp_path):
    text = SMALL.replace("landmarks = 12", "radius = 12.0") + '"scenario.landmarks" = [5, 900]\n'
    varied = plan_of(tmp_path, text)
    for record in run_world(varied, 0):
        crowded = record.case.config.scenario.landmarks == 900
        assert ("error" in record.row) == crowded
        if crowded:
            assert "InputError: scenario.landmarks: found 900" in record.row["error"]


def test_a_failed_trial_keeps_its_case_its_seed_and_its_error(varied):
    tables = world_tables(varied, 7, failed_records(varied, "gone\n"))
    rows = as_rows(tables["trials"])
    assert [row["case"] for row in rows] == [case.number for case in cases_of(varied)]
    assert {(r["iteration"], r["seed"], r["status"], r["error"]) for r in rows} == {
        (7, 7, "failed", "gone\n")
    }
    assert {row["position_rmse_m"] for row in rows} == {None}
    assert len(tables["steps"]) == len(tables["landmarks"]) == 0


def test_tables_keep_infinities_and_store_missing_values_as_null(varied, ran):
    scores = {"nees_max": np.inf, "position_rmse_m": np.nan, "map_rmse_m": None, "diverged": True}
    steps = np.array([[np.nan, np.inf, np.inf, 2.2, 3.5]], dtype=np.float32)
    tables = world_tables(varied, 0, [replace(ran[0], row=ran[0].row | scores, steps=steps)])
    (row,) = as_rows(tables["trials"])
    assert row["nees_max"] == np.inf
    assert np.isnan(row["position_rmse_m"])
    assert row["map_rmse_m"] is None
    (step,) = as_rows(tables["steps"])
    assert step["frame"] == 1
    assert np.isnan(step["position_error_m"])
    assert (step["heading_error_rad"], step["nees"]) == (np.inf, np.inf)


def test_a_filter_that_runs_away_leaves_infinite_errors(alone):
    mission = alone[0]
    track = mission.trials[0].track
    far = replace(track, pose=replace(track.pose, mean=np.full_like(track.pose.mean, 1e200)))
    steps = world._frame_errors(far, mission.scenario, mission.config)
    assert np.all(np.isinf(steps[:, [0, 2]]))


def test_an_exact_start_leaves_frames_unscored_until_the_covariance_is_positive_definite(alone):
    mission = alone[0]
    track = mission.trials[0].track
    covariance = track.pose.covariance.copy()
    covariance[:7] = np.diag([0.01, 0.0, 0.01])
    exact = replace(track, pose=replace(track.pose, covariance=covariance))
    steps = world._frame_errors(exact, mission.scenario, mission.config)
    assert np.isnan(steps[:, 2]).tolist() == [True] + 9 * [False]
    covariance[2] = np.eye(3)  # between frames: at the first it is singular again
    steps = world._frame_errors(exact, mission.scenario, mission.config)
    assert np.isinf(steps[:, 2]).tolist() == [True] + 9 * [False]


def test_columns_of_a_worlds_tables_equal_their_records(varied, ran):
    tables = world_tables(varied, 3, ran)
    trials, scored = as_rows(tables["trials"]), scores_of(ran[0])
    for row, record in zip(trials, ran, strict=True):
        assert (row["iteration"], row["case"]) == (3, record.case.number)
        left = {"nis_mean", "map_rmse_shared_m", *OF_ASSOCIATION}
        assert not left & {*row}, "worlds of a study that was begun before have none"
        kept = {name: row[name] for name in scored if name not in left}
        assert kept == {name: v for name, v in record.row.items() if name in kept}
        own = tables["steps"].filter(case=record.case.number)
        assert own["frame"].to_list() == list(range(1, 11))
        names = ["position_error_m", "heading_error_rad", "nees", "nees_expected", "nees_variance"]
        np.testing.assert_array_equal(own.select(names).to_numpy(), record.steps)
        own = tables["landmarks"].filter(case=record.case.number)
        assert own["landmark"].to_list() == record.landmark.tolist()
        assert own["full"].to_list() == record.full.tolist()
        np.testing.assert_array_equal(own["error_m"], record.landmark_error.astype(np.float32))


def test_columns_have_the_names_of_varied_settings(varied, ran):
    tables = world_tables(varied, 0, ran)
    for row, case in zip(as_rows(tables["trials"]), cases_of(varied), strict=True):
        assert (row["strategy"], row["filter"]) == (case.strategy, case.filter)
        assert {name: row[name] for name in case.values} == case.values
    kinds = {name: str(kind) for name, kind in tables["steps"].schema.items()}
    assert kinds == {
        "iteration": "Int32",
        "case": "Int16",
        "frame": "UInt16",
        "position_error_m": "Float32",
        "heading_error_rad": "Float32",
        "nees": "Float32",
        "nees_expected": "Float32",
        "nees_variance": "Float32",
    }


@pytest.mark.parametrize("stage", ["listen", "run_trial"])
def test_an_interruption_that_a_library_hides_is_no_failed_trial(varied, monkeypatch, stage):
    def hidden(*_, **__):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise SystemError("returned a result with an exception set") from error

    monkeypatch.setattr(world, stage, hidden)
    with pytest.raises(KeyboardInterrupt):
        run_world(varied, 0)


# The bound


@pytest.fixture(scope="module")
def bounded(tmp_path_factory):
    """Records of a world whose filters are told different noise, or weigh it otherwise."""
    text = SMALL.replace("steps = 40", "steps = 80") + (
        '"filter.noise" = ["constant", "measured"]\n"filter.robust" = ["none", "huber"]\n'
        "[own.iekf]\nfilter.range_std = 0.7\nfilter.gate = 0.99\n"
    )
    text = text.replace("[config", 'filters = ["ekf", "fastslam", "iekf", "smoother"]\n[config')
    return run_world(plan_of(tmp_path_factory.mktemp("bounded"), text), 0)


def bounds_of(ran, strategy, radius=0.0025):
    """All bounds of a strategy at a radius, each once."""
    return {
        tuple(record.row[name] for name in BOUNDS)
        for record in ran
        if record.case.strategy == strategy and record.case.config.emitter.radius == radius
    }


@pytest.mark.parametrize("strategy", ["active", "fused", "passive"])
def test_the_bound_is_the_same_for_all_filters_and_their_settings(bounded, strategy):
    assert not any("error" in record.row for record in bounded)
    for radius in (0.0025, 0.025):
        found = bounds_of(bounded, strategy, radius)
        assert len(found) == (0 if (strategy, radius) == ("passive", 0.0025) else 1)
        assert all(0.0 < value < 1.0 for pair in found for value in pair)


def test_hearing_more_never_raises_the_bound(bounded):
    (passive,) = bounds_of(bounded, "passive", 0.025)
    for radius in (0.0025, 0.025):
        (active,) = bounds_of(bounded, "active", radius)
        (fused,) = bounds_of(bounded, "fused", radius)
        assert all(both <= alone for both, alone in zip(fused, active, strict=True))
        assert all(both <= alone for both, alone in zip(fused, passive, strict=True))
    (wide,), (narrow,) = (bounds_of(bounded, "active", radius) for radius in (0.0025, 0.025))
    assert all(one <= other for one, other in zip(wide, narrow, strict=True))


def test_only_measured_noise_raises_the_bound(varied, monkeypatch):
    def doubled(rows, settings, **options):
        rows = without_hidden(rows, settings, **options)
        more = {name: 2.0 * getattr(rows, name) for name in ("bearing_std", "range_std")}
        return with_columns(rows, **more)

    without_hidden = heard_world.without_hidden
    short = replace(varied, strategies=("active",), filters=("ekf",))
    before = run_world(short, 0)
    coarse = short.config.filter.model_copy(update={"range_std": 0.4, "bearing_std": 0.3})
    stated = replace(short, config=short.config.model_copy(update={"filter": coarse}))
    monkeypatch.setattr(heard_world, "without_hidden", doubled)
    after = run_world(short, 0)
    monkeypatch.setattr(heard_world, "without_hidden", without_hidden)
    pairs = zip(before, after, strict=True)
    share = [b.row["heading_bound_rad"] / a.row["heading_bound_rad"] for a, b in pairs]
    assert max(share) > 1.03
    for one, other, same in zip(before, after, run_world(stated, 0), strict=True):
        for name in BOUNDS:
            assert other.row[name] > one.row[name]
            assert same.row[name] == one.row[name]
        assert other.row["position_rmse_m"] == one.row["position_rmse_m"]


def test_a_world_is_done_when_its_trials_are_there(folder, plan, records):
    assert done_worlds(folder) == set()
    write_world(folder, plan, 2, records)
    assert done_worlds(folder) == {2}
    for table in TABLES:
        assert world_file(folder, table, 2).is_file()
    assert leftovers(folder) == []
    outcomes = [(record.case.strategy, record.row["error"]) for record in records]
    assert read_outcomes(folder, plan, 2) == outcomes


def test_the_trials_are_written_last(folder, plan, records, monkeypatch):
    order = []
    rename = world.put_in_place
    monkeypatch.setattr(
        world, "put_in_place", lambda a, b: (order.append(b.parent.name), rename(a, b))
    )
    write_world(folder, plan, 0, records)
    assert order == ["steps", "landmarks", "trials"]


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="this system has no device that is always full"
)
def test_a_full_disk_raises_a_clear_error_and_keeps_existing_files(
    folder, plan, records, monkeypatch, table
):
    write_world(folder, plan, 1, records)
    before = contents(folder)

    def full(path, data):
        if path.parent.name == table:
            path.write_bytes(data[:7])
            raise OSError(28, "No space left on device")
        write_down(path, data)

    monkeypatch.setattr(world, "write_down", full)
    for iteration in (0, 1):
        with pytest.raises(InputError, match=r"could not be written \(No space left on device\)"):
            write_world(folder, plan, iteration, failed_records(plan, "never written\n"))
    assert contents(folder) == before
    assert leftovers(folder) == []
    assert done_worlds(folder) == {1}


@pytest.mark.parametrize("nth", [1, 2, 3])
def test_a_rename_that_fails_leaves_no_half_a_world_that_counts(
    folder, plan, records, monkeypatch, nth
):
    calls = []

    def failing(partial, path):
        calls.append(path)
        if len(calls) == nth:
            raise OSError(5, "Input/output error", str(path))
        partial.replace(path)

    monkeypatch.setattr(world, "put_in_place", failing)
    with pytest.raises(InputError, match="Input/output error"):
        write_world(folder, plan, 0, records)
    assert done_worlds(folder) == set()
    assert leftovers(folder) == []
    assert len(load_study(folder).steps.collect()) == 0


def test_leftovers_of_a_killed_writer_are_removed_with_its_world(folder, plan, records):
    for table in TABLES:
        path = world_file(folder, table, 0)
        path.with_name(f"{path.name}.deadbeef.partial").write_bytes(b"PAR1 half a")
    world_file(folder, "steps", 0).write_bytes(b"whole, but of a world that is not done")
    other = world_file(folder, "steps", 1)
    living = other.with_name(f"{other.name}.01234567.partial")
    living.write_bytes(b"another process is writing this")
    assert done_worlds(folder) == set()
    assert len(load_study(folder).steps.collect()) == 0
    write_world(folder, plan, 0, records)
    assert leftovers(folder) == [living]
    sweep(folder, [1])
    assert leftovers(folder) == []


@pytest.mark.parametrize("table", ["steps", "landmarks"])
@pytest.mark.parametrize("kind", ["text", "link", "other columns"])
def test_a_file_of_somebodys_in_a_tables_place_is_refused_before_the_work(
    folder, plan, tmp_path, table, kind
):
    path, other = world_file(folder, table, 1), tmp_path / "mine.parquet"
    pl.DataFrame({"mine": [1.0]}).write_parquet(other)
    if kind == "link":
        path.symlink_to(other)
    else:
        path.write_bytes(b"my notes" if kind == "text" else other.read_bytes())
    before = contents(folder)
    with pytest.raises(InputError, match=f"{table}/iteration_00001.parquet: is no table .* move"):
        run_study(plan, folder)
    assert contents(folder) == before


def test_tables_that_a_killed_writer_left_without_trials_block_nothing(folder, plan, records):
    write_world(folder, plan, 1, records)
    world_file(folder, "trials", 1).unlink()
    refuse_strange(folder, plan, range(3))


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="only Linux has such a path")
@pytest.mark.parametrize("moment", ["write_down", "put_in_place"])
def test_a_study_that_takes_the_folders_place_is_unchanged(
    folder, plan, records, monkeypatch, tmp_path, moment
):
    other = tmp_path / "other"
    another = replace(plan, config=resolve(from_flags({"seed": 99})))
    open_store(other, another)
    write_world(other, another, 2, records)
    before, plain = contents(other), getattr(world, moment)

    def swapped(*words):
        if not folder.is_symlink():
            folder.rename(tmp_path / "moved")
            folder.symlink_to(other)
        return plain(*words)

    with monkeypatch.context() as patch:
        patch.setattr(world, moment, swapped)
        write_world(folder, plan, 2, records)
    assert done_worlds(tmp_path / "moved") >= {2}
    with pytest.raises(InputError, match="found the folder of another study"):
        write_world(folder, plan, 2, records)
    assert contents(other) == before


def test_an_overtaken_writer_succeeds(folder, plan, records, monkeypatch):
    write = world.write_down

    def overtaken(path, data):
        write(path, data)
        if path.parent.name == "trials" and len(leftovers(folder)) == 3:
            monkeypatch.setattr(world, "write_down", write)
            write_world(folder, plan, 0, records)  # which sweeps ours away

    monkeypatch.setattr(world, "write_down", overtaken)
    write_world(folder, plan, 0, records)
    assert done_worlds(folder) == {0}
    assert leftovers(folder) == []


def test_a_damaged_world_is_named_with_the_way_out(folder, plan):
    world_file(folder, "trials", 0).write_bytes(b"nothing of ours")
    message = r"0\.parquet: could not be read: it is no whole .*; remove"
    with pytest.raises(InputError, match=message):
        read_outcomes(folder, plan, 0)


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("place", [0.1, 0.5, 0.8, 0.9, 0.98])
def test_one_bit_that_a_disk_changed_is_noticed(folder, plan, records, table, place):
    write_world(folder, plan, 3, records)
    check_world(folder, plan, 3)
    path = world_file(folder, table, 3)
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] ^= 4
    path.write_bytes(data)
    with pytest.raises(InputError) as refused:
        read_outcomes(folder, plan, 3)
    assert str(refused.value).startswith(f"{path}: ")
    assert "remove trials/iteration_00003.parquet" in str(refused.value)


def test_a_world_of_a_plan_with_other_settings_of_a_filters_own_is_noticed(tmp_path, plan, records):
    own = {"ekf": {"filter.gate": 0.9}}
    for k, (there, here) in enumerate((({}, own), (own, {}), (own, {"ekf": {"filter.gate": 0.8}}))):
        folder = tmp_path / str(k)
        open_store(folder, replace(plan, own=there))
        write_world(folder, replace(plan, own=there), 0, records)
        check_world(folder, replace(plan, own=there, iterations=99), 0)
        with pytest.raises(InputError, match=r"iteration_00000\.parquet: was computed by another"):
            check_world(folder, replace(plan, own=here), 0)


def test_a_world_of_another_plan_is_noticed_and_more_worlds_are_no_other_plan(
    folder, plan, records
):
    write_world(folder, plan, 0, records)
    check_world(folder, replace(plan, iterations=99), 0)
    other = replace(plan, config=resolve(from_flags({"rays": {"exponent": 3.0}})))
    with pytest.raises(InputError, match=r"iteration_00000\.parquet: was computed by another plan"):
        check_world(folder, other, 0)


def test_trials_of_other_columns_are_named_though_their_sums_are_right(folder, plan, records):
    tables = world.world_tables(plan, 0, records)
    other = tables | {"trials": tables["trials"].drop("error")}
    for name, file in world.with_sums(other, plan, 0).items():
        world_file(folder, name, 0).write_bytes(file)
    with pytest.raises(InputError, match=r"iteration_00000\.parquet: has not the columns"):
        read_outcomes(folder, plan, 0)


@pytest.mark.parametrize("table", TABLES)
def test_a_file_of_another_world_or_by_another_hand_is_noticed(folder, plan, table):
    for number in (0, 1):
        write_world(folder, plan, number, run_world(plan, number))
    here, there = (world_file(folder, table, number) for number in (0, 1))
    kept = here.read_bytes()
    shutil.copy(there, here)
    found = "is the file of world 1" if table == "trials" else "is not as it was written"
    with pytest.raises(InputError, match=found):
        check_world(folder, plan, 0)
    here.write_bytes(kept)
    check_world(folder, plan, 0)
    pl.read_parquet(kept)[::2].write_parquet(here)
    with pytest.raises(InputError, match=r"bears no sums|is not as it was written"):
        check_world(folder, plan, 0)


def test_a_writer_killed_while_it_replaces_a_world_leaves_it_undone(
    folder, plan, records, monkeypatch
):
    write_world(folder, plan, 0, records)
    tables = world.world_tables(plan, 0, records)
    other = tables["steps"].select(
        pl.lit(1).cast(kind).alias(c) for c, kind in tables["steps"].schema.items()
    )
    monkeypatch.setattr(world, "world_tables", lambda *_: tables | {"steps": other})

    def killed(partial, path):
        partial.replace(path)
        raise KeyboardInterrupt

    monkeypatch.setattr(world, "put_in_place", killed)
    with pytest.raises(KeyboardInterrupt):
        write_world(folder, plan, 0, records)
    assert done_worlds(folder) == set(), "new steps beside old trials are no world"


@pytest.mark.parametrize(
    "name",
    ["a*b", "s[1]/x", "q?", "file:x", "{a,b}", "http:/x", "\x1b[31m", "new\nline", "x ", "~x"],
)
def test_no_name_of_a_folder_is_a_pattern_or_a_place_elsewhere(
    tmp_path, plan, records, monkeypatch, name
):
    monkeypatch.chdir(tmp_path)
    beside = Path(name.replace("*", "X").replace("?", "X").replace("[1]", "1"))
    for folder in {Path(name), beside}:
        world_files_of(folder, plan, records)
    for folder in {Path(name), beside}:
        assert len(read_outcomes(folder, plan, 0)) == len(records)
        study = load_study(folder)
        assert [len(getattr(study, table).collect()) for table in TABLES] == [0, 0, len(records)]


@pytest.mark.skipif(os.name == "nt", reason="all names are Unicode there")
def test_a_folder_with_an_undecodable_name_is_read(tmp_path, plan, records):
    folder = tmp_path / os.fsdecode(b"log\xff")
    world_files_of(folder, plan, records)
    assert len(load_study(folder).trials.collect()) == len(records)


def world_files_of(folder, plan, records):
    """Open a study of one world."""
    open_store(folder, plan)
    write_world(folder, plan, 0, records)
