"""Worlds of one's own: `run --world`, `run --save-world`, and a study that names some."""

import shutil
from pathlib import Path

import polars as pl
import pytest

from pipistrelle.experiments.runs.replay import rerun
from reference.command_line import SHORT, contents, summary

pytestmark = pytest.mark.usefixtures("undrawn")

PLAN = """\
format = 1
name = "worlds"
iterations = 2
strategies = ["fused"]
filters = ["ekf"]
[grid]
"scenario.world" = ["here/drawn", "here/posts [1]"]
"""


@pytest.fixture
def here(short_run, short_world):
    """Two worlds in a folder: one drawn and kept, one of a user's own."""
    shutil.copytree(short_world, "here/drawn")
    shutil.copytree(short_run, "one")
    own = Path("here/posts [1]")
    own.mkdir()
    (own / "landmarks.csv").write_text("landmark,x,y\n1,3,1\n2,6,-1\n3,9,1\n")
    (own / "path.csv").write_text("x,y\n0,0\n6,0\n")
    (own / "world.toml").write_text(
        "format = 1\n[config]\nair.temperature_c = 10.0\n"
        "[[callers]]\nname = 'mate'\nfrequency = 25e3\nlevel_db = 45.0\nplace = [3.0, 8.0]\n"
    )
    return Path("here")


def found(folder):
    """What a folder of results holds of tracks and maps."""
    kept = contents(folder)
    return {name: text for name, text in kept.items() if name.startswith(("track", "map"))}


def test_a_saved_world_is_heard_again_to_the_bit(obey, here):
    words = ("--settings", "paper", "--world", here / "drawn")
    assert obey("run", *words, "-o", "two")[0] == 0
    assert found("two") == found("one")
    assert len(found("two")) == 6
    copy = Path("two/worlds/drawn")
    assert contents(copy).keys() == {"world.toml", "landmarks.csv", "path.csv"}
    shutil.rmtree(here)  # the results hold all that they need
    assert obey("run", "--config", "two/config.toml", "-o", "three")[0] == 0
    assert found("three") == found("one")


def test_a_users_world_is_simulated_from_its_files(obey, here):
    words = ("--settings", "paper", "--strategy", "fused")
    status, printed, _ = obey("run", "--world", here / "posts [1]", *words)
    assert status == 0
    (run,) = summary(printed.splitlines()[-1])["runs"]
    assert run["landmarks_total"] == 4
    rows = Path(printed.splitlines()[-1], "map_fused_ekf.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows[1:]] == ["1", "2", "3", "4"]
    status, printed, _ = obey("config", "show", "--world", here / "posts [1]")
    assert "steps = 64 " in printed
    assert "landmarks = 3 " in printed
    assert "temperature_c = 10.0 " in printed


def test_flags_override_a_file_that_overrides_a_world(obey, here):
    Path("cold.toml").write_text('scenario.world = "here/posts [1]"\nair.temperature_c = 1.0\n')
    _, printed, _ = obey("config", "show", "--config", "cold.toml")
    assert "temperature_c = 1.0 " in printed
    words = ("--config", "cold.toml", "--air.temperature-c", "2.0", "--duration", "4")
    _, printed, _ = obey("config", "show", *words)
    assert "temperature_c = 2.0 " in printed
    assert "steps = 32 " in printed


def test_a_world_named_in_a_file_is_relative_to_the_file(obey, here):
    (here / "mine.toml").write_text('scenario.world = "drawn"\n')
    words = ("--settings", "paper", "--settings", "here/mine.toml")
    assert obey("run", *words, "-o", "two")[0] == 0
    assert found("two") == found("one")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--world", "nowhere"), "nowhere: found no such folder"),
        (("--world", "here/posts [1]", "--landmarks", "9"), "--landmarks: found 9, but the world"),
        (("--world", "here/drawn", "--duration", "100"), "ends after 32 steps of 0.125 s"),
        (
            ("--world", "here/drawn", "--scenario.world", "here/posts [1]"),
            "--world and --scenario.world are one setting",
        ),
        (("--save-world", "here/posts [1]"), "holds no world of Pipistrelle"),
        (("--save-world", "here/posts [1]", "--overwrite"), "holds no world of Pipistrelle"),
        (("--save-world", "two", "-o", "two"), "two is that of --output; name another"),
        (("--save-world", "a", "--save-log", "a"), "a is that of --save-log; name another"),
        (("--save-world", "one", "--overwrite"), "one: holds results of Pipistrelle, which a wor"),
    ],
)
def test_invalid_worlds_are_rejected(refused, here, words, said):
    before = contents("here/posts [1]")
    assert said in refused("run", *words)
    assert contents("here/posts [1]") == before


def test_a_saved_world_is_replaced_unless_it_was_changed(obey, refused, here):
    again = ("run", *SHORT, "--seed", "8", "--save-world", here / "drawn", "--overwrite")
    assert obey(*again, "-o", "two")[0] == 0
    path = here / "drawn" / "landmarks.csv"
    path.write_text(path.read_text() + "11,1,1\n")
    assert "was changed since Pipistrelle wrote it" in refused(*again, "-o", "three")


STUDY = ("study", "worlds.toml", "--workers", "1", "-o", "s")


def trials(folder):
    columns = ["iteration", "case", "scenario.world", "position_rmse_m", "landmarks_total"]
    return pl.read_parquet(f"{folder}/trials/*.parquet").select(columns)


@pytest.mark.usefixtures("here")
def test_a_study_may_name_worlds_and_keeps_them(obey):
    Path("worlds.toml").write_text(PLAN)
    assert obey(*STUDY)[0] == 0
    rows = trials("s")
    assert rows["scenario.world"].unique(maintain_order=True).to_list() == ["drawn", "posts [1]"]
    assert rows["landmarks_total"].max() <= 11
    assert contents("s/worlds/posts [1]") == contents("here/posts [1]")
    # It goes on without the originals, from its own plan.
    shutil.rmtree("here")
    words = ("study", "s/plan.toml", "--workers", "1", "-o", "s", "--iterations", "3")
    assert obey(*words)[0] == 0
    again = trials("s")
    assert again.height == 6
    assert again.filter(pl.col("iteration") < 2).equals(rows)


@pytest.mark.usefixtures("here")
def test_a_study_with_changed_worlds_does_not_continue(obey):
    Path("worlds.toml").write_text(PLAN)
    assert obey(*STUDY)[0] == 0
    path = Path("here/posts [1]/landmarks.csv")
    path.write_text(path.read_text() + "4,1,4\n")
    status, _, said = obey(*STUDY, "--iterations", "3")
    assert status == 2
    assert "is the plan of another study" in said
    assert "worlds/posts [1]" in said
    assert trials("s").height == 4


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    ("grid", "said"),
    [
        ('"scenario.world" = ["nowhere"]', "nowhere: found no such folder"),
        ('"scenario.world" = "here/drawn"', "grid.scenario.world: found 'here/drawn', expected a"),
        ('"scenario.world" = ["here/drawn", "here/drawn"]', "found 'drawn' twice"),
        ('"scenario.world" = [3]', "grid.scenario.world: found 3, expected a valid string"),
        ('"scenario.world" = ["here/drawn", "copy/drawn"]', "found two worlds called drawn"),
        (
            '"scenario.world" = ["here/drawn"]\n"scenario.landmarks" = [3, 4]',
            "grid.scenario.landmarks: found 3, but the world's landmarks.csv has 10",
        ),
    ],
)
def test_a_grid_of_worlds_is_refused_where_it_is_wrong(refused, grid, said):
    shutil.copytree("here/drawn", "copy/drawn")
    path = Path("copy/drawn/landmarks.csv")
    path.write_text("\n".join(path.read_text().splitlines()[:4]) + "\n")
    head, _, _ = PLAN.partition("[grid]")
    Path("worlds.toml").write_text(f"{head}[grid]\n{grid}\n")
    assert said in refused(*STUDY)
    assert not Path("s").exists()


@pytest.mark.usefixtures("here")
def test_trials_of_a_study_in_one_world_differ_only_by_noise(obey):
    Path("worlds.toml").write_text(
        PLAN.partition("[grid]")[0] + '[config]\nscenario.world = "here/posts [1]"\n'
    )
    assert obey(*STUDY)[0] == 0
    table = pl.read_parquet("s/trials/*.parquet")
    assert table["landmarks_total"].to_list() == [4, 4]
    assert table["position_rmse_m"].n_unique() == 2


def test_a_mission_in_ones_own_world_is_done_again_from_its_folder(obey, here):
    assert obey("run", "--world", here / "posts [1]", "--strategy", "fused", "-o", "two")[0] == 0
    shutil.rmtree(here)
    done = rerun(Path("two"))
    assert done.difference == ""
    assert [caller.name for caller in done.callers] == ["mate"]
