"""What looks odd in a recorded log is asked about, and what does not is not."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipistrelle.config import Config
from pipistrelle.scripting.log_settings import fit_warnings
from reference.missions import scan_with


def log_of(**columns):
    """A log of one scan of ten rows, from half a metre to 20 m."""
    scan = scan_with(np.arange(10), np.zeros(10), **columns)
    return SimpleNamespace(scans=[scan], turned=0, range_bounds=(0.5, 20.0), motion="unicycle")


def trial_of(scan, gated):
    track = SimpleNamespace(pose=SimpleNamespace(mean=np.zeros((2, 3))))
    scores = SimpleNamespace(gated=gated, nis_mean=None)
    return SimpleNamespace(
        scans=[scan], scores=scores, filter="ekf", strategy="active", track=track
    )


@pytest.mark.parametrize(("gated", "asked"), [(1, False), (2, True)])
def test_units_are_asked_about_by_the_share_of_what_a_strategy_heard(gated, asked):
    heard = scan_with(np.arange(5), np.zeros(5), np.ones(5))
    lines = fit_warnings(
        log_of(distance=np.ones(10)), [trial_of(heard, gated)], Path("log"), Config()
    )
    assert any(f"{gated} of 5 measurements do not fit" in line for line in lines) == asked
    assert len(lines) == 1, "else it is said that the gate rejects more than its share"


@pytest.mark.parametrize(("short", "asked"), [(8, False), (9, True)])
def test_short_excess_paths_are_asked_about_where_nearly_all_are(short, asked):
    excess_path = np.where(np.arange(10) < short, 0.19, 3.0)
    lines = fit_warnings(
        log_of(excess_path=excess_path, excess_path_std=0.1, caller=1), [], Path("log"), Config()
    )
    assert [f"{short} of 10 excess paths are below 0.2 m" in line for line in lines] == [
        True
    ] * asked
