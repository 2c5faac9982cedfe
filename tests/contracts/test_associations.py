"""Associations that are not in the package: a class in the folder labels what nobody labelled."""

import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import pipistrelle
from pipistrelle.__main__ import main
from pipistrelle.config import (
    AssociationConfig,
    Config,
    FilterConfig,
    InputError,
    ListeningConfig,
    ScenarioConfig,
)
from pipistrelle.experiments.runs.trial import run_mission
from pipistrelle.experiments.studies.study import load_study
from reference.command_line import summary
from reference.pictures import without_picture
from reference.studies import SMALL

SHORT = (
    *("--settings", "paper", "--duration", "10", "--seed", "7", "--quiet"),
    *("--strategy", "fused", "--filter", "iekf"),
)
JOINT = '''
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.estimation.beliefs import Assignment
from pipistrelle.estimation.data_association.pairs import OWN_CALL, pair_costs

CALLER = 1000

@dataclass(frozen=True)
class Memory:
    """The last label, and of each landmark in how many scans it was heard, and when last."""
    scan: int = 0
    last: int = 0
    heard: dict = field(default_factory=dict)

@dataclass(frozen=True)
class Joint:
    """Nearest by joint innovations; what was heard once is forgotten, and doubles are merged."""
    gate: float = 11.0
    patience: int = 4
    nearest: float = 0.3

    def start(self):
        return Memory()

    def associate(self, memory, belief, scan):
        joint, last, heard = belief.joint(), memory.last, dict(memory.heard)
        label = np.full(scan.landmark.size, UNLABELLED)
        for number in {*scan.caller.tolist()} if joint.landmark.size else ():
            rows = np.flatnonzero(scan.caller == number)
            costs = self.costs(joint, scan, rows, number)
            near = costs.min(axis=1) < np.inf
            label[rows[near]] = joint.landmark[costs.argmin(axis=1)[near]]
        fresh = (label == UNLABELLED) & ~np.isnan(scan.range)
        label[fresh] = last + np.arange(1, 1 + fresh.sum())
        last += int(fresh.sum())
        label[scan.direct[scan.direct >= 0]] = CALLER
        for name in set(label.tolist()) - {UNLABELLED, CALLER}:
            heard[name] = (heard.get(name, (0, 0))[0] + 1, memory.scan)
        remove = tuple(
            name for name, (count, when) in heard.items()
            if count == 1 and memory.scan - when > self.patience and name in joint.landmark
        )
        merge = self.doubles(joint, {*remove, CALLER})
        for name in (*remove, *(gone for _, gone in merge)):
            heard.pop(name, None)
        label[np.isin(label, [gone for _, gone in merge])] = UNLABELLED
        found = Assignment(label=label, remove=remove, merge=merge)
        return Memory(memory.scan + 1, last, heard), found

    def costs(self, joint, scan, rows, number):
        way, std = scan.range, scan.range_std
        at, there = OWN_CALL, 3 + 2 * np.arange(joint.landmark.size)
        if number:
            way, std = scan.excess_path, scan.excess_path_std
            at = next(iter(there[joint.landmark == CALLER]), None)
        known = rows if at is not None else rows[:0]
        columns = [part[known] for part in (scan.bearing, scan.bearing_std, way, std)]
        chances = self.gate, 1.0, np.inf, 1.0, np.inf  # a bearing alone fits many
        costs = np.full((rows.size, there.size), np.inf)
        if known.size:
            placed = joint.mean, joint.covariance, there, at
            costs[:] = pair_costs((*columns, np.ones(known.size)), *placed, chances)
        return costs

    def doubles(self, joint, others):
        places, taken, pairs = joint.mean[3:].reshape(-1, 2), set(others), []
        points = zip(joint.landmark.tolist(), places, strict=True)
        for (a, one), (b, other) in combinations(points, 2):
            if np.hypot(*(one - other)) < self.nearest and not taken & {a, b}:
                pairs.append((a, b))
                taken |= {a, b}
        return tuple(pairs)
'''


def config_of(method, **sections):
    """Return the settings of a mission of 20 frames with timing, and an association."""
    return Config(
        scenario=ScenarioConfig(steps=160),
        listening=ListeningConfig(excess_paths=True),
        filter=FilterConfig(noise="measured"),
        association=AssociationConfig(method=method),
        **sections,
    )


def test_excess_paths_without_labels_reach_the_filter_with_their_caller(written):
    method = f"{written(JOINT)}:Joint"
    labelled, found = (
        run_mission(config_of(name), ["passive", "fused"], ["iekf"]) for name in ("known", method)
    )
    for one, other in zip(labelled.trials, found.trials, strict=True):
        assert other.error is None
        named = {label for scan in other.scans for label in scan.callers.tolist()}
        assert named == {-1, 1000}
        assert all((scan.landmark >= 0).all() for scan in other.scans)
        assert other.scores.position_bound_m == one.scores.position_bound_m
        assert one.scores.associated_right is None
        assert 0.5 < other.scores.associated_right <= 1.0
        assert np.isfinite(other.scores.map_rmse_m)
    paths = [
        sum(int((~np.isnan(scan.excess_path)).sum()) for scan in trial.scans)
        for trial in (labelled.trials[1], found.trials[1])
    ]
    assert paths[1] > 0.3 * paths[0] > 100, "of those that a landmark was born for"


def test_an_association_of_a_class_maps_a_mission_a_study_and_its_log(written, undrawn):
    method = ("--association.method", f"{written(JOINT)}:Joint")
    timed = ("--listening.excess-paths", "true", "--filter.noise", "measured")
    words = ("run", *SHORT, *timed)
    assert main([*words, "-o", "known", "--save-log", "log"]) == 0
    assert main([*words, *method, "-o", "own"]) == 0
    assert main(["slam", "log", "--quiet", "--filter", "iekf", *method, "-o", "again"]) == 0
    (known,), (own,), (again,) = (summary(folder)["runs"] for folder in ("known", "own", "again"))
    assert own["position_bound_m"] == known["position_bound_m"]
    assert "associated_right" not in known
    for one in (own, again):
        assert one["map_rmse_m"] is not None
        assert 0.5 < one["associated_right"] <= 1.0
    assert method[1] in Path("own/config.toml").read_text()
    for folder in ("own", "again"):
        drawn = pl.read_csv(f"{folder}/map_fused_iekf.csv", comment_prefix="#")
        assert 1000 in drawn["landmark"].to_list(), "the caller is on the map by its direct call"
    small = SMALL.replace("iterations = 3", "iterations = 1").replace("0.0025, 0.025", "0.0088")
    Path("small.toml").write_text(
        f'filters = ["iekf"]\nstrategies = ["active", "fused"]\n{small}'
        f'"association.method" = ["known", "{method[1]}"]\n'
    )
    assert main(("study", "small.toml", "--workers", "1", "-o", "study", "--quiet")) == 0
    trials = load_study(Path("study")).trials.collect()
    assert trials["status"].to_list() == ["done"] * 4
    for strategy in ("active", "fused"):
        known, own = trials.filter(pl.col("strategy") == strategy).iter_rows(named=True)
        assert known["position_bound_m"] == own["position_bound_m"]
        assert known["landmarks_total"] != own["landmarks_total"]
        assert known["associated_right"] is None
        assert 0.5 < own["associated_right"] <= 1.0
        assert known["clutter_per_frame"] == own["clutter_per_frame"]


def test_a_folders_association_class_is_run_only_if_requested(written, capsys):
    method = f"{written(JOINT)}:Joint"
    assert main(["run", *SHORT, "--association.method", method, "-o", "own"]) == 0
    said = f"config.toml: association.method: found '{method}', whose code is not Pipistrelle's"
    sys.modules.pop(method.partition(":")[0])
    assert main(["view", "own", "--quiet"]) == 2
    assert said in capsys.readouterr().err
    assert method.partition(":")[0] not in sys.modules, "not even imported"
    with pytest.raises(InputError, match="whose code is not"):
        pipistrelle.load("own").figure()
    assert not Path("own/view.html").exists()
    assert main(["view", "own", "--quiet", "--association.method", method]) == 0
    assert Path("own/view.html").exists()


WRONG = {
    "nothing": ("", "found no class Own in NAME; expected an association"),
    "no start": (
        "class Own:\n    def associate(self, *_): ...",
        "lacks start; an association has start, associate",
    ),
    "no record": (
        "class Own:\n    def start(self): ...\n    def associate(self, *_): ...",
        "cannot be built: it is no dataclass; make it one, or write from_config(config)",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_missing_or_broken_association_is_refused_before_the_mission(written, case, capsys):
    text, expected = WRONG[case]
    name = written(text)
    assert main(["run", *SHORT, "--association.method", f"{name}:Own", "-o", "one"]) == 2
    error = capsys.readouterr().err
    where = f"pipistrelle: error: association.method {name}:Own: "
    assert error.startswith(where + expected.replace("NAME", name))
    assert error.count("\n") == 1
    assert not Path("one").exists()


def test_an_answer_that_is_no_assignment_is_refused_by_name(written):
    text = (
        "from dataclasses import dataclass\n@dataclass(frozen=True)\nclass Own:\n"
        "    def start(self): ...\n    def associate(self, *_): return [1, 2]"
    )
    config = Config(
        scenario=ScenarioConfig(steps=8),
        association=AssociationConfig(method=f"{written(text)}:Own"),
    )
    with pytest.raises(InputError, match=r"Own\.associate: found list returned, expected the mem"):
        run_mission(config, ["fused"], ["ekf"])


def test_callers_that_move_are_refused_with_an_association_of_a_filter_that_follows_none(
    written, capsys
):
    method = f"{written(JOINT)}:Joint"
    Path("boat.toml").write_text(
        '[[callers]]\nname = "boat"\nfrequency = 25e3\ncourse = "circle"\n'
        f'[association]\nmethod = "{method}"\n[listening]\nexcess_paths = true\n'
    )
    asked = ["run", "--scenario.steps", "40", "--config", "boat.toml", "-o", "one"]
    assert main([*asked, "--filter", "fastslam"]) == 2
    error = capsys.readouterr().err
    assert "found callers that move (boat) with the filter fastslam, which follows none" in error
    assert "ekf, iekf, smoother" in error
    assert main([*asked, "--filter", "iekf"]) == 0


def test_a_folder_of_the_packages_own_method_is_done_again_without_being_asked_for_trust(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with without_picture():
        assert main(["run", *SHORT, "--association.method", "marginal", "-o", "own"]) == 0
    assert main(["view", "own", "--quiet"]) == 0
    assert Path("own/view.html").exists()
    assert pipistrelle.load("own").figure() is not None
