"""Known association without a gate: by the arrival that caused a peak, by the nearest bearing."""

import numpy as np
import pytest

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.arrays.layout import square_of_four
from pipistrelle.config import Config
from pipistrelle.detection.snapshots import Detections
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import world_of
from reference.papers import papers_module

LAYOUT = square_of_four(Config().receiver)
PULSE = 2.8e-3


@pytest.fixture(scope="module")
def oracles():
    return papers_module("oracles")


def arrivals(delay, bearing, level_db, landmark=(7, 9)):
    return Arrivals(
        delay=np.array(delay), level_db=np.array(level_db), bearing=np.array(bearing),
        frequency=np.full(2, 35e3), caller=np.zeros(2, np.int8), landmark=np.array(landmark),
    )  # fmt: skip


def detection(bearing, delay=0.03, face=0):
    one = np.array([bearing])
    return Detections(
        face=np.array([face]), caller=np.zeros(1, int), angle=one - LAYOUT.normal[face],
        bearing=one, delay=np.array([delay]), power=np.ones(1),
    )  # fmt: skip


def label(oracle, found, true):
    return oracle(found, true, LAYOUT, None, pulse=PULSE, faintest_db=-30.0).tolist()


def test_a_peak_between_two_arrivals_is_caused_by_the_louder_one(oracles):
    between = detection(0.15)
    louder = arrivals([0.03, 0.03], [0.0, 0.3], [20.0, 0.0])
    assert label(oracles.label_by_cause, between, louder) == [7]
    fainter = arrivals([0.03, 0.03], [0.0, 0.3], [0.0, 20.0])
    assert label(oracles.label_by_cause, between, fainter) == [9]


def test_a_peak_is_caused_by_the_arrival_in_its_beam(oracles):
    equal = arrivals([0.03, 0.03], [0.0, 0.5], [10.0, 10.0])
    assert label(oracles.label_by_cause, detection(0.02), equal) == [7]
    assert label(oracles.label_by_cause, detection(0.48), equal) == [9]


def test_the_nearest_bearing_wins_however_faint_or_far(oracles):
    true = arrivals([0.03, 0.0305], [-0.6, 0.9], [40.0, -20.0])
    assert label(oracles.label_by_bearing, detection(0.2), true) == [9]
    assert label(oracles.label_by_bearing, detection(0.1), true) == [7]


@pytest.mark.parametrize("name", ["label_by_cause", "label_by_bearing"])
def test_nothing_that_overlaps_gives_no_label(oracles, name):
    oracle = getattr(oracles, name)
    early = arrivals([0.01, 0.05], [0.0, 0.1], [10.0, 10.0])
    assert label(oracle, detection(0.0), early) == [-1]
    inaudible = arrivals([0.03, 0.03], [0.0, 0.1], [-40.0, -40.0])
    assert label(oracle, detection(0.0), inaudible) == [-1]
    behind = arrivals([0.03, 0.03], [np.pi, -3.0], [10.0, 10.0])
    assert label(oracle, detection(0.0), behind) == [-1]


def test_both_label_nearly_as_the_gates_do_where_these_give_a_label(oracles):
    config = Config(seed=3)
    config = config.model_copy(
        update={"scenario": config.scenario.model_copy(update={"steps": 80})}
    )
    world, labels = world_of(config), {}
    for name in ("gates", "label_by_cause", "label_by_bearing"):
        more = {} if name == "gates" else {"oracle": getattr(oracles, name)}
        (heard,) = listen(world, config, [0.0025], **more)
        labels[name] = [set(zip(f.rows.landmark, f.rows.caller, strict=True)) for f in heard]
    gated = sum(map(len, labels["gates"]))
    for name in ("label_by_cause", "label_by_bearing"):
        both = sum(len(a & b) for a, b in zip(labels["gates"], labels[name], strict=True))
        assert both > 0.85 * gated
        assert sum(map(len, labels[name])) > gated
