"""A saved drive holds values and runs nothing, whoever made the file."""

import json
import sys
from hashlib import sha256

import numpy as np
import pytest

from pipistrelle import InputError, Slam
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.scripting.saved_state import DEEPEST, HEAD, RECORDS
from reference.missions import ROBOT

PLACES = np.random.default_rng(3).uniform(-8.0, 8.0, (12, 2))
METHODS = ("known", "nearest", "marginal")
OWN = """
from dataclasses import dataclass
from typing import NamedTuple
import numpy as np
from pipistrelle.estimation.beliefs import Assignment
from pipistrelle.estimation.beliefs import Gaussian, no_landmarks
from pipistrelle.estimation.motion import Motion

class Notes(NamedTuple):
    seen: dict
    drawn: np.ndarray

@dataclass(frozen=True)
class Reckoned:
    at: Gaussian
    notes: Notes
    gated: int = 0

    def pose(self):
        return self.at

    def landmarks(self):
        return no_landmarks()

@dataclass(frozen=True)
class Mine:
    motion: Motion

    def init(self, pose):
        return Reckoned(pose, Notes({(1, "a"): float("nan"), None: {2.5}}, np.float32([7])))

    def predict(self, belief, controls, dt, rng):
        poses = [belief.at.mean + [*(u * t).tolist(), rng.normal()] for u, t in zip(controls, dt)]
        covariance = np.array([belief.at.covariance] * len(poses))
        ahead = Gaussian(mean=np.array(poses), covariance=covariance)
        at = Gaussian(mean=ahead.mean[-1], covariance=ahead.covariance[-1])
        return Reckoned(at, belief.notes._replace(drawn=np.asfortranarray(ahead.mean))), ahead

    def update(self, belief, scan, rng):
        return belief

@dataclass(frozen=True)
class Counted:
    labels: tuple

@dataclass(frozen=True)
class Each:
    def start(self):
        return Counted(())

    def associate(self, memory, belief, scan):
        label = len(memory.labels) + np.arange(scan.landmark.size)
        return Counted((*memory.labels, *label.tolist())), Assignment(label=label)
"""


def driven(slam, steps, seed=5):
    """Drive and hear for some steps."""
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        slam.move(np.tile([0.5, 0.25], (3, 1)), dt=[0.1] * 3)
        pose, near = slam.pose, rng.choice(len(PLACES), 5, replace=False)
        away = PLACES[near] - [pose.x, pose.y]
        row = {"bearing": np.arctan2(away[:, 1], away[:, 0]) - pose.heading}
        if slam._config.association.method == "known":
            row["landmark"] = near
        slam.hear(range=np.hypot(*away.T), **row)
    return slam


def made(name="iekf", method="known", steps=20, **options):
    """Return a drive of some steps."""
    options |= {"fastslam__particles": 40} if name == "fastslam" else {}
    return driven(Slam(ROBOT, filter=name, association__method=method, **options), steps)


def parts_of(path):
    """Return the JSON of a file, and the bytes of its arrays."""
    line, _, data = path.read_bytes()[len(HEAD) :].partition(b"\n")[2].partition(b"\n")
    return json.loads(line), data


def write(path, line, data):
    """Write a file with the right sum; return its path."""
    body = (line if isinstance(line, bytes) else json.dumps(line).encode()) + b"\n" + data
    path.write_bytes(HEAD + sha256(body).hexdigest().encode() + b"\n" + body)
    return path


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Return the file of a drive."""
    return made().save(tmp_path_factory.mktemp("saved") / "one.slam")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", CATALOGUE)
def test_a_drive_that_is_saved_and_loaded_goes_on_to_the_same_bits(tmp_path, name, method):
    whole = made(name, method)
    again = Slam.load(whole.save(tmp_path / "half.slam"))
    assert again._session.state().draws == whole._session.state().draws
    for slam in (whole, again):
        driven(slam, 10, seed=6)
    assert again.path.equals(whole.path)
    assert again.map.equals(whole.map)
    twice = Slam.load(again.save(tmp_path / "whole.slam"))
    assert twice.map.equals(again.map)
    assert parts_of(twice.save(tmp_path / "twice.slam"))[1] == parts_of(tmp_path / "whole.slam")[1]


@pytest.mark.parametrize("stated", [{}, {"place": [9.0, 4.0], "place_std": [0.1, 0.1]}])
def test_a_drive_with_a_caller_is_saved_and_loaded_without_labels(tmp_path, stated):
    robot = ROBOT | {"callers": [{"name": "mate", "landmark": 900, **stated}]}
    whole = Slam(robot, filter="iekf", association__method="marginal")
    driven(whole, 10)
    again = Slam.load(whole.save(tmp_path / "half.slam"))
    driven(again, 5, seed=6)
    driven(whole, 5, seed=6)
    assert again.map.equals(whole.map)
    assert (900 in again.map["landmark"]) == bool(stated)


def popen(module, name):
    """Return a pickle that calls something of a module, by a name that may have dots."""
    word = lambda text: b"\x8c" + bytes([len(text)]) + text.encode()  # noqa: E731
    call = word("sh") + word("-c") + word("touch ran")
    return b"\x80\x04" + word(module) + word(name) + b"\x93(](" + call + b"etR."


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("pipistrelle.detection.scans", "np.f2py.subprocess.Popen"),
        ("subprocess", "Popen"),
        ("pipistrelle.estimation.session", "Session"),
        ("mine", "Popen"),
    ],
)
def test_a_pickle_in_place_of_a_drive_runs_nothing(saved, tmp_path, monkeypatch, module, name):
    monkeypatch.chdir(tmp_path)
    header, _ = parts_of(saved)
    version = {"version": header["version"], "filter": "ekf", "kept": 5, "config": {}}
    file = write(tmp_path / "evil.slam", version, popen(module, name))
    with pytest.raises(InputError, match=r"found a drive of Pipistrelle .* in an earlier form"):
        Slam.load(file)
    file = write(tmp_path / "evil.slam", header, popen(module, name))
    with pytest.raises(InputError, match=r"found what Slam\.save did not write"):
        Slam.load(file)
    assert not (tmp_path / "ran").exists()


def test_a_file_of_another_version_is_refused_in_words(saved, tmp_path):
    header, data = parts_of(saved)
    file = write(tmp_path / "old.slam", header | {"version": "0.0.1"}, data)
    with pytest.raises(InputError, match=r"old\.slam: found a drive of Pipistrelle 0\.0\.1, expec"):
        Slam.load(file)


def with_record(name, *parts):
    """Return what makes the first pose in a file something else."""

    def spoil(header, data):
        at = next(
            n for n, node in enumerate(header["nodes"]) if node[:2] == ["record", "EkfBelief"]
        )
        header["nodes"][at] = ["record", name, *parts]
        return header, data

    return spoil


def with_node(find, change):
    """Return what changes the first node that begins so."""

    def spoil(header, data):
        change(next(node for node in header["nodes"] if node[: len(find)] == find))
        return header, data

    return spoil


def nested(count):
    """Return what puts tuples into each other."""

    def spoil(header, data):
        header["nodes"] = [["tuple"], *(["tuple", [n]] for n in range(count))]
        return header, data

    return spoil


def shared(kind, *more):
    """Return what nests a container in itself so that it has 9^12 parts, and uses it."""

    def spoil(header, data):
        nodes = [["tuple", 1], *(["tuple", *[[i]] * 9] for i in range(12)), [kind, *more]]
        return header | {"nodes": [*nodes, *header["nodes"]]}, data

    return spoil


def spelt(header, word):
    """Return a line of JSON with a word in place of a number."""
    return json.dumps(header).encode().replace(b"0.1", word)


def set_shape(*shape):
    """Return what lets an array claim a shape."""
    return with_node(["array", "float64"], lambda node: node.__setitem__(2, list(shape)))


SPOILT = {
    "a dotted name": with_record("np.f2py.subprocess.Popen", ["sh"]),
    "a function": with_record("no_landmarks"),
    "a class that is no record": with_record("Session"),
    "a builtin": with_record("print", "x"),
    "an estimator": with_record("EkfSlam"),
    "a record of the caller's module, which is not named": with_record(":Mine"),
    "a name that is none": with_record("__class__"),
    "a name that is a list": with_record([0]),
    "a record without fields": with_record("EkfBelief"),
    "a record with fields of another": with_record("EkfBelief", 1, 2),
    "a record of other kinds": with_node(
        ["record", "EkfBelief"], lambda node: node.__setitem__(slice(2, None), ["x"] * 8)
    ),
    "another record": with_node(["record", "EkfBelief"], lambda node: node.__setitem__(1, "Scan")),
    "another estimator's belief": lambda header, data: (header | {"filter": "smoother"}, data),
    "an estimator that is none": lambda header, data: (header | {"filter": "nothing"}, data),
    "an estimator that is a list": lambda header, data: (header | {"filter": ["ekf"]}, data),
    "another association": lambda header, data: (header | {"association": "nearest"}, data),
    "objects": with_node(["array", "float64"], lambda node: node.__setitem__(1, "object")),
    "dates": with_node(["array", "float64"], lambda node: node.__setitem__(1, "datetime64[s]")),
    "single precision": with_node(
        ["array", "float64"], lambda node: node.__setitem__(slice(1, 3), ["float32", [2]])
    ),
    "a huge shape": set_shape(10**18),
    "a huge shape of nothing": set_shape(0, 10**18),
    "a negative shape": set_shape(-1, -3),
    "a shape of numbers that are none": set_shape(1.5),
    "a shape that is no list": with_node(["array"], lambda node: node.__setitem__(2, "ab")),
    "sixty axes": set_shape(*[1] * 60),
    "another order": with_node(["array", "float64"], lambda node: node.__setitem__(3, "A")),
    "a truth value that is none": with_node(
        ["array", "int64"], lambda node: node.__setitem__(slice(1, 3), ["bool", [8]])
    ),
    "a node after itself": with_node(["tuple"], lambda node: node.append([10**6])),
    "a node before the first": with_node(["tuple"], lambda node: node.append([-1])),
    "a node of no number": with_node(["tuple"], lambda node: node.append([True])),
    "an unknown node": lambda header, data: (header | {"nodes": [["object", "x"]]}, data),
    "no nodes": lambda header, data: (header | {"nodes": []}, data),
    "a drive that is a number": lambda header, data: (header | {"nodes": [["tuple", 3]]}, b""),
    "nodes that are words": lambda header, data: (header | {"nodes": "tuple"}, data),
    "tuples within tuples": nested(DEEPEST),
    "a hundred thousand tuples within tuples": nested(10**5),
    "a key that takes years to hash": shared("dict", [12], 1),
    "a member that takes years to hash": shared("set", [12]),
    "a field that takes years to check": shared("record", "EkfBelief", *[[12]] * 8),
    "lists within lists": lambda header, data: (b"[" * 10**6 + b"]" * 10**6, data),
    "a number of a million digits": lambda header, data: (b"[1" + b"0" * 10**6 + b"]", data),
    "no number": lambda header, data: (spelt(header, b"NaN"), data),
    "endless": lambda header, data: (spelt(header, b"Infinity"), data),
    "half of the arrays": lambda header, data: (header, data[: len(data) // 2]),
    "no arrays": lambda header, data: (header, b""),
    "more than the arrays": lambda header, data: (header, data + b"x"),
    "no JSON": lambda header, data: (b"\x80\x04", data),
    "an empty table": lambda header, data: ({}, data),
    "a list": lambda header, data: ([], data),
    "a generator of other draws": with_node(
        ["dict", "bit_generator"], lambda node: node.__setitem__(2, "MT19937")
    ),
    "draws that are none": with_node(["dict", "state"], lambda node: node.__setitem__(2, -1)),
}


@pytest.mark.parametrize("what", SPOILT)
def test_a_file_that_was_made_and_summed_is_refused(saved, tmp_path, what):
    header, data = parts_of(saved)
    line, data = SPOILT[what](header, data)
    with pytest.raises(InputError, match=r"made\.slam: found"):
        Slam.load(write(tmp_path / "made.slam", line, data))


def mutated(rng, header, data):
    """Return a line and arrays with one thing changed: a byte, a number, a part or a whole node."""
    kind, data, nodes = rng.integers(6), bytearray(data), header["nodes"]
    node = nodes[rng.integers(len(nodes))]
    if kind == 0:
        line = bytearray(json.dumps(header).encode())
        line[rng.integers(len(line))] = rng.integers(256)
        return bytes(line), bytes(data)
    if kind == 1:
        for at in rng.integers(len(data), size=rng.integers(1, 20)):
            data[at] = rng.integers(256)
    elif kind == 2:
        at = 8 * rng.integers(len(data) // 8)
        whole = np.array([-1, 0, 1, 7, 40, 2**40, 2**62, -(2**63)]).view(np.float64)
        numbers = np.append(whole, [np.nan, np.inf, -1.0, 0.0, 1e300, 1e-300])
        data[at : at + 8] = rng.choice(numbers).tobytes()
    elif kind == 3:
        odd = [0, -1, 2**63, 10**400, 1.5, None, True, "", "Stack", [0], [-1], [[0]], {}]
        node[rng.integers(len(node))] = odd[rng.integers(len(odd))]
    elif kind == 4:
        node[rng.integers(len(node))] = nodes[rng.integers(len(nodes))][-1]
    else:
        nodes[rng.integers(len(nodes))] = nodes[rng.integers(len(nodes))]
    return header, bytes(data)


def test_a_forged_file_with_a_right_checksum_is_rejected_or_drives(tmp_path):
    rng, ends = np.random.default_rng(11), {"drives": 0, "refused": 0}
    files = [
        made(name, method, 10).save(tmp_path / f"{name}_{method}.slam")
        for name in CATALOGUE
        for method in ("known", "marginal")
    ]
    for number in range(300):
        parts = parts_of(files[number % len(files)])
        file = write(tmp_path / "changed.slam", *mutated(rng, *parts))
        try:
            slam = driven(Slam.load(file), 2)
        except InputError:
            ends["refused"] += 1
        else:
            assert np.isfinite([slam.pose.x, slam.pose.y, slam.pose.heading]).all()
            ends["drives"] += 1
    assert min(ends.values()) > 30, ends


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Return the name of a module with an estimator and an association."""
    (tmp_path / "mine_saved.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    yield "mine_saved"
    sys.modules.pop("mine_saved", None)


def test_classes_from_outside_are_loaded_where_the_caller_names_them(mine, tmp_path):
    named = {"filter": f"{mine}:Mine", "association__method": f"{mine}:Each"}
    whole = driven(Slam(ROBOT, **named), 3)
    file = whole.save(tmp_path / "own.slam")
    again = Slam.load(file, **named)
    notes = again._session.belief.notes
    assert type(again._session.belief) is type(whole._session.belief)
    assert type(again._session._memory).__name__ == "Counted"
    assert notes.drawn.flags.f_contiguous
    assert notes.seen[None] == {2.5}
    assert np.isnan(notes.seen[1, "a"])
    for slam in (whole, again):
        driven(slam, 3, seed=8)
    assert again.path.equals(whole.path)
    for left in named:
        some = {key: name for key, name in named.items() if key != left}
        with pytest.raises(InputError, match=f"if you trust the file.*, {left}="):
            Slam.load(file, **some)


def test_a_file_names_no_module_that_the_caller_does_not_name(mine, saved, tmp_path):
    header, data = parts_of(saved)
    for key in ("filter", "association"):
        file = write(tmp_path / "evil.slam", header | {key: f"{mine}:Mine"}, data)
        for named in ({}, {"filter": "iekf", "association__method": "known"}):
            with pytest.raises(InputError, match=r"evil\.slam: found a drive by the"):
                Slam.load(file, **named)
    assert mine not in sys.modules


@pytest.mark.parametrize(
    "name", ["dataclass", "np", "np.f2py.subprocess.Popen", "Motion", "no_landmarks", "Mine.init"]
)
def test_only_records_defined_in_the_named_module_are_constructed(mine, tmp_path, name):
    named = {"filter": f"{mine}:Mine"}
    header, data = parts_of(driven(Slam(ROBOT, **named), 1).save(tmp_path / "own.slam"))
    for node in header["nodes"]:
        if node[:2] == ["record", ":Reckoned"]:
            node[1] = f":{name}"
    with pytest.raises(InputError, match=r"evil\.slam: found what"):
        Slam.load(write(tmp_path / "evil.slam", header, data), **named)


@pytest.mark.parametrize("value", ["object()", "print", "np.array([None])", "type('X', (), {})()"])
def test_unsupported_values_are_rejected_by_save(mine, tmp_path, value):
    text = OWN.replace("np.float32([7])", value)
    (tmp_path / "mine_saved.py").write_text(text)
    slam = Slam(ROBOT, filter=f"{mine}:Mine")
    with pytest.raises(InputError, match=r"own\.slam: found a belief or memory with a.*mine_saved"):
        slam.save(tmp_path / "own.slam")
    assert not (tmp_path / "own.slam").exists()


def test_names_of_records_are_unique():
    assert len({*RECORDS.values()}) == len(RECORDS) == len({*map(str, RECORDS)})
