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


def trial_of(scan, gated, **more):
    track = SimpleNamespace(pose=SimpleNamespace(mean=np.zeros((2, 3))))
    scores = SimpleNamespace(gated=gated, nis_mean=None)
    return SimpleNamespace(
        scans=[scan], scores=scores, filter="ekf", strategy="active", track=track,
        **{"heard": [scan], "left_out": {}} | more,
    )  # fmt: skip


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


NOTHING = scan_with(np.arange(0), np.zeros(0), np.zeros(0))


@pytest.mark.parametrize("rows", [0, 5])
def test_nothing_is_said_to_be_heard_only_where_nothing_was(rows):
    heard = scan_with(np.arange(rows), np.zeros(rows), np.ones(rows))
    trial = trial_of(NOTHING, 0, heard=[heard])
    (line,) = fit_warnings(log_of(distance=np.ones(10)), [trial], Path("log"), Config())
    assert ("nothing in it is heard by active sensing" in line) == (not rows)
    assert ("none of the 5 rows of active sensing is of a landmark" in line) == (rows == 5)


@pytest.mark.parametrize(
    ("left_out", "parts"),
    [
        ({"bearing_std": [0.0866] * 3}, ("3 rows of active", "0.087 rad, is above", "-std 0.09 ")),
        ({"bearing_std": [0.06, 0.3]}, ("0.06 to 0.3 rad", "--association.bearing-std 0.3 takes")),
        ({"bearing_std": [0.06, 1.4]}, ("0.06 to 1.4 rad", "bearing-std 0.06 takes 1 of them")),
        ({"bearing_std": [1.4]}, ("1 rows", "association.bearing_std, 0.05 rad")),
        ({"way_std": [0.4, 12.1]}, ("of their ranges, 0.4 to 12 m", "--association.way-std 20 ")),
    ],
)
def test_rows_that_a_limit_leaves_out_are_told_with_what_takes_them(left_out, parts):
    trial = trial_of(NOTHING, 0, left_out={k: np.array(v) for k, v in left_out.items()})
    both = [trial, trial]
    *_, line = fit_warnings(log_of(distance=np.ones(10)), both, Path("log"), Config())
    for part in parts:
        assert part in line
    ((_, stds),) = left_out.items()
    assert ("takes" in line) == (min(stds) < 0.45)
