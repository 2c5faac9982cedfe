"""From Python: what is handed back, that it is the command line's, and that nothing surprises."""

import json
import subprocess
import sys
from pathlib import Path

import matplotlib.figure
import numpy as np
import polars as pl
import pytest

import pipistrelle
from pipistrelle import Config, InputError
from pipistrelle.__main__ import main
from pipistrelle.estimation.ekf.filter import EkfSlam
from pipistrelle.verbs.options import spell

SHORT = {"settings": "paper", "duration": 4.0, "landmarks": 10}
LOG = Path(__file__).parents[1] / "data" / "unicycle_log"


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pipistrelle"])


@pytest.fixture(scope="module")
def done():
    return pipistrelle.run(**SHORT, filters="both", fastslam__particles=7)


@pytest.mark.usefixtures("undrawn")
def test_tables_equal_the_result_folder_of_the_command_line(capsys, done):
    words = ("--duration", "4", "--landmarks", "10", "--filter", "both", "--particles", "7")
    assert main(["run", "--settings", "paper", *words, "-o", "one"]) == 0
    capsys.readouterr()
    for name, mine in (
        ("steps", done.tracks),
        ("landmarks", done.landmarks),
        ("measurements", done.measurements),
    ):
        assert mine.equals(pl.read_parquet(f"one/{name}.parquet"))
    runs = json.loads(Path("one/summary.json").read_text())["runs"]
    for row, run in zip(done.summary.rows(named=True), runs, strict=True):
        assert {k: v for k, v in row.items() if k != "wall_s"} == {
            k: v for k, v in run.items() if k not in ("wall_s", "ignored_rows")
        }
    loaded = pipistrelle.load("one")
    assert loaded.tracks.equals(done.tracks)
    assert loaded.summary.drop("wall_s").equals(done.summary.drop("wall_s"))


@pytest.mark.usefixtures("undrawn")
def test_nothing_is_written_unless_a_folder_is_named(done, tmp_path):
    assert done.folder is None
    assert list(tmp_path.iterdir()) == []
    kept = pipistrelle.run(**SHORT, strategies="fused", output="one")
    assert kept.folder == Path("one")
    assert (Path("one") / "summary.json").exists()
    with pytest.raises(InputError, match="one"):
        pipistrelle.run(**SHORT, output="one")
    again = pipistrelle.run(**SHORT, strategies="fused", output="one", overwrite=True)
    assert again.tracks.equals(kept.tracks)


@pytest.mark.parametrize(
    "asked",
    [
        {"rays__exponent": 8.0, "seed": 3},
        {"rays": {"exponent": 8.0}, "seed": 3},
        {"rays": {"exponent": 8.0, "prune_threshold": 1e-5}, "seed": 3},
    ],
)
def test_settings_are_keywords_or_sections(asked):
    found = pipistrelle.run(**SHORT, strategies="fused", **asked)
    same = pipistrelle.run({"rays.exponent": 8.0, "seed": 3}, **SHORT, strategies="fused")
    assert found.tracks.equals(same.tracks)


def test_settings_to_start_from_may_be_settings_a_table_or_a_file(done):
    Path("mine.toml").write_text("seed = 3\nfilter.bearing_std = 0.1\n")
    config = Config(seed=3, filter={"bearing_std": 0.1})
    bases = (config, {"seed": 3, "filter": {"bearing_std": 0.1}}, "mine.toml", Path("mine.toml"))
    first, *others = (pipistrelle.run(base, **SHORT, strategies="passive").tracks for base in bases)
    assert all(one.equals(first) for one in others)
    over = pipistrelle.run(config, seed=4, **SHORT, strategies="passive").tracks
    assert not over.equals(first)


@pytest.mark.parametrize(
    ("words", "asked", "said"),
    [
        ((), {"rays__powr": 8.0}, "rays__powr: no such setting; did you mean rays__exponent?"),
        (
            (),
            {"bearing_std": 8.0},
            "did you mean filter__bearing_std or bag__bearing_std or association__max_angle_std",
        ),
        ((), {"rays__exponent": -1.0}, "rays__exponent: found -1.0, expected greater than 0"),
        ((), {"seed": 1.5}, "seed: found 1.5, expected a valid integer"),
        ((), {"rays": 3}, "rays: found 3, expected a section of settings"),
        ((), {"rays": {"exponent": 2.0}, "rays__exponent__x": 2}, "found exponent as a value too"),
        (({"ray.merge": 3.0},), {}, "config: ray.merge: no such setting; did you mean rays.merge?"),
        (("nowhere.toml",), {}, "nowhere.toml: found no such file"),
        ((7,), {}, "config: found 7, expected a Config, a mapping, a name or the path"),
        ((), {"landmarks": [[1, 2], [3, 4]]}, "and name it by world="),
        ((), {"strategies": "activ"}, "strategies: found 'activ', expected 'active', 'fused', 'pa"),
        ((), {"strategies": ["fused", 3]}, "strategies: found 3"),
        ((), {"filters": "ukf"}, "filters: found 'ukf', expected one of ekf"),
        ((), {"filters": "ikef"}, "smoother, both, all, module:Class; did you mean 'iekf'?"),
        ((), {"filters": ["ekf", "botch"]}, "did you mean 'both'?"),
        ((), {"world": "nowhere"}, "nowhere: found no such folder"),
        ((), {"duration": 0.1}, "duration: found 0.1, expected at least one frame (0.5 s)"),
        ((), {"duration": 9.0, "scenario__steps": 3}, "duration 9 and scenario__steps are one set"),
        ((), {"landmarks": 9, "scenario__landmarks": 3}, "landmarks and scenario__landmarks are"),
        ((), {"duration": float("nan")}, "duration: found nan"),
        ((), {"duration": "60"}, "duration: found '60', expected a number"),
        ((), {"beamwidth": [60.0]}, "beamwidth: found [60.0], expected a number"),
        ((), {"strategies": []}, "strategies: found (), expected 'active'"),
        ((), {"strategies": None}, "strategies: found None, expected 'active'"),
        ((), {"filters": []}, "filters: found none, expected an estimator's name"),
        ((), {"word": "here"}, "word: no such setting; did you mean world?"),
        ((), {"filter": "iekf"}, "filter: found 'iekf', expected a section of settings; did you"),
    ],
)
def test_mistakes_are_explained_by_the_names_of_keywords(words, asked, said):
    with pytest.raises(InputError) as refused:
        pipistrelle.run(*words, **asked)
    assert said in str(refused.value)


@pytest.mark.usefixtures("undrawn")
def test_a_folder_that_is_not_empty_is_refused_in_pythons_words(done, tmp_path):
    (tmp_path / "mine.txt").write_text("kept")
    for ask in (done.save, lambda folder: pipistrelle.run(duration=4.0, output=folder)):
        with pytest.raises(InputError, match="is not empty") as refused:
            ask(tmp_path)
        assert "-o DIR" not in str(refused.value)
        assert "--" not in str(refused.value)
    assert (tmp_path / "mine.txt").read_text() == "kept"
    place = done.save(tmp_path / "ours")
    message = r"save\(DIR\), or add overwrite=True to replace the results"
    with pytest.raises(InputError, match=message):
        done.save(place)


@pytest.mark.usefixtures("undrawn")
def test_a_log_is_solved_as_by_the_command_line(capsys):
    found = pipistrelle.slam(LOG, strategies="all", beamwidth=90.0, rays__exponent=4.0)
    words = ("--strategy", "all", "--beamwidth", "90", "--rays.exponent", "4.0", "-o", "one")
    assert main(["slam", str(LOG), *words]) == 0
    capsys.readouterr()
    assert found.tracks.equals(pl.read_parquet("one/steps.parquet"))
    assert found.measurements.equals(pl.read_parquet("one/measurements.parquet"))
    with pytest.raises(InputError, match="filter__range_std: the log decides this"):
        pipistrelle.slam(LOG, filter__range_std=0.1)
    with pytest.raises(InputError, match="air__temperature_c: means nothing to a recorded log"):
        pipistrelle.slam(LOG, air__temperature_c=1.0)
    with pytest.raises(InputError, match="beamwidth: found 0"):
        pipistrelle.slam(LOG, beamwidth=0.0)


@pytest.mark.usefixtures("undrawn")
def test_folders_saved_from_python_equal_the_command_lines(capsys):
    short = {"duration": 2.0, "landmarks": 5, "strategies": "fused", "receiver__elements": 2}
    saved = {"save_log": "log", "save_world": "world", "save_sound": "sound"}
    pipistrelle.run(settings="paper", **short, **saved, frames="0:2", sound_bits=16)
    words = ("--settings", "paper", "--duration", "2", "--landmarks", "5", "--strategy", "fused")
    words = (*words, "--receiver.elements", "2", "--frames", "0:2", "--sound-bits", "16")
    flags = [word for name, it in saved.items() for word in (spell(name), f"{it}2")]
    assert main(["run", *words, *flags, "-o", "one", "--quiet"]) == 0
    capsys.readouterr()
    for name in saved.values():
        assert contents(name) == contents(f"{name}2")
    assert {"recording.wav", "recording.toml", "truth.csv"} <= contents("sound").keys()
    heard, solved = pipistrelle.hear("sound"), pipistrelle.slam("log")
    assert heard.measurements.height > 0
    assert solved.tracks.height == 1 + 16
    same = pipistrelle.run(settings="paper", **short, world="world")
    assert same.landmarks["landmark"].n_unique() == 6


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"frames": "0:2"}, "frames: found 0:2, which is of save_sound; add it"),
        ({"output": "one", "save_log": "./one"}, "save_log: one is that of output; name another"),
        ({"animate": "gif"}, "animate: found 'gif', expected a result folder for it; name one by"),
        ({"save_bag": True}, "save_bag: found True, expected a result folder for it; name one by"),
        ({"particles": 9}, "particles: found 9, but filters is smoother, which has none; add filt"),
    ],
)
def test_options_without_their_counterpart_are_rejected_by_keyword(asked, said, tmp_path):
    with pytest.raises(InputError) as refused:
        pipistrelle.run(duration=2.0, landmarks=5, strategies="fused", **asked)
    assert said in str(refused.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("undrawn")
def test_a_bag_and_a_film_are_written_from_python(done):
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    pipistrelle.slam(LOG, output="one", save_bag=True, animate="gif")
    assert {"mission.mcap", "mission.gif"} <= contents("one").keys()
    assert "mission.mcap" in contents(done.save("two", save_bag=True))


def test_figures_and_films_are_drawn_of_the_mission_and_shown_by_a_notebook(done):
    figure = done.figure()
    assert isinstance(figure, matplotlib.figure.Figure)
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert done.animate("one.gif").read_bytes()[:6] == b"GIF89a"
    with pytest.raises(InputError, match=r"found the ending '.png'"):
        done.animate("one.png")


def test_loaded_results_are_done_again_where_they_must_be_drawn(done):
    pipistrelle.run(**SHORT, strategies="fused", output="one")
    loaded = pipistrelle.load("one")
    assert loaded.animate("two.gif").exists()
    track = Path("one/track_fused_ekf.tum")
    track.write_text(track.read_text().replace("1", "2"))
    with pytest.warns(UserWarning, match=r"track_fused_ekf\.tum"):
        pipistrelle.load("one").figure()


def test_values_that_are_not_paths_are_rejected(tmp_path):
    for ask in (pipistrelle.load, pipistrelle.slam):
        with pytest.raises(InputError, match="found 7, expected the path of a folder"):
            ask(7)
    with pytest.raises(InputError, match="a world of your own is named by world"):
        pipistrelle.run(str(tmp_path))


@pytest.mark.usefixtures("undrawn")
def test_a_table_that_is_cut_or_none_is_refused_by_name(done):
    table = done.save("one") / "steps.parquet"
    table.write_bytes(table.read_bytes()[:100])
    with pytest.raises(InputError, match=r"one/steps\.parquet: found no table that is whole"):
        _ = pipistrelle.load("one").tracks
    table.unlink()
    table.symlink_to("/dev/null")
    with pytest.raises(InputError, match=r"one/steps\.parquet: found a pipe"):
        _ = pipistrelle.load("one").tracks


def test_a_notebook_shows_an_input_error_in_a_line():
    assert InputError("rays__powr: no such setting")._render_traceback_() == [
        "InputError: rays__powr: no such setting"
    ]


def test_numbers_may_be_numpys():
    few = pipistrelle.run(
        settings="paper",
        seed=np.int64(3),
        duration=np.float32(4.0),
        landmarks=np.int64(10),
        strategies="fused",
        rays__range_bounds=np.array([0.5, 15.0]),
    )
    same = pipistrelle.run(seed=3, **SHORT, strategies="fused", rays__range_bounds=[0.5, 15.0])
    assert few.tracks.equals(same.tracks)


def test_a_notebook_is_shown_the_figure_and_the_scores(done):
    html = done._repr_html_()
    assert html.startswith('<img alt="The mission" src="data:image/png;base64,')
    assert "position_rmse_m" in html
    assert "fastslam" in repr(done)


def test_frames_go_on_to_other_libraries(done):
    pytest.importorskip("xarray", reason="the extra export is not installed")
    data = done.to_xarray()
    assert data.sizes["strategy"] == 3
    one = data.sel(strategy="fused", filter="ekf").x_m.values
    mine = done.tracks.filter(pl.col("strategy") == "fused", pl.col("filter") == "ekf")["x_m"]
    np.testing.assert_array_equal(one, mine.to_numpy())


def test_importing_the_package_loads_no_numpy_and_lists_its_doors():
    code = (
        "import sys, pipistrelle; print(sorted({'numpy', 'polars', 'pydantic'} & set(sys.modules)),"
        " dir(pipistrelle)); pipistrelle.nothing"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    doors = "[] ['Config', 'InputError', 'Slam', '__version__', 'hear', 'load', 'look', 'run', "
    assert ran.stdout.startswith(doors + "'slam', 'study']")
    assert "module 'pipistrelle' has no attribute 'nothing'" in ran.stderr


class Deaf(EkfSlam):
    """The EKF that hears nothing."""

    def update(self, belief, scan, rng=None):
        return belief


@pytest.mark.usefixtures("undrawn")
def test_a_filter_may_be_a_class_and_goes_by_its_name(done):
    found = pipistrelle.run(**SHORT, strategies="fused", filters=["ekf", Deaf], output="one")
    name = f"{Deaf.__module__}:Deaf"
    assert found.summary["filter"].to_list() == ["ekf", name]
    assert found.summary["landmarks_full"][1] == 0 < found.summary["landmarks_full"][0]
    assert Path("one/track_fused_Deaf.tum").exists()
    alone = pipistrelle.slam(LOG, filters=Deaf)
    assert alone.summary["filter"].to_list() == [name]
    again = pipistrelle.load("one")
    assert again.tracks.equals(found.tracks)


def test_a_class_that_workers_cannot_import_is_rejected():
    class Hidden(Deaf):
        """Of this function alone."""

    with pytest.raises(InputError, match="define it outside of functions"):
        pipistrelle.run(**SHORT, filters=Hidden)
    for wrong in (3, ["ekf", 3], [Deaf, object()]):
        with pytest.raises(InputError, match="expected an estimator's name or its class"):
            pipistrelle.run(**SHORT, filters=wrong)
    with pytest.raises(InputError, match="lacks init, predict, update"):
        pipistrelle.run(**SHORT, filters=int)


CALLERS = ({"name": "bee", "frequency": 25000.0, "course": "circle"},)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("kind", ["a log", "a caller that moves", "a world of one's own"])
def test_loaded_results_are_saved_with_equal_files(kind, tmp_path):
    if kind == "a log":
        pipistrelle.slam(LOG, beamwidth=90.0, output="one")
    elif kind == "a caller that moves":
        timed = {"listening": {"excess_paths": True}, "callers": CALLERS}
        pipistrelle.run(**SHORT, strategies="fused", **timed, output="one")
    else:
        Path("posts").mkdir()
        Path("posts/landmarks.csv").write_text("landmark,x,y\n1,2.5,0\n2,-1,4\n")
        pipistrelle.run(duration=2.0, strategies="fused", world="posts", output="one")
    pipistrelle.load("one").save("two")
    one, two = (contents(name) for name in ("one", "two"))
    assert one.keys() == two.keys()
    alike = one.keys() - {"README.md", "SHA256SUMS", "summary.json"}
    alike -= {name for name in alike if name.startswith("mission.")}
    assert {name for name in alike if one[name] != two[name]} == set()
    first, second = (without_times(files["summary.json"]) for files in (one, two))
    assert first == second
    assert ("log" in first) == (kind == "a log")


def contents(folder):
    """Every file below a folder."""
    paths = [path for path in Path(folder).rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def without_times(text):
    """A summary, but for the time that estimates took."""
    summary = json.loads(text)
    for run in summary["runs"]:
        del run["wall_s"]
    return summary
