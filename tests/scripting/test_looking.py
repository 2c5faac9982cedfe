"""The overview of a log and of a recording before it is solved."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import soundfile

import pipistrelle
from pipistrelle.config import InputError
from pipistrelle.detection.logs.folder import write_log
from pipistrelle.detection.scans import with_columns
from pipistrelle.experiments.drives import NO_TRUTH, reckoned
from pipistrelle.experiments.runs.replay import drive_of
from pipistrelle.geometry import wrap
from pipistrelle.scripting.hearing import long_gaps
from pipistrelle.scripting.log_warnings import CHANCE
from reference.spoilt_logs import noisy_log

LOG = noisy_log(steps=200)


def scans_at(times):
    """A log with equal scans at given times, from 0 to 100 s."""
    scans = tuple(replace(LOG.scans[0], time=time) for time in times)
    return replace(LOG, time=np.linspace(0.0, 100.0, 1001), scans=scans)


def line(found, name):
    return next(line[13:] for line in found.lines if line.startswith(f"{name} "))


def test_numbers_of_a_log_are_counts_of_its_rows(timed_log):
    found = pipistrelle.look(timed_log)
    rows = pl.read_csv(timed_log / "measurements.csv", infer_schema_length=None)
    assert line(found, "rows").startswith(f"{rows.height} in {rows['time'].n_unique()} scans")
    assert line(found, "labels") == f"{rows.height} rows with a label, 0 without"
    count = rows["landmark"].value_counts()["count"]
    many = f"{count.len()}, each in {count.min()} to {count.max()} rows"
    assert line(found, "landmarks").startswith(many)
    share, low, high = rows["range"].count() / rows.height, rows["range"].min(), rows["range"].max()
    assert line(found, "range").startswith(f"in {share:.0%} of the rows, {low:.3g} to {high:.3g} m")
    assert [len(axes.lines) > 0 for axes in found.figure().axes] == [True] * 5


def test_gaps_are_intervals_that_random_scans_rarely_have():
    regular = np.arange(0.5, 100.0, 0.5)
    assert not len(long_gaps(scans_at(regular)))
    (gap,) = long_gaps(scans_at(regular[(regular <= 40.0) | (regular >= 60.0)]))
    assert gap.tolist() == [40.0, 60.0]
    rng, drives = np.random.default_rng(2), 400
    found = sum(bool(len(long_gaps(scans_at(rng.uniform(0, 100, 300))))) for _ in range(drives))
    assert found <= CHANCE * drives + 3.0 * np.sqrt(CHANCE * drives)
    bursts = np.repeat(rng.uniform(0, 100, 30), 10) + rng.uniform(0.0, 0.1, 300)
    assert len(long_gaps(scans_at(np.clip(bursts, 0.0, 100.0)))), "control: not at random"


def test_odometry_of_a_constant_turn_leads_along_a_circle():
    speed, rate = LOG.controls[0]
    log = replace(LOG, initial_pose=(3.0, -1.0, 0.5 * np.pi))
    path = reckoned(drive_of(log, NO_TRUTH)).mean
    centre, radius = np.array([3.0 - speed / rate, -1.0]), speed / rate
    np.testing.assert_allclose(np.hypot(*(path[:, :2] - centre).T), radius, rtol=1e-3)
    np.testing.assert_allclose(wrap(path[:, 2] - 0.5 * np.pi - rate * LOG.time), 0.0, atol=1e-9)


def test_a_log_of_few_rows_and_no_bearings_is_drawn(tmp_path):
    log = noisy_log(steps=5)
    scans = (with_columns(log.scans[0], bearing=np.nan),)
    write_log(tmp_path / "log", replace(log, scans=scans, bearings=None))
    found = pipistrelle.look(tmp_path / "log")
    assert line(found, "bearing") == "none"
    assert found.figure().axes


def test_a_wrong_unit_is_named_before_the_log_is_solved(tmp_path):
    for name, log in (("good", LOG), ("bad", noisy_log(spoil="clockwise:"))):
        write_log(tmp_path / name, log)
    assert pipistrelle.look(tmp_path / "good").odd == ()
    assert "bearings seem to be clockwise" in "".join(pipistrelle.look(tmp_path / "bad").odd)


def test_a_recording_is_described_with_its_level_and_the_faults_that_hear_finds(short_tape):
    found = pipistrelle.look(short_tape)
    samples, rate = soundfile.read(short_tape / "recording.wav")
    assert line(found, "channels").startswith(f"{samples.shape[1]} at {rate} Hz, ")
    assert line(found, "calls").startswith("8 of the vehicle, 0.5 s apart")
    peak = 20.0 * np.log10(np.abs(samples).max())
    assert f"to {peak:.1f} dB, where" in line(found, "level")
    (image,) = found.figure().axes[0].images
    level = np.array(image.get_array())[::-1, 0]
    assert 0.5 * rate * level.argmax() / (level.size - 1) == pytest.approx(35e3, rel=0.02)


def test_results_and_settings_of_a_solution_are_refused(short_run, short_log):
    with pytest.raises(InputError, match="found results, expected a log folder or"):
        pipistrelle.look(short_run)
    with pytest.raises(InputError, match="rays__exponent: means nothing to a log before"):
        pipistrelle.look(short_log, rays__exponent=3.0)
