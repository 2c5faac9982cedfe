"""Each tutorial runs as it is and ends in one number, which is right."""

import re
import runpy
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.stats import chi2, ttest_rel

import pipistrelle
from pipistrelle.acoustics.arrivals import arrivals_of_emission, through_piston
from pipistrelle.config import Config
from pipistrelle.verbs.command_line import obey
from reference.command_line import summary

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
LONGEST = 90
"""Lines of a screen and a half."""


@pytest.fixture
def play(monkeypatch, tmp_path):
    """Run a tutorial as a script, without a window, and return its variables."""
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    mpl.use("Agg")
    monkeypatch.setattr(plt, "show", lambda: None)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])  # a filter of one's own is looked for here
    with mpl.rc_context():
        yield lambda name: runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    plt.close("all")
    assert list(tmp_path.iterdir()) == [], "a tutorial leaves nothing behind"


def scripts():
    return sorted(EXAMPLES.glob("*.py"))


def test_every_tutorial_is_tested():
    names = {path.stem for path in scripts()}
    here = Path(__file__).read_text(encoding="utf-8")
    assert len(names) == 11
    assert {name for name in names if f'play("{name}")' not in here} == set()


def test_each_rung_is_short_and_leads_on_to_the_next():
    texts = [path.read_text(encoding="utf-8") for path in scripts()]
    assert max(text.count("\n") for text in texts) <= LONGEST
    for text, following in zip(texts, scripts()[1:], strict=False):
        linked = re.findall(r":doc:`(\d\d_\w+)`", text)
        assert linked[-1] == following.stem


def test_the_echos_level_over_noise_follows_the_sonar_equation(play):
    done, config = play("01_one_echo"), Config()
    place = 8.0 * np.array([[np.cos(done["angle"]), np.sin(done["angle"])]])
    callers = done["callers_of"](config, np.zeros(2))[:1]
    echo = arrivals_of_emission(np.zeros(3), np.array([0.75, 0.0]), place, callers, config)
    echo = through_piston(echo, **done["piston"])
    assert done["delay"] == pytest.approx(echo.delay[0], abs=1e-12)
    assert done["level_db"] == pytest.approx(echo.level_db[0], abs=1e-9)
    phases = 2 * np.pi * (echo.frequency[0] - 35e3) * np.arange(560) / 200e3
    expected = echo.level_db[0] + 20 * np.log10(abs(np.exp(1j * phases).sum())) - 10 * np.log10(560)
    spread = 20 / np.log(10) / (np.sqrt(2) * 10 ** (expected / 20))  # of noise along the echo [dB]
    assert done["answer"] == pytest.approx(expected, abs=3 * spread)
    still = echo.level_db[0] + 10 * np.log10(560)
    assert abs(done["answer"] - still) > 3 * spread, "without the Doppler shift it is another"


def test_the_frame_gives_the_range_of_landmark_1_to_a_centimetre(play):
    done = play("02_one_frame")
    gain = 10 * np.log10(done["length"] * 10)  # of matched filter and beam
    level = done["arrivals"].level_db[done["arrivals"].landmark == 1].max()
    assert level + gain > 20, "loud enough for a centimetre"
    assert done["answer"] < 0.01


def test_the_missions_ratio_to_the_bound_follows_from_its_track(play):
    done = play("03_one_mission")
    track = done["done"].tracks[1:]
    off = [track[f"{axis}_m"] - track[f"true_{axis}_m"] for axis in "xy"]
    bound = done["score"]["position_bound_m"]
    assert done["answer"] == pytest.approx(np.sqrt(np.mean(np.square(off).sum(axis=0))) / bound)
    assert done["score"]["position_floor_m"] < bound, "the floor is a part of what the bound counts"


@pytest.mark.filterwarnings("ignore:.*times the bound")  # as is said of it
def test_the_fused_mission_maps_the_landmarks_of_both_strategies(play):
    done = play("04_three_strategies")
    known = done["known"]
    assert known["fused"] == known["active"] | known["passive"]
    assert done["answer"] == len(known["passive"] - known["active"]) > 0


def test_the_posts_of_the_corridor_are_within_their_ellipses(play):
    done = play("05_your_own_world")
    places = dict(enumerate(np.array(done["posts"]), start=1))
    rows = [row for row in done["mapped"].iter_rows(named=True) if row["landmark"] in places]

    def surprises(turn=1.0):
        for row in rows:
            off = np.array([row["x_m"], row["y_m"]]) - turn * places[row["landmark"]]
            covariance = [[row["xx_m2"], row["xy_m2"]], [row["xy_m2"], row["yy_m2"]]]
            yield off @ np.linalg.solve(covariance, off)

    assert len(rows) == 12
    assert done["answer"] == pytest.approx(
        max(np.hypot(*(places[r["landmark"]] - [r["x_m"], r["y_m"]])) for r in rows)
    )
    limit = chi2.isf(0.001 / 12, 2)
    assert max(surprises()) < limit
    assert max(surprises(-1.0)) > limit, "posts half a turn round must fail"


def test_the_map_error_of_the_log_matches_its_covariance(play, tmp_path_factory):
    done = play("06_your_own_log")
    mapped = done["done"].landmarks
    stated = np.sqrt((mapped["xx_m2"] + mapped["yy_m2"]).mean())
    assert done["done"].summary["landmarks_full"].to_list() == [6]
    off = [abs(complex(r["x_m"], r["y_m"]) - done["posts"][r["landmark"] - 1])
           for r in mapped.iter_rows(named=True)]  # fmt: skip
    assert done["answer"] == pytest.approx(np.sqrt(np.mean(np.square(off))))
    assert done["answer"] < 3.3 * stated < 1.0  # 99.9 % of one normal: the map turns as a whole
    folder = tmp_path_factory.mktemp("mirrored")
    for name, text in done["files"].items():
        if name == "measurements.csv":
            text = re.sub(r"(?m)^(\S+?,\d+,)(-?)", lambda m: m[1] + "-" * (not m[2]), text)
        (folder / name).write_text(text + "\n")
    with pytest.warns(UserWarning, match="measurements do not fit what was expected"):
        control = pipistrelle.slam(folder)
    assert control.summary["map_rmse_m"][0] > 3.3 * stated, "bearings the wrong way round must fail"


@pytest.mark.filterwarnings("ignore:.*times the bound")  # as is said of it
def test_dead_reckoning_follows_the_commanded_path(play):
    done = play("07_your_own_filter")
    config, (x, y, heading) = Config(), Config().scenario.start
    reckoned = []
    for _ in range(500):
        x += 0.125 * 0.75 * np.cos(heading + 0.027)
        y += 0.125 * 0.75 * np.sin(heading + 0.027)
        heading += 0.125 * 0.75 * np.sin(0.027) / config.motion.wheelbase
        reckoned.append((x, y))
    truth = done["done"].tracks.filter(filter="ekf").select("true_x_m", "true_y_m").to_numpy()[1:]
    off = np.sqrt(np.mean(np.sum(np.square(reckoned - truth), axis=1)))
    assert done["error"]["__main__:DeadReckoning"] == pytest.approx(off, rel=1e-9)
    assert done["answer"] == pytest.approx(off / done["error"]["ekf"])
    rays = done["done"].landmarks.filter(status="partial")["filter"].unique().to_list()
    assert rays == ["__main__:BearingsOnly"]
    ranges = done["done"].measurements["range_m"]
    assert ranges.null_count() == 0, "what one filter forgets, the others are given"


def test_listening_gains_where_posts_are_few_and_not_where_they_are_many(play):
    done = play("08_your_own_study")
    tried = done["tried"]

    def gain(posts):
        here = pl.col("scenario.landmarks") == posts
        both = tried.trials.filter(here).sort("iteration", "strategy")["position_rmse_m"]
        active, fused = both.to_numpy().reshape(-1, 2).T
        return (active - fused).mean(), ttest_rel(active, fused, alternative="greater").pvalue

    few, many = gain(5), gain(45)
    assert done["answer"] == pytest.approx(few[0])
    assert few[1] < 0.01
    assert many[1] > 0.05, "where there is little to gain, nothing is shown"
    assert tried.answer[0].startswith("The scenario landmarks from 5 to 45 lowers the aligned")
    assert tried.answer[1].endswith("It is shown to fall with active invariant EKF.")


def test_one_process_shards_and_a_cluster_find_the_same(play, tmp_path_factory, monkeypatch):
    """The cluster's workers are threads, which start at once; the docs' build starts processes."""
    dask = pytest.importorskip("distributed", reason="Dask is not installed: the extra [cluster]")
    started = []

    def in_threads(**asked):
        started.append(asked["n_workers"])
        return local(**asked, processes=False)

    local = dask.LocalCluster
    monkeypatch.setattr(dask, "LocalCluster", in_threads)
    done = play("09_on_a_cluster")
    assert done["answer"] == 0
    assert started == [2]
    assert [table.height for table in done["tables"]] == [12, 12, 12]
    plan = tmp_path_factory.mktemp("control") / "loud.toml"
    plan.write_text(done["plan"])
    other = pipistrelle.study(plan, seed=8).trials.drop("wall_s", "cpu_s").sort("iteration", "case")
    assert not other.equals(done["tables"][0]), "another seed finds something else"


def test_two_excess_paths_place_a_landmark_with_the_deviation_of_information(play):
    """Bearings, ranges and excess paths by differences about what made them: all are exact."""
    done = play("10_when_not_only_where")
    places = np.concatenate([done["vehicle"], done["callers"].ravel(), done["landmark"]])

    def said(x):
        pose, one, two, landmark = x[:3], x[3:5], x[5:7], x[7:]
        ranges, bearings = done["range_and_bearing"](pose, np.array([one, two, landmark]))
        excess_paths = [done["excess_path_of"](pose[:2], landmark, caller) for caller in (one, two)]
        return np.array([*pose, *ranges[:2], *bearings, *excess_paths])

    slopes = [(said(places + d) - said(places - d)) / 2e-6 for d in 1e-6 * np.eye(9)]
    std = [0.05, 0.05, 0.02, 0.2, 0.2, 0.05, 0.05, 0.05, 0.05, 0.05]
    whitened = np.array(slopes).T / np.array(std)[:, None]
    covariance = np.linalg.inv(whitened.T @ whitened)[7:, 7:]
    expected = np.sqrt(np.linalg.eigvalsh(covariance)[-1])
    assert done["answer"] == pytest.approx(expected, rel=0.1), "but for what is bent"
    assert [len(belief.landmarks().landmark) for belief in done["beliefs"]] == [6, 3, 3]


def test_without_labels_all_posts_are_found_and_nothing_else(play):
    done = play("11_without_labels")
    assert (done["missed"], done["false"]) == (0, 0)
    assert done["answer"] < 0.15, "what dead reckoning and the start's heading leave"
    rows = [row.split(",") for row in done["measured"]]
    assert {row[1] for row in rows} == {""}, "no row has a label"
    posts, far = done["posts"], np.array([float(row[3]) for row in rows])
    assert len(rows) > 3 * len(posts)
    assert far.max() < 6.5


def sonar(folder, *words):
    """Run the small sonar of the page on water; return its scores by strategy."""
    harbour = str(EXAMPLES / "harbour.toml")
    assert obey(["run", "--settings", harbour, "--quiet", "-o", str(folder), *words]) == 0
    return {run["strategy"]: run for run in summary(folder)["runs"]}


def test_the_small_sonar_finds_its_way_in_the_harbour(tmp_path, capsys):
    runs = sonar(tmp_path / "short", "--duration", "20")
    assert capsys.readouterr().err == "", "no warning of what suits air"
    for run in runs.values():
        assert run["position_rmse_aligned_m"] < 0.1
    assert runs["fused"]["landmarks_full"] > 20
    assert runs["fused"]["map_rmse_aligned_m"] < 0.75, "half the length of a call"


@pytest.mark.slow
def test_the_small_sonars_table_matches_its_page(tmp_path):
    runs, page = sonar(tmp_path / "whole"), (EXAMPLES.parent / "docs" / "water.md").read_text()
    columns = [runs[name] for name in ("active", "fused", "passive")]
    for title, key, digits in (
        ("position RMSE, aligned", "position_rmse_aligned_m", 3),
        ("map RMSE, aligned", "map_rmse_aligned_m", 3),
        ("landmarks placed, of 31", "landmarks_full", 0),
    ):
        row = " | ".join(f"{run[key]:.{digits}f}" for run in columns)
        assert f"| {title} | {row} |" in page
