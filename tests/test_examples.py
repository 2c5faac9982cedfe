"""Each example runs as it is and ends in one number, which is right."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipistrelle.detection.scans import with_columns

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture
def play(monkeypatch):
    """Run an example without a window and return its variables."""
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    mpl.use("Agg")
    monkeypatch.setattr(plt, "show", lambda: None)
    yield lambda name: runpy.run_path(str(EXAMPLES / f"{name}.py"))
    plt.close("all")


def test_every_example_is_tested():
    names = {path.stem for path in EXAMPLES.glob("*.py")}
    here = Path(__file__).read_text(encoding="utf-8")
    assert names
    assert {name for name in names if f'play("{name}")' not in here} == set()


def test_the_piston_of_8_8_mm_sends_half_its_power_at_half_its_beamwidth(play):
    done = play("01_piston_beam")
    edge = np.radians(done["answer"] / 2)
    pressure = done["piston_directivity"](edge, radius=8.8e-3, **done["call"])
    assert pressure**2 == pytest.approx(0.5, abs=1e-12)
    assert done["answer"] == pytest.approx(33.2, abs=0.2)  # Appendix B, halves cut to a tenth


def test_the_frame_tells_the_range_of_landmark_1_to_a_centimetre(play):
    done = play("02_one_frame")
    gain = 10 * np.log10(done["length"] * 10)  # of matched filter and beam
    level = done["arrivals"].level_db[done["arrivals"].landmark == 1].max()
    assert level + gain > 20, "loud enough for a centimetre"
    assert done["answer"] < 0.01


def test_the_fused_mission_knows_what_either_strategy_knows(play):
    done = play("03_three_strategies")
    known = done["known"]
    assert known["fused"] == known["active"] | known["passive"]
    assert done["answer"] == len(known["passive"] - known["active"]) > 0


def test_the_log_is_mapped_as_well_as_the_filter_says(play):
    done = play("04_your_own_log")
    landmarks = done["trial"].track.landmarks
    stated = np.sqrt(np.mean(np.trace(landmarks.covariance, axis1=1, axis2=2)))
    assert done["trial"].scores.landmarks_full == 6
    assert done["answer"] < 3.3 * stated < 1.0  # 99.9 % of one normal: the map turns as a whole
    mirrored = tuple(with_columns(scan, bearing=-scan.bearing) for scan in done["log"].scans)
    wrong = replace(done["log"], scans=mirrored)
    (control,) = done["replay"](wrong, done["truth"], ["fused"], ["ekf"], None, done["Config"]())
    assert control.scores.map_rmse_m > 3.3 * stated, "bearings the wrong way round must fail"
