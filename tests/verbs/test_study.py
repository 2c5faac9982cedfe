"""`pipistrelle study` as a person calls it: what it prints, what it refuses, how it ends."""

import re
import sys
from pathlib import Path

import numba
import pytest

from pipistrelle import jit
from pipistrelle.__main__ import main
from pipistrelle.experiments.runs import compiling
from pipistrelle.experiments.studies import study, world
from pipistrelle.experiments.studies.plan import read_plan
from pipistrelle.experiments.studies.world import done_worlds
from pipistrelle.verbs import study as verb
from reference.command_line import COMPILING
from reference.studies import SMALL, assert_same, results


@pytest.fixture(autouse=True)
def small(in_a_folder_of_its_own):
    Path("small.toml").write_text(SMALL)


@pytest.fixture
def obey(capsys):
    """Run a command line in one process; return its status, what it printed and what it said."""

    def obey(*words):
        alone = () if {"--workers", "--scheduler"} & set(words) else ("--workers", "1")
        status = main(["study", *map(str, words), *alone])
        printed, said = capsys.readouterr()
        lines = [line for line in said.splitlines(keepends=True) if line != COMPILING + "\n"]
        return status, printed, "".join(lines)

    return obey


@pytest.fixture
def failing(monkeypatch):
    """Make each passive FastSLAM trial fail."""
    run_trial = world.run_trial

    def moody(case, drive, scans, config, **_):
        if (case.strategy, case.filter) == ("passive", "fastslam"):
            raise FloatingPointError("weights: all zero")
        return run_trial(case, drive, scans, config)

    monkeypatch.setattr(world, "run_trial", moody)


@pytest.mark.parametrize(("words", "said"), [((), 1), (("--quiet",), 0)])
def test_compilation_is_announced(capsys, monkeypatch, words, said):
    monkeypatch.setattr(jit._CLOCK, "said", False)  # as in a new process
    monkeypatch.setattr(compiling, "run_mission", lambda *_: numba.njit(lambda x: x + 1)(1.0))
    line = ("study", "small.toml", "--iterations", "1", "--workers", "1", "-o", "one")
    assert main([*line, *words]) == 0
    assert capsys.readouterr().err.count(COMPILING) == said


def test_a_study_prints_progress_results_and_folder(obey):
    status, printed, said = obey("small.toml", "-o", "one")
    assert (status, printed) == (0, "3 worlds, 30 trials, 0 failed\none\n")
    paper, first, last = said.splitlines()
    assert 'settings = "best"' in paper
    assert first == "0/3 worlds; trials: active 0/12, fused 0/12, passive 0/6"
    assert re.fullmatch(
        r"3/3 worlds, \d+\.\d trials/s, 0 s left; trials: active 12/12, fused 12/12, passive 6/6",
        last,
    )


def test_the_same_command_again_goes_on_and_repeats_nothing(obey, ran):
    obey("small.toml", "--iterations", "2", "-o", "one")
    ran.clear()
    assert obey("small.toml", "-o", "one")[1].startswith("3 worlds, 30 trials")
    assert ran == [2]


def test_without_a_name_the_folder_is_the_plans_so_that_the_same_command_goes_on(obey):
    for _ in range(2):
        assert obey("small.toml", "--iterations", "1", "--quiet") == (0, "runs/small\n", "")
    assert done_worlds(Path("runs/small")) == {0}


def test_as_many_workers_as_asked_for_do_the_study(obey, monkeypatch):
    asked = []

    def noted(plan, folder, *, workers, **others):
        asked.append(workers)
        return study_alone(plan, folder, **others)

    study_alone = study.run_study
    monkeypatch.setattr(study, "run_study", noted)
    words = ("small.toml", "--iterations", "1", "--quiet", "-o", "one")
    assert obey(*words, "--workers", "7") == (0, "one\n", "")
    assert asked == [7]


def test_settings_override_the_plan_and_are_kept(obey, monkeypatch):
    monkeypatch.setenv("PIPISTRELLE_RAYS__EXPONENT", "4")
    words = ("--iterations", "1", "--seed", "9", "--filter.gate", "0.99", "--quiet")
    assert obey("small.toml", *words, "-o", "one")[0] == 0
    config = read_plan(Path("one/plan.toml")).config
    assert (config.seed, config.filter.gate, config.rays.exponent) == (9, 0.99, 4.0)
    monkeypatch.delenv("PIPISTRELLE_RAYS__EXPONENT")
    assert obey("one/plan.toml", "--quiet", "-o", "one")[0] == 0
    assert obey("one/plan.toml", "--quiet", "-o", "two")[0] == 0
    assert_same(results("one"), results("two"))


def test_failed_trials_are_counted_and_make_the_status_one(obey, failing):
    status, printed, said = obey("small.toml", "-o", "one")
    assert (status, printed) == (1, "3 worlds, 30 trials, 3 failed\none\n")
    assert "passive 6/6 (3 failed)" in said
    assert said.splitlines()[-1] == (
        "pipistrelle: warning: 3 of 30 trials failed, the first with: FloatingPointError: weights: "
        "all zero; see the column error in one/trials; --retry-failed does their worlds again"
    )


def test_failed_trials_of_an_earlier_run_count_until_they_are_run_again(obey, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(world, "run_trial", None)
        assert obey("small.toml", "--iterations", "1", "--quiet", "-o", "one")[0] == 1
    assert obey("small.toml", "--iterations", "1", "--quiet", "-o", "one")[0] == 1
    words = ("--iterations", "1", "--retry-failed", "-o", "one")
    assert obey("small.toml", *words)[:2] == (0, "1 world, 10 trials, 0 failed\none\n")


def test_on_a_terminal_bars_move(obey, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    status, _, said = obey("small.toml", "-o", "one")
    assert status == 0
    assert [word for word in ("worlds", "active", "fused", "passive") if word not in said] == []
    assert "30 trials" not in said
    assert "3/3, " in said


def test_lines_of_progress_are_limited_except_first_and_last(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(verb, "perf_counter", lambda: now[0])
    with verb._progress(quiet=False) as show:
        for done in range(101):
            show(so_far(done, 100))
            now[0] += 1.0
    told = re.findall(r"^(\d+)/100", capsys.readouterr().err, re.M)
    assert [int(word) for word in told] == [*range(0, 100, 10), 100]


def so_far(done, worlds):
    counts = {"trials": 2 * worlds, "ended": 2 * done, "failed": 0}
    named = {name: {"fused": count} for name, count in counts.items()}
    return study.StudyProgress(worlds=worlds, done=done, first_error=None, **named)


def test_speed_and_remaining_time_count_from_the_continuation(monkeypatch):
    now = [50.0]
    monkeypatch.setattr(verb, "perf_counter", lambda: now[0])
    pace = verb._pace()
    assert pace(so_far(40, 100)) == ""
    now[0] += 10.0
    assert pace(so_far(50, 100)) == "2.0 trials/s, 50 s left"


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.4, "0 s"), (99.0, "99 s"), (300.0, "5 min"), (7260.0, "2 h 1 min")]
)
def test_a_length_of_time_is_worded_in_the_unit_that_fits(seconds, words):
    assert verb._span(seconds) == words


# Mistakes


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "none.toml",
            "none.toml: found no such file; expected association, beyond, callers, pair, paper, "
            "physics, sweeps, timing or the path of",
        ),
        ("small.toml --iterations 0", "--iterations: found 0, expected 1 to 1000000"),
        ("small.toml --iterations 2.5", "--iterations: found '2.5', expected a whole number"),
        ("small.toml --workers 0", "--workers: found 0, expected 1 to 1000000"),
        ("small.toml --shard 4/4", "--shard: found '4/4', expected I/N with I from 0 to N - 1"),
        ("small.toml --shard 0/0", "--shard: found '0/0', expected I/N"),
        ("small.toml --sharp 0/4", "Unknown option: --sharp. Did you mean --shard?"),
        ("small.toml --rays.exponent 0", "--rays.exponent: found 0.0, expected greater than 0"),
        ("small.toml --workers 2 --scheduler tcp://here:1", "--workers: the cluster at tcp://here"),
        ("small.toml -o small.toml", "small.toml: could not be written (File exists)"),
        ("small.toml -o .", "holds small.toml and no plan.toml"),
    ],
)
def test_mistakes_are_explained_in_a_line(refused, words, said):
    assert said in refused(*words.split())


def test_every_case_of_a_plan_is_checked_before_the_first_world(refused):
    Path("small.toml").write_text(SMALL + '"scenario.beacon_distance" = [15.0, 1e9]\n')
    said = refused("small.toml", "-o", "one")
    assert said.startswith("scenario.beacon_distance: a recording of 1.17e+07 s")
    assert "scenario.beacon_distance = 1000000000.0)" in said
    assert not Path("one").exists()


def test_giving_the_default_speed_of_sound_keeps_the_plan(obey):
    words = ("small.toml", "--iterations", "1", "--quiet", "-o", "one")
    assert obey(*words)[0] == 0
    assert obey(*words, "--air.speed-of-sound", "343")[0] == 0
    assert obey(*words, "--air.speed-of-sound", "340")[0] == 2


def test_a_grid_of_thousands_of_values_is_read_at_once(refused):
    values = ", ".join(repr(0.5 + i / 1e5) for i in range(33_000))
    Path("small.toml").write_text(SMALL + f'"filter.gate" = [{values}]\n')
    said = refused("small.toml", "-o", "one")
    assert said == "small.toml: grid: found 396000 cases, expected at most 32767"


def test_ambiguous_bearings_are_reported_once_for_all_cases(obey):
    words = ("--iterations", "1", "--receiver.spacing", "0.007", "-o", "one", "--quiet")
    status, printed, said = obey("small.toml", *words)
    assert (status, printed) == (0, "one\n")
    lines = said.splitlines()
    assert len(lines) == 2
    assert all("warning: receiver.spacing: 0.007 m is" in line for line in lines)


# Interrupts


def test_an_interrupt_ends_with_130_and_keeps_finished_worlds(obey, monkeypatch):
    run_world = study.run_world

    def interrupted(plan, iteration):
        if iteration == 1:
            raise KeyboardInterrupt
        return run_world(plan, iteration)

    monkeypatch.setattr(study, "run_world", interrupted)
    status, printed, said = obey("small.toml", "-o", "one")
    assert (status, printed) == (130, "")
    assert said.splitlines()[-2:] == [
        "one: worlds that are done are kept; the same command goes on with the rest",
        "pipistrelle: interrupted",
    ]
    assert done_worlds(Path("one")) == {0}


# Clusters


def test_a_cluster_without_its_extra_is_refused_before_a_folder_is_made(refused, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    for address in ("local", "tcp://127.0.0.1:8786"):
        said = refused("small.toml", "--scheduler", address, "-o", "one")
        assert f"--scheduler {address}: needs Dask, which is not installed" in said
        assert "python -m pip install dask distributed cryptography" in said
    assert not Path("one").exists()
