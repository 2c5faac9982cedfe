"""Studies from Python: the command line's tables, in a folder of one's own or a passing one."""

import html
import json
import sys
import tomllib
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import pipistrelle
from pipistrelle import InputError
from pipistrelle.__main__ import main
from reference.studies import SMALL
from report.drawing import draw_only

FEW = {"scenario": {"steps": 8, "landmarks": 5}}
TIMES = ("wall_s", "cpu_s")


@pytest.fixture(autouse=True)
def small(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pipistrelle"])
    Path("small.toml").write_text(SMALL)


def test_tables_of_a_study_equal_the_command_lines(capsys):
    found = pipistrelle.study("small.toml", iterations=2)
    assert main(["study", "small.toml", "--iterations", "2", "--workers", "1", "-o", "s"]) == 0
    capsys.readouterr()
    loaded = pipistrelle.load("s")
    assert found.trials.drop(TIMES).equals(loaded.trials.drop(TIMES))
    assert found.steps.equals(loaded.steps)
    assert found.landmarks.equals(loaded.landmarks)
    assert loaded.plan.iterations == 2
    kept = found.folder
    assert kept.is_dir()
    del found
    assert not kept.exists()


def test_its_summary_is_the_mean_over_the_worlds():
    found = pipistrelle.study("small.toml", iterations=3, output="s")
    assert found.summary.height == 10
    assert found.summary["worlds"].unique().to_list() == [3]
    row = found.summary.row(0, named=True)
    mine = found.trials.filter(pl.col("case") == row["case"])
    assert row["position_rmse_m"] == pytest.approx(mine["position_rmse_m"].mean())
    assert "position_rmse_m" in found._repr_html_()
    assert "Study small" in repr(found)


def test_a_study_continues_and_settings_override_its_plan():
    one = pipistrelle.study("small.toml", iterations=1, output="s", scenario__landmarks=9)
    more = pipistrelle.study("small.toml", iterations=2, output="s", scenario={"landmarks": 9})
    assert more.trials.filter(pl.col("iteration") == 0).equals(one.trials)
    assert more.plan.config.scenario.landmarks == 9
    with pytest.raises(InputError, match="is the plan of another study"):
        pipistrelle.study("small.toml", output="s")
    with pytest.raises(InputError, match="scenario__landmark: no such setting; did you mean"):
        pipistrelle.study("small.toml", scenario__landmark=9)
    with pytest.raises(InputError, match="nowhere: found no such file"):
        pipistrelle.study("nowhere")


def test_a_plan_as_a_table_is_accepted_and_its_mistakes_named():
    told = tomllib.loads(SMALL)
    from_file = pipistrelle.study("small.toml", iterations=1)
    assert pipistrelle.study(told, iterations=1).plan == from_file.plan
    levels = {"iterations": 1, "strategies": ("fused",), "filters": ["ekf"], "config": FEW}
    for values in ([30.0, 40.0], (30.0, 40.0), np.linspace(30.0, 40.0, 2)):
        found = pipistrelle.study(levels | {"grid": {"beacon": {"level_db": values}}})
        assert found.trials["beacon.level_db"].to_list() == [30.0, 40.0]
    for changes, why in (
        ({"grid": {"beacon.level": [30.0]}}, r"plan: grid\.beacon\.level: no such setting"),
        ({"grid": {"beacon.level_db": 30.0}}, r"plan: grid\.beacon\.level_db: found 30"),
        ({"worlds": 3}, "plan: found the unknown key 'worlds'"),
        ({"strategies": "fused"}, "plan, key 'strategies': found"),
        ({"iterations": None}, "plan, key 'iterations': found"),
    ):
        with pytest.raises(InputError, match=why):
            pipistrelle.study(levels | changes)
    with pytest.raises(InputError, match="plan: found no key 'iterations'"):
        pipistrelle.study({})


def test_answer_and_figure_equal_the_report(monkeypatch):
    draw_only(monkeypatch)
    found = pipistrelle.study("small.toml", iterations=2, output="s")
    page = found.report("page")
    assert page == Path("page/index.html")
    assert "<h1" in page.read_text()
    assert found.answer == json.loads(Path("page/summary.json").read_text())["answer"]
    assert found.answer[0] in html.unescape(page.read_text())
    assert "position RMSE" in [axes.get_title(loc="left") for axes in found.figure().axes]


def test_shards_on_one_folder_and_a_cluster_do_the_whole(monkeypatch):
    whole = pipistrelle.study("small.toml").trials.drop(TIMES)
    for i, done in ((1, {1}), (0, {0, 1, 2})):
        part = pipistrelle.study("small.toml", shard=(i, 2), output="s")
        assert set(part.trials["iteration"]) == done
    assert part.trials.drop(TIMES).equals(whole)
    asked = []
    place = "pipistrelle.experiments.studies.study.run_study"
    monkeypatch.setattr(place, lambda *a, **k: asked.append(k))
    with pytest.raises(InputError):  # nothing was done
        pipistrelle.study("small.toml", scheduler="tcp://here:1", workers=3, output="t")
    (given,) = asked
    assert (given["scheduler"], given["workers"], given["shard"]) == ("tcp://here:1", 3, (0, 1))


@pytest.mark.parametrize("shard", [(2, 2), (-1, 2), (0, 0), (0.5, 2), "0/2", (1,), None])
def test_a_share_that_is_none_is_refused(shard):
    with pytest.raises(InputError, match=r"shard: found .*, expected \(i, n\)"):
        pipistrelle.study("small.toml", shard=shard, output="s")
    assert not Path("s").exists()
