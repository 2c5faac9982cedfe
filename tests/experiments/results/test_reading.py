"""What a result folder says of itself, and what other folders are told that they are."""

import json

import pytest

from pipistrelle.config import InputError
from pipistrelle.experiments.results.reading import read_summary
from pipistrelle.files import COMPARISON, WORLD, OwnFiles

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
    with pytest.raises(InputError) as refusal:
        read_summary(folder)
    return str(refusal.value)


def test_a_summary_with_unknown_keys_is_read(tmp_path):
    summary = read_summary(written(tmp_path, more={"later": 1}))
    assert [(run.strategy, run.filter) for run in summary.runs] == [("fused", "ekf")]
    assert summary.log is None


@pytest.mark.parametrize(
    ("files", "said"),
    [
        (["plan.toml", "summary.json"], "found a study, which keeps many worlds and the frames of"),
        (["trials/one"], "found a study"),
        (["index.html"], "found a report"),
        (["log.toml"], "found a recorded log"),
        (["Robot3_Odometry.dat"], "found a recorded log"),
        (["config.toml"], "it was stopped before it was whole"),
        (["notes.txt"], "found no summary.json"),
        ([], "found no summary.json"),
    ],
)
def test_another_folder_is_refused_with_its_kind_and_a_remedy(tmp_path, files, said):
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    told = refused(tmp_path)
    assert told.startswith(f"{tmp_path}: {said}" if said.startswith("found") else str(tmp_path))
    assert said in told
    expected = ", expected the result folder of `pipistrelle run` or `pipistrelle slam`; "
    assert told.partition(expected)[2]


@pytest.mark.parametrize("kind", [COMPARISON, WORLD])
def test_another_pipistrelle_folder_is_refused_with_its_kind(tmp_path, kind):
    OwnFiles(tmp_path, kind).replace({"README.md": "one"})
    assert f"{tmp_path}: found {kind.title} of Pipistrelle, expected" in refused(tmp_path)


def test_a_summary_that_is_cut_is_no_json(tmp_path):
    (tmp_path / "summary.json").write_text("{")
    assert "summary.json: found text that is no JSON, expected a mission's" in refused(tmp_path)


def test_a_reports_own_summary_is_no_missions(tmp_path):
    (tmp_path / "index.html").write_text("")
    (tmp_path / "summary.json").write_text(json.dumps({"format": 1, "claims": [], "version": "1"}))
    assert "found a report" in refused(tmp_path)


def test_a_missing_folder_or_a_file_is_refused(tmp_path):
    assert "found no such folder" in refused(tmp_path / "none")
    (tmp_path / "file").write_text("")
    assert "found a file" in refused(tmp_path / "file")


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"format": 2}, "summary.json: format: found 2, expected 1"),
        ({"version": None}, "summary.json: version: found nothing"),
        ({"runs": []}, "summary.json: runs: found none, expected an estimate"),
        ({"runs": "all"}, "summary.json: runs: found 'all', expected a valid array"),
        ({"runs": [{"strategy": "loud", "filter": "ekf"}]}, "runs.0.strategy: found 'loud'"),
        ({"runs": [{"strategy": "fused"}]}, "runs.0.filter: found nothing"),
        ({"log": {"path": "here"}}, "summary.json: log.robot: found nothing"),
        ({"log": "here"}, "summary.json: log: found 'here'"),
    ],
)
def test_an_incomplete_summary_is_refused_with_the_key(tmp_path, changed, said):
    told = refused(written(tmp_path, **changed))
    assert said in told
    assert "anew" in told


@pytest.mark.parametrize("text", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b"[1]", b"null"])
def test_a_summary_that_is_no_json_of_ours_is_refused(tmp_path, text):
    (tmp_path / "summary.json").write_bytes(text)
    told = refused(tmp_path)
    assert told.startswith(f"{tmp_path / 'summary.json'}: found ")
    assert len(told) < 400
