"""A folder of results read back, and what of it is refused."""

import json
import os
from hashlib import sha256

import numpy as np
import pytest

from pipistrelle.config import Config, InputError
from pipistrelle.experiments.drives import NO_TRUTH
from pipistrelle.experiments.results.reading import read_mission
from pipistrelle.files import LOG, SUMS, OwnFiles
from pipistrelle.geometry import wrap
from reference.results import PLACES, TIME, TRUTH, loop, mission_folder, turned

PATHS = {("fused", "ekf"): loop(), ("active", "mine:Own"): turned(loop(), 0.2)}


@pytest.fixture
def folder(tmp_path):
    return mission_folder(tmp_path / "a [1]", PATHS, config=Config(seed=9))


def refused(folder, *parts):
    with pytest.raises(InputError) as error:
        read_mission(folder)
    for part in parts:
        assert part in str(error.value)
    assert "\n" not in str(error.value)


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
    assert mission.settings["rays.power"] == Config().rays.power
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
    refused(tmp_path / "nowhere", "nowhere: found no such folder")
    (tmp_path / "file").write_text("one")
    refused(tmp_path / "file", "found a file")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "found no summary.json")
    OwnFiles(tmp_path / "log", LOG).folder.mkdir()
    OwnFiles(tmp_path / "log", LOG).replace({"log.toml": "format = 1"})
    refused(tmp_path / "log", "found a recorded log")


@pytest.mark.parametrize(
    "name",
    ["summary.json", "config.toml", "track_fused_ekf.tum", "map_active_Own.csv", "truth.tum"],
)
def test_a_file_that_is_changed_cut_or_gone_is_named(folder, name):
    text = (folder / name).read_text()
    for other in (text + " ", text[:-2], ""):
        (folder / name).write_text(other)
        refused(folder, f"{folder / name}: was changed since Pipistrelle wrote it")
    (folder / name).unlink()
    none = f"{folder}: found no summary.json"
    refused(folder, none if name == "summary.json" else f"{folder / name}: is missing")
    (folder / name).mkdir()
    refused(folder, f"{folder / name}: found a folder")
    (folder / name).rmdir()
    os.mkfifo(folder / name)
    refused(folder, f"{folder / name}: found a pipe or a device")


def test_files_that_nothing_is_read_from_may_be_changed(folder):
    (folder / "README.md").write_text("notes of mine")
    assert len(read_mission(folder).scores) == 2


def test_results_that_were_interrupted_are_not_whole(folder):
    lines = (folder / SUMS).read_text().splitlines()
    (folder / SUMS).write_text("\n".join(line for line in lines if "summary" not in line))
    refused(folder, "a summary.json that SHA256SUMS does not name", "run or solve it anew")


@pytest.mark.parametrize(
    ("name", "text", "part"),
    [
        ("summary.json", '{"format": 2, "runs": []}', "format: found 2"),
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
    refused(folder, str(folder), part)


def test_scores_equal_the_summarys(folder):
    runs = json.loads((folder / "summary.json").read_text())["runs"]
    assert [read_mission(folder).scores[run["strategy"], run["filter"]] for run in runs] == runs
