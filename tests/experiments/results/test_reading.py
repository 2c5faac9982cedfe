"""The summary and the results in a result folder, and other folders, which are refused by kind."""

import json
import os
from hashlib import sha256

import numpy as np
import pytest

from pipistrelle.config import Config
from pipistrelle.experiments.drives import NO_TRUTH
from pipistrelle.experiments.results.reading import read_mission, read_summary
from pipistrelle.files import COMPARISON, LOG, SUMS, WORLD, OwnFiles
from pipistrelle.geometry import wrap
from reference.refused import refusal_of
from reference.results import PLACES, TIME, TRUTH, loop, mission_folder, turned

SOUND = {
    "format": 1,
    "version": "0.1.0",
    "config_hash": "0" * 16,
    "seed": 7,
    "runs": [{"strategy": "fused", "filter": "ekf", "position_rmse_m": None}],
}


def written(folder, **changed):
    summary = {**SOUND, **changed}
    kept = {key: value for key, value in summary.items() if value is not None}
    (folder / "summary.json").write_text(json.dumps(kept))
    return folder


def refused(folder):
    return refusal_of(lambda: read_summary(folder))


def test_a_summary_with_unknown_keys_is_read(tmp_path):
    summary = read_summary(written(tmp_path, more={"later": 1}))
    assert [(run.strategy, run.filter) for run in summary.runs] == [("fused", "ekf")]
    assert summary.log is None


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("plan.toml", "a study"), ("trials/one", "a study"), ("index.html", "a report"),
        ("log.toml", "a log folder"), ("Robot3_Odometry.dat", "a MRCLAM set"),
        ("config.toml", "results that are not complete"), ("notes.txt", "no summary.json"),
        ("recording.toml", "a sound recording"), ("world.toml", "a world"),
    ],
)  # fmt: skip
def test_another_folder_is_refused_with_its_kind_and_a_remedy(tmp_path, name, said):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("")
    expected = "expected the result folder of `pipistrelle run` or `pipistrelle slam`; "
    assert refused(tmp_path).startswith(f"{tmp_path}: found {said}, {expected}")


def test_a_reports_own_summary_is_no_missions(tmp_path):
    (tmp_path / "index.html").write_text("")
    (tmp_path / "summary.json").write_text(json.dumps({"format": 1, "claims": [], "version": "1"}))
    assert "found a report" in refused(tmp_path)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"format": 2}, "summary.json, key 'format': found 2, expected 1"),
        ({"version": None}, "summary.json: found no key 'version'"),
        ({"runs": []}, "summary.json: runs: found none, expected an estimate"),
        ({"runs": "all"}, "summary.json, key 'runs': found 'all', expected a valid array"),
        ({"runs": [{"strategy": "loud", "filter": "ekf"}]}, "key 'runs.1.strategy': found 'loud'"),
        ({"runs": [{"strategy": "fused"}]}, "found no key 'runs.1.filter'"),
        ({"log": {"path": "here"}}, "summary.json: found no keys 'log.robot'"),
        ({"log": "here"}, "summary.json, key 'log': found 'here'"),
    ],
)
def test_an_incomplete_summary_is_refused_with_the_key(tmp_path, changed, said):
    assert said in refused(written(tmp_path, **changed))


@pytest.mark.parametrize("text", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b"[1]", b"null"])
def test_a_summary_that_is_no_json_of_ours_is_refused(tmp_path, text):
    (tmp_path / "summary.json").write_bytes(text)
    told = refused(tmp_path)
    assert told.startswith(f"{tmp_path / 'summary.json'}: found ")
    assert len(told) < 400


# The results

PATHS = {("fused", "ekf"): loop(), ("active", "mine:Own"): turned(loop(), 0.2)}


@pytest.fixture
def folder(tmp_path):
    return mission_folder(tmp_path / "a [1]", PATHS, config=Config(seed=9))


def mission_refused(folder, *parts):
    refusal_of(lambda: read_mission(folder), *parts, form=r"^[^\n]+$")


def sealed(folder, name, text):
    """Write a file as somebody would who wants to be believed: its sum stands in the list."""
    lines = [line for line in (folder / SUMS).read_text().splitlines() if not line.endswith(name)]
    (folder / name).write_text(text)
    lines.append(f"{sha256(text.encode()).hexdigest()}  {name}")
    (folder / SUMS).write_text("\n".join(lines) + "\n")


def test_written_missions_are_read_back(folder):
    mission = read_mission(folder)
    assert list(mission.scores) == list(PATHS)
    assert (mission.folder, mission.settings["seed"]) == (folder, 9)
    assert mission.settings["rays.exponent"] == Config().rays.exponent
    for estimate, path in PATHS.items():
        stored = mission.paths[estimate]
        np.testing.assert_array_equal(stored.time, TIME)
        np.testing.assert_allclose(stored.pose[:, :2], path[:, :2], atol=1e-11)
        np.testing.assert_allclose(wrap(stored.pose[:, 2] - path[:, 2]), 0.0, atol=1e-11)
        np.testing.assert_allclose(mission.maps[estimate], PLACES[:2], atol=1e-12)
        assert mission.scores[estimate]["landmarks_full"] == 2
    np.testing.assert_allclose(mission.truth.pose[:, :2], TRUTH.path[:, :2], atol=1e-11)


def test_a_mission_without_truth_or_without_a_landmark_is_read(tmp_path):
    mission = read_mission(mission_folder(tmp_path / "one", PATHS, truth=NO_TRUTH))
    assert mission.truth is None
    assert mission.scores["fused", "ekf"]["position_rmse_m"] is None


def test_a_path_that_is_lost_is_read_as_such(tmp_path):
    lost = np.full((len(TIME), 3), np.nan)
    mission = read_mission(mission_folder(tmp_path / "one", {("fused", "ekf"): lost}))
    assert np.isnan(mission.paths["fused", "ekf"].pose).all()
    assert mission.scores["fused", "ekf"]["diverged"] is True


def test_another_kind_of_folder_is_refused_with_its_kind(tmp_path):
    mission_refused(tmp_path / "nowhere", "nowhere: found no such folder")
    (tmp_path / "file").write_text("one")
    mission_refused(tmp_path / "file", "found a file")
    for kind in (LOG, COMPARISON, WORLD):
        OwnFiles(tmp_path / kind.title, kind).replace({"README.md": "one"})
        mission_refused(tmp_path / kind.title, f"found {kind.title}, expected")


@pytest.mark.parametrize(
    "name",
    ["summary.json", "config.toml", "track_fused_ekf.tum", "map_active_Own.csv", "truth.tum"],
)
def test_a_file_that_is_changed_cut_or_gone_is_named(folder, name):
    text = (folder / name).read_text()
    for other in (text + " ", text[:-2], ""):
        (folder / name).write_text(other)
        mission_refused(folder, f"{folder / name}: was changed since Pipistrelle wrote it")
    (folder / name).unlink()
    none = f"{folder}: found results that are not complete"
    mission_refused(folder, none if name == "summary.json" else f"{folder / name}: is missing")
    (folder / name).mkdir()
    mission_refused(folder, f"{folder / name}: found a folder")
    (folder / name).rmdir()
    os.mkfifo(folder / name)
    mission_refused(folder, f"{folder / name}: found a pipe or a device")


def test_files_that_nothing_is_read_from_may_be_changed(folder):
    (folder / "README.md").write_text("notes of mine")
    assert len(read_mission(folder).scores) == 2


def test_results_that_were_interrupted_are_not_whole(folder):
    lines = (folder / SUMS).read_text().splitlines()
    (folder / SUMS).write_text("\n".join(line for line in lines if "summary" not in line))
    mission_refused(folder, "a summary.json that SHA256SUMS does not name", "run or solve it again")


@pytest.mark.parametrize(
    ("name", "text", "part"),
    [
        ("summary.json", '{"format": 2, "runs": []}', "key 'format': found 2"),
        ("summary.json", "[]", "summary.json: found []"),
        ("summary.json", "{", "found text that is no JSON"),
        ("config.toml", "seed = ", "would not write"),
        ("track_fused_ekf.tum", "1 2 3\n", "would not write"),
        ("track_fused_ekf.tum", "one\n", "would not write"),
        ("map_fused_ekf.csv", "landmark,x,y,status\n1,left,2,full\n", "would not write"),
    ],
)
def test_invalid_files_with_a_right_checksum_are_refused(folder, name, text, part):
    sealed(folder, name, text)
    mission_refused(folder, str(folder), part)


def test_scores_equal_the_summarys(folder):
    runs = json.loads((folder / "summary.json").read_text())["runs"]
    assert [read_mission(folder).scores[run["strategy"], run["filter"]] for run in runs] == runs
