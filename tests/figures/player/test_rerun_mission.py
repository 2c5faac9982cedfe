"""The example that writes a recording for the Rerun viewer."""

import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipistrelle.figures.player import playback

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "viewers" / "rerun_mission.py"
MISSING = "rerun-sdk is not installed: python -m pip install rerun-sdk"


@pytest.fixture(scope="module")
def example():
    return SimpleNamespace(**runpy.run_path(str(EXAMPLE), run_name="example"))


def test_a_long_path_is_thinned_and_keeps_its_ends(example):
    path = np.random.default_rng(1).normal(size=(4001, 3))
    few = example._so_far(path)
    assert len(few) <= example.MAX_LEGS + 2
    np.testing.assert_array_equal(few[[0, -1]], path[[0, -1], :2])


def entities(file):
    """Return the entities of a recording by the reader of either version of the package."""
    try:
        from rerun.chunk import RrdReader
    except ImportError:
        from rerun.dataframe import load_recording
    else:
        return {str(column.entity_path) for column in columns(RrdReader(file).store())}
    return {str(column.entity_path) for column in columns(load_recording(file))}


def columns(recording):
    return recording.schema().component_columns()


def test_a_recording_contains_the_entities_of_the_page(example, played, tmp_path):
    rerun = pytest.importorskip("rerun", reason=MISSING)
    rerun.set_strict_mode(True)
    file = tmp_path / "mission.rrd"
    file.write_bytes(example.recording(played))
    found = entities(file)
    parts = ("path", "vehicle", "placed", "landmarks", "rays", "pruned", "ranges", "bearings")
    assert {f"/passive_ekf/{part}" for part in parts} <= found
    assert {"/fused_fastslam/particles", "/fused_ekf/beam"} <= found
    assert "/passive_ekf/beam" not in found
    assert {"/truth/path", "/truth/vehicle", "/truth/landmarks", "/truth/beacon"} <= found
    assert not {name for name in found if name.endswith(("/excess_paths", "/callers"))}
    errors = {f"/{what}/active_ekf/{part}" for what in ("position", "heading")
              for part in ("error", "bound")}  # fmt: skip
    assert errors <= found


def test_a_recording_contains_excess_paths_of_timed_missions(example, timed, tmp_path):
    rerun = pytest.importorskip("rerun", reason=MISSING)
    rerun.set_strict_mode(True)
    played = playback(*timed)
    nowhere = tuple((label, name, np.full(2, np.nan)) for label, name, _ in played.callers[:1])
    file = tmp_path / "mission.rrd"
    file.write_bytes(example.recording(replace(played, callers=(*nowhere, *played.callers[1:]))))
    found = entities(file)
    assert {"/fused_ekf/excess_paths", "/fused_ekf/callers", "/truth/mate", "/truth/boat"} <= found
    assert "/truth/beacon" not in found, "its position is unknown"
