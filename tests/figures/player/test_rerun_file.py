"""A recording for the Rerun viewer, where its package is; a clear line where it is not."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import InputError
from pipistrelle.figures.player import rerun_file
from pipistrelle.figures.player.playback import playback
from pipistrelle.figures.player.rerun_file import check_there, recording


def test_what_is_not_installed_is_said_with_its_fix(played, monkeypatch):
    monkeypatch.setattr(rerun_file, "find_spec", lambda _: None)
    for ask in (check_there, lambda: recording(played)):
        with pytest.raises(InputError) as refusal:
            ask()
        assert str(refusal.value) == (
            "--rerun: needs rerun-sdk, which is not installed; "
            "python -m pip install 'pipistrelle[view]' installs it"
        )


def test_a_path_so_far_has_few_legs_and_its_ends():
    path = np.random.default_rng(1).normal(size=(4001, 3))
    few = rerun_file._so_far(path)
    assert len(few) <= rerun_file.MAX_LEGS + 2
    np.testing.assert_array_equal(few[[0, -1]], path[[0, -1], :2])


def entities(file):
    """What a recording tells of, as the package's own reader says: its place has moved."""
    try:
        from rerun.chunk import RrdReader
    except ImportError:
        from rerun.dataframe import load_recording
    else:
        return {str(column.entity_path) for column in columns(RrdReader(file).store())}
    return {str(column.entity_path) for column in columns(load_recording(file))}


def columns(recording):
    return recording.schema().component_columns()


def test_a_recording_tells_of_all_that_the_page_shows(played, tmp_path):
    rerun = pytest.importorskip(
        "rerun", reason="rerun-sdk is not installed: pip install 'pipistrelle[view]'"
    )
    rerun.set_strict_mode(True)
    file = tmp_path / "mission.rrd"
    file.write_bytes(recording(played))
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


def test_a_recording_tells_of_excess_paths_where_some_were_heard(timed, tmp_path):
    rerun = pytest.importorskip(
        "rerun", reason="rerun-sdk is not installed: pip install 'pipistrelle[view]'"
    )
    rerun.set_strict_mode(True)
    told = playback(*timed)
    nowhere = tuple((label, name, np.full(2, np.nan)) for label, name, _ in told.callers[:1])
    file = tmp_path / "mission.rrd"
    file.write_bytes(recording(replace(told, callers=(*nowhere, *told.callers[1:]))))
    found = entities(file)
    assert {"/fused_ekf/excess_paths", "/fused_ekf/callers", "/truth/mate", "/truth/boat"} <= found
    assert "/truth/beacon" not in found, "nobody knows where"
