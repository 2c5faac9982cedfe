"""The bench judges, compares and writes as it says; no timing is asserted."""

import json
from dataclasses import replace
from math import inf
from pathlib import Path

import pytest
from benchmarks import __main__ as bench
from benchmarks import callers, growth, peer, programs, robot, stages, study
from benchmarks.promises import PROMISES, REQUIRED, row
from benchmarks.table import HEADINGS, cells, grown, markdown, met, plain, read, rows_of, write

ROOT = Path(__file__).resolve().parents[1]
KEYS = {"name", "value", "unit", "target", "relation", "ratio", "floor", "command"}


def stage(name: str, median: float, **extra: float) -> dict[str, object]:
    """A record as pytest-benchmark writes it."""
    return {
        "name": name,
        "stats": {"median": median},
        "extra_info": {"calibration_s": 0.002, **extra},
    }


STAGES = [
    stage("test_listening_through_one_beam", 0.15, frames=375),
    stage("test_listening_through_twelve_beams", 0.9, frames=4500),
    stage(stages.BOTH, 1.2, over_tones=30.0),
    stage("test_mission[ekf-fused]", 0.010, floor_s=0.004),
    stage("test_mission[fastslam-fused]", 0.1),
]


@pytest.fixture
def measured_nothing(monkeypatch, tmp_path):
    """Let the bench run on invented times, in a folder of its own."""

    def timed(path, *options):
        path.write_text(json.dumps({"benchmarks": STAGES}))
        return ""

    def command_slice(worlds, workers):
        return study.Slice(seconds=600.0 / workers, peak=250_000_000, disk=3e7)

    shares = {"before": 5.0, "world": 4.0, "listening": 1.0, "filters": 2.75}
    monkeypatch.setattr(stages, "timed", timed)
    monkeypatch.setattr(study, "command_slice", command_slice)
    monkeypatch.setattr(study, "answer", lambda *_: shares)
    monkeypatch.setattr("benchmarks.machine.yardstick", lambda: 0.002)
    monkeypatch.setattr(peer, "find_spec", lambda name: None)
    sound = {"ratio": 1.9, "floor": 2.5, "noise": 2.1, "echoes": 4.9}
    monkeypatch.setattr(callers, "answer", lambda *_: sound)
    loops = {f"{name} {n}": [1.0, 2.0, 3.0] for name in robot.ESTIMATORS for n in robot.LANDMARKS}
    monkeypatch.setattr(robot, "answer", lambda *_: loops)
    monkeypatch.setattr(programs, "_wall", lambda *_, **__: 2.0)
    monkeypatch.setattr(programs, "_run", lambda rounds: 4.0)
    monkeypatch.setattr(bench, "ROOT", tmp_path)
    monkeypatch.setattr(bench, "LATEST", tmp_path / "latest.json")
    monkeypatch.setattr(bench, "HISTORY", tmp_path / "history")
    return tmp_path


def test_a_whole_run_writes_the_promised_rows_and_keys(measured_nothing, capsys):
    bench.bench(save=True)
    report = json.loads((measured_nothing / "latest.json").read_text())
    assert set(report) == {"machine", "rows"}
    assert set(REQUIRED) <= {found["name"] for found in report["rows"]}
    for found in report["rows"]:
        assert set(found) >= KEYS
        assert found["relation"] in ("<=", ">=")
        assert isinstance(found["value"], float)
        assert all(isinstance(found[key], str) for key in ("name", "unit", "command"))
        for key in ("target", "ratio", "floor"):
            assert found[key] is None or isinstance(found[key], (int, float))
    assert {"cpu", "cores", "memory_gb", "python", "numba", "commit"} <= set(report["machine"])
    (kept,) = (measured_nothing / "history").glob("*.json")
    assert read(kept) == report
    told = capsys.readouterr().out
    assert "pip install" in told, "the peer is not there, and how to get it is said"
    assert "NO" not in told.split()


def test_the_rows_follow_from_the_times(measured_nothing):
    bench.bench()
    value = {found.name: found for found in rows_of(read(measured_nothing / "latest.json"))}
    assert value["frame_alone_ms"].value == pytest.approx(0.4)
    assert value["frame_alone_ms"].ratio == pytest.approx(0.2)
    assert value["frame_amortised_ms"].value == pytest.approx(0.2)
    assert value["sweeps_over_tones"].value == pytest.approx(30.0)
    assert value["ekf_mission_ms"].floor == pytest.approx(4.0)
    assert value["study_minutes"].value == pytest.approx(5.0)
    assert value["scaling_2_workers"].value == pytest.approx(2.0)
    assert value["study_overhead"].value == pytest.approx(1.0 - 115 * 3.75 / (5.0 + 115 * 4.0))
    assert value["worker_mb"].value == pytest.approx(250.0)
    assert value["help_ratio"].value == pytest.approx(1.0)


def test_a_part_of_the_bench_writes_nothing(measured_nothing):
    bench.bench(only=("stages",), save=True)
    bench.bench(quick=True, save=True)
    assert list(measured_nothing.iterdir()) == []


def test_a_run_is_compared_with_the_newest_one_kept_or_a_named_one(measured_nothing, capsys):
    bench.bench(save=True)
    bench.bench()
    assert "No row is worse" in capsys.readouterr().out
    report = read(measured_nothing / "latest.json")
    for found in report["rows"]:
        found["ratio"] = found["ratio"] and found["ratio"] / 2.0
    (measured_nothing / "faster.json").write_text(json.dumps(report))
    bench.bench(against=measured_nothing / "faster.json")
    assert "frame_alone_ms: was 2.00 times better in faster.json" in capsys.readouterr().out


def test_the_rate_of_a_study_excludes_each_workers_first_world():
    start_up, world = 3.0, 4.0
    for workers, done in ((1, [7.0, 11.0, 15.0]), (2, [7.0, 7.0, 11.0, 11.0, 15.0, 15.0])):
        whole = study.whole_study(done, workers)
        last = start_up + world * study.WORLDS / workers
        assert whole == pytest.approx(last, abs=0.5 * world), "115 is odd: half a world may remain"


@pytest.mark.parametrize(
    ("value", "relation", "kept"),
    [
        (1.0, "<=", True),
        (0.9, "<=", True),
        (1.1, "<=", False),
        (1.0, ">=", True),
        (0.9, ">=", False),
        (1.1, ">=", True),
    ],
)
def test_a_promise_is_kept_on_its_side_of_the_target_inclusive(value, relation, kept):
    found = replace(row("help_ratio", value, ""), target=1.0, relation=relation)
    assert met(found) is kept
    assert cells(found)[HEADINGS.index("met")] == ("yes" if kept else "NO")
    assert met(replace(found, target=None)) is None


def test_a_row_is_worse_by_its_ratio_not_by_its_time():
    before = [row("frame_alone_ms", 0.5, "", ratio=0.2), row("worker_mb", 200.0, "")]
    busy = [row("frame_alone_ms", 1.0, "", ratio=0.2), row("worker_mb", 200.0, "")]
    slow = [row("frame_alone_ms", 0.5, "", ratio=0.4), row("worker_mb", 300.0, "")]
    assert grown(busy, before, 1.25) == []
    expected = pytest.approx({"frame_alone_ms": 2.0, "worker_mb": 1.5})
    assert dict(grown(slow, before, 1.25)) == expected
    assert grown(before, slow, 1.25) == []


def test_where_more_is_better_less_is_worse():
    before = [row("scaling_2_workers", 2.0, "", ratio=2.0)]
    after = [row("scaling_2_workers", 1.0, "", ratio=1.0)]
    assert grown(after, before, 1.25) == [("scaling_2_workers", 2.0)]
    assert grown(before, after, 1.25) == []


def test_a_row_that_was_nothing_is_worse_when_it_breaks_its_promise():
    before = [row("memory_growth_mb", -1.0, ""), row("study_overhead", 0.0, "", ratio=0.0)]
    little = [row("memory_growth_mb", 9.0, ""), row("study_overhead", 0.09, "", ratio=0.09)]
    much = [row("memory_growth_mb", 80.0, ""), row("study_overhead", 0.5, "", ratio=0.5)]
    assert grown(little, before, 1.25) == []
    assert grown(much, before, 1.25) == [("memory_growth_mb", inf), ("study_overhead", inf)]


def test_growth_is_the_power_of_the_larger_sizes(monkeypatch):
    sizes = [
        {"arrivals": n, "landmarks": n, "frame_s": 1e-4 + 1e-5 * n, "fastslam_s": 1e-6}
        for n in (10.0, 1e4, 1e5, 1e6)
    ]
    sizes += [{"states": n, "ekf_s": 1.0 + 1e-9 * n**2} for n in (10.0, 1e4, 1e5, 1e6)]
    monkeypatch.setattr(growth, "answer", lambda *_: {"points": sizes})
    slice_of = {2: 250, 6: 253}
    monkeypatch.setattr(
        growth,
        "command_slice",
        lambda worlds, _: study.Slice(seconds=1.0, peak=slice_of[worlds] * 10**6, disk=1.0),
    )
    rows, _ = growth.measure()
    found = {part.name: part.value for part in rows}
    assert found["frame_growth"] == pytest.approx(1.0)
    assert found["ekf_growth"] == pytest.approx(2.0, abs=1e-3)
    assert found["fastslam_growth"] == pytest.approx(0.0, abs=1e-9)
    assert found["memory_growth_mb"] == pytest.approx(3.0)


def test_rows_survive_a_file_and_appear_in_both_layouts(tmp_path):
    rows = [row(name, 1.0, "./dev bench", note=f"on {name}") for name in PROMISES]
    write(tmp_path / "kept.json", {"cores": 2}, rows)
    report = read(tmp_path / "kept.json")
    assert rows_of(report) == rows
    for text in (plain(rows), markdown(report)):
        assert all(name in text for name in PROMISES)
    assert "cores 2" in markdown(report)


def test_a_number_that_is_none_of_json_is_refused(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write(tmp_path / "kept.json", {}, [row("help_ratio", float("nan"), "")])


def test_the_page_on_performance_explains_every_row():
    page, rows = (ROOT / name for name in ("docs/performance.md", "benchmarks/README.md"))
    assert [name for name in PROMISES if f"`{name}`" not in rows.read_text()] == []
    assert "<!-- benchmarks -->" in page.read_text()
