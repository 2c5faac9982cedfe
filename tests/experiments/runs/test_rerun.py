"""A mission done again from its folder is the same, bit for bit, or a line says that it is not."""

import json
import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from pipistrelle.__main__ import main
from pipistrelle.experiments.runs.replay import rerun
from reference.command_line import SHORT
from reference.pictures import without_picture
from reference.refused import refusal_of

OWN = Path(__file__).parents[2] / "data"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Result folders of a run and of two replays of its log, and the log."""
    place = tmp_path_factory.mktemp("made")
    with without_picture() as patch:
        patch.setattr(sys, "argv", ["pipistrelle"])
        words = {
            "run": ("run", *SHORT, "--seed", "5", "--filter", "both", "--beamwidth", "60",
                    "--filter.gate", "0.99", "--save-log", place / "log"),
            "slam": ("slam", place / "log", "--strategy", "all", "--beamwidth", "70",
                     "--gate", "0.9", "--rays.range-ratio", "5"),
            "robot": ("slam", OWN / "mrclam_made_up", "--robot", "1"),
        }  # fmt: skip
        for name, line in words.items():
            assert main([*map(str, line), "--quiet", "-o", str(place / name)]) == 0
    return place


@pytest.fixture
def folders(made, tmp_path, monkeypatch):
    """The same to be changed, as they were left but for where they are."""
    shutil.copytree(made, tmp_path / "made")
    monkeypatch.chdir(tmp_path / "made")
    summary = json.loads(Path("slam/summary.json").read_text())
    summary["log"]["path"] = str(tmp_path / "made" / "log")
    Path("slam/summary.json").write_text(json.dumps(summary))
    return tmp_path / "made"


def refused(folder, **options):
    return refusal_of(lambda: rerun(Path(folder), **options))


@pytest.mark.parametrize("name", ["run", "slam", "robot"])
def test_reruns_give_the_tracks_of_the_folder_to_the_bit(made, name):
    done = rerun(made / name)
    assert done.difference == ""
    kept = json.loads((made / name / "summary.json").read_text())["runs"]
    assert [(t.strategy, t.filter) for t in done.trials] == [
        (run["strategy"], run["filter"]) for run in kept
    ]
    for trial, run in zip(done.trials, kept, strict=True):
        assert trial.scores.position_rmse_m == run["position_rmse_m"]
        assert trial.scores.landmarks_full == run["landmarks_full"]
        assert trial.scores.gated == run["gated"]


@pytest.mark.skipif(os.name == "nt", reason="all names are Unicode there")
@pytest.mark.parametrize("name", [b"log\xff", b"log\n<title>", "log\u202egol".encode()])
def test_results_of_a_log_with_an_odd_name_are_viewed_and_compared(folders, name, capsys, undrawn):
    log = os.fsdecode(name)
    Path("log").rename(log)
    assert main(["slam", log, "--filter", "ekf", "--quiet", "-o", "one"]) == 0
    kept = json.loads(Path("one/summary.json").read_bytes())["log"]
    kept["path"].encode()
    assert rerun(Path("one")).source == kept
    assert main(["view", "one", "--quiet"]) == 0
    page = Path("one/view.html").read_text(encoding="utf-8")
    assert "\u202e" not in page
    assert page.count("<title>") == 1
    assert main(["compare", "one", "robot", "-o", "both", "--quiet"]) == 0
    assert capsys.readouterr().err == ""


def test_a_simulated_mission_comes_with_its_world(made):
    done = rerun(made / "run")
    assert done.log is None
    assert done.scenario is not None
    assert [caller.name for caller in done.callers] == ["beacon"]
    assert np.degrees(done.beamwidth) == pytest.approx(60.0)
    assert len(done.drive.truth.landmarks[0]) == 11
    assert done.config.filter.gate == 0.99


def test_a_recorded_one_comes_with_its_log_and_the_beam_that_hid_its_ranges(made):
    done = rerun(made / "slam")
    assert done.scenario is None
    assert done.log is not None
    assert done.log.name == "log"
    assert done.callers == ()
    assert np.degrees(done.beamwidth) == pytest.approx(70.0)
    assert done.config.filter.gate == 0.9
    assert rerun(made / "robot").beamwidth is None


def test_the_watcher_sees_every_frame(made):
    seen, told = [], []
    done = rerun(
        made / "run",
        watch=lambda *frame: seen.append(frame[:2]),
        progress=lambda *stage: told.append(stage[0]),
    )
    assert len(seen) == sum(len(trial.scans) for trial in done.trials) == 48
    assert {"listening", "fused ekf", "passive fastslam"} <= set(told)


def test_a_changed_track_is_reported_with_its_difference(folders):
    path = Path("run/track_fused_ekf.tum")
    first, *others = path.read_text().splitlines()
    time, x, *rest = first.split()
    path.write_text("\n".join([" ".join([time, str(float(x) + 0.25), *rest]), *others]) + "\n")
    found = rerun(Path("run")).difference
    assert found == f"{path}: is not as it is found now, by up to 0.25 m"


def test_missing_and_unreadable_tracks_are_reported(folders):
    Path("run/track_active_ekf.tum").unlink()
    Path("run/track_fused_fastslam.tum").write_text("not a track\n")
    found = rerun(Path("run")).difference
    assert found == "run/track_active_ekf.tum: cannot be read, nor are 1 more"


def test_changed_settings_are_reported_and_followed(folders):
    path = Path("run/config.toml")
    path.write_text(re.sub(r"(?m)^bearing_std = .*$", "bearing_std = 0.5", path.read_text()))
    done = rerun(Path("run"))
    assert done.config.filter.bearing_std == 0.5
    assert re.fullmatch(
        r"run/track_active_ekf.tum: is not as it is found now, by up to [\d.e-]+ m, nor are 5 "
        r"more; config.toml was changed since",
        done.difference,
    )


def test_another_version_is_reported(folders):
    summary = json.loads(Path("run/summary.json").read_text())
    Path("run/summary.json").write_text(json.dumps({**summary, "version": "0.0.9"}))
    assert rerun(Path("run")).difference == "", "what is the same is the same"
    Path("run/track_fused_ekf.tum").write_text("0 0 0 0 0 0 0 1\n")
    assert "; it was written by version 0.0.9, this is " in rerun(Path("run")).difference


def test_a_log_that_is_gone_is_asked_for_and_may_be_elsewhere(folders):
    Path("log").rename("moved [1] away")
    said = refused("slam")
    assert said.startswith("slam/summary.json: log.path: found ")
    assert "which is not there, expected the log that was solved; restore it" in said
    assert rerun(Path("slam"), log=Path("moved [1] away")).difference == ""
    assert "option --log: found nowhere, which is not there" in refused("slam", log=Path("nowhere"))


@pytest.mark.parametrize(
    ("gone", "said"),
    [
        ([], "odometry.csv was changed"),
        (["landmarks.csv"], "landmarks.csv is gone, and 1 more"),
        (["truth.csv", "odometry.csv"], "odometry.csv is gone, and 1 more"),
    ],
)
def test_a_log_that_was_changed_is_refused_by_its_file(folders, gone, said):
    path = Path("log/odometry.csv")
    path.write_text(path.read_text() + "99,0,0\n")
    for name in gone:
        Path("log", name).unlink()
    found = refused("slam")
    expected = "expected it as slam was made of it; restore the log, or solve it again, "
    assert f"found not the log that was solved ({said}), {expected}" in found


def test_a_truth_that_came_later_is_a_change(folders, undrawn):
    shutil.copytree(OWN / "unicycle_log", "other")
    Path("other/truth.csv").unlink()
    assert main(["slam", "other", "--quiet", "-o", "solved"]) == 0
    assert rerun(Path("solved")).difference == ""
    shutil.copy(OWN / "unicycle_log" / "truth.csv", "other/truth.csv")
    assert "(truth.csv is new)" in refused("solved")


def test_files_outside_a_log_may_change(folders):
    Path("log/notes.txt").write_text("a user's")
    Path("log/README.md").write_text("a user's")
    assert rerun(Path("slam")).difference == ""


def test_a_folder_without_the_name_of_its_log_is_refused(folders):
    summary = json.loads(Path("slam/summary.json").read_text())
    del summary["log"]
    Path("slam/summary.json").write_text(json.dumps(summary))
    assert refused("slam") == (
        "slam/summary.json: log: found nothing, expected which log was solved (it is the folder of "
        "an earlier version); solve it again, `pipistrelle slam LOG -o DIR`, and name DIR"
    )


def test_a_log_for_a_mission_that_had_none_is_refused(folders):
    assert "option --log: found log, expected none" in refused("run", log=Path("log"))


def test_unknown_settings_are_refused_with_file_and_key(folders):
    Path("run/config.toml").write_text("[rays]\npowr = 1\n")
    assert refused("run").startswith("run/config.toml: rays.powr: no such setting")


@pytest.mark.parametrize("name", ["config.toml", "summary.json"])
def test_a_device_in_place_of_a_file_is_refused_by_name(folders, name):
    Path("run", name).unlink()
    Path("run", name).symlink_to("/dev/null")  # a pipe would be waited for without an end
    assert refused("run") == (
        f"run/{name}: found a pipe or a device, expected a file; put what it holds into a file"
    )


def test_a_device_in_place_of_a_track_is_reported(folders):
    Path("run/track_fused_ekf.tum").unlink()
    Path("run/track_fused_ekf.tum").symlink_to("/dev/null")
    assert rerun(Path("run")).difference.startswith("run/track_fused_ekf.tum: cannot be read")
