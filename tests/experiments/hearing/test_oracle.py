from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipistrelle.acoustics.arrivals import Arrivals, arrivals_at
from pipistrelle.acoustics.paths import callers_of
from pipistrelle.arrays.layout import square_of_four
from pipistrelle.arrays.receiver import add_echo_blocks
from pipistrelle.arrays.sampling import sampling
from pipistrelle.config import Config, MatchingConfig
from pipistrelle.detection.matched import filter_blocks
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.detection.snapshots import Detections, detector
from pipistrelle.experiments.hearing.oracle import faintest_level_db, label_detections
from pipistrelle.geometry import wrap

law = settings(deadline=None, max_examples=100)
SEEDS = st.integers(0, 2**32 - 1)
LAYOUT = square_of_four(Config().receiver)
GATES = MatchingConfig()
PULSE = 2.8e-3
FAINTEST = -30.0


def true_arrivals(*rows):
    """Return arrivals of rows (delay [ms], bearing [rad], source, landmark, level [dB])."""
    delay, bearing, source, landmark, level_db = (np.array(c) for c in zip(*rows, strict=True))
    return Arrivals(
        delay=1e-3 * delay,
        level_db=level_db.astype(float),
        bearing=bearing.astype(float),
        frequency=np.full(delay.size, 30e3),
        caller=source.astype(np.int8),
        landmark=landmark,
    )


def detections(*rows):
    """Return detections of rows (delay [ms], bearing [rad], tone, face, power)."""
    delay, bearing, tone, face, power = (np.array(c) for c in zip(*rows, strict=True))
    return Detections(
        face=face,
        caller=tone,
        angle=wrap(bearing - LAYOUT.normal[face]),
        bearing=bearing.astype(float),
        delay=1e-3 * delay,
        power=power.astype(float),
    )


def labels(found, arrivals, gates=GATES):
    return label_detections(
        found, arrivals, LAYOUT, gates, pulse=PULSE, faintest_db=FAINTEST
    ).tolist()


def crowd(seed):
    """Return arrivals of 12 landmarks and detections, some near them and some anywhere."""
    rng = np.random.default_rng(seed)
    bearing, delay = rng.uniform(-np.pi, np.pi, 24), rng.uniform(5.0, 12.0, 24)
    source, landmark = np.repeat([0, 1], 12), np.tile(np.arange(1, 13), 2)
    level_db = rng.uniform(-36.0, 0.0, 24)
    arrivals = true_arrivals(*zip(delay, bearing, source, landmark, level_db, strict=True))
    near = rng.integers(0, 24, 60)
    seen = wrap(bearing[near] + rng.normal(0.0, 0.08, 60))
    face = np.argmax(np.cos(seen[:, None] - LAYOUT.normal) + rng.uniform(0, 1.0, (60, 4)), axis=1)
    rows = (
        delay[near] + rng.normal(0.0, 0.5, 60),
        seen,
        source[near],
        face,
        rng.exponential(9, 60),
    )
    return detections(*zip(*rows, strict=True)), arrivals


def test_where_a_body_hides_the_beacon_the_beacon_is_heard():
    behind = [(30.0, 0.2, 1, landmark, -3.0) for landmark in (3, 7, 9)]
    for nearer in (-1e-15, 0.0, 1e-15):  # what rounding makes of one way measured twice
        ways = [(30.0 * (1.0 + nearer), *row[1:]) for row in behind[:2]] + behind[2:]
        assert labels(detections((30.1, 0.22, 1, 0, 50.0)), true_arrivals(*ways)) == [9]


def slow_labels(found, arrivals):
    """Match one by one, the strongest first, in plain words."""
    label, taken = [UNLABELLED] * found.face.size, set()
    for d in sorted(range(found.face.size), key=lambda d: -found.power[d]):
        nearest = None
        for a in range(arrivals.delay.size):
            off_face = wrap(arrivals.bearing[a] - LAYOUT.normal[found.face[d]])
            late = abs(found.delay[d] - arrivals.delay[a]) / (PULSE / 4)
            off = abs(wrap(found.bearing[d] - arrivals.bearing[a])) / 0.1
            possible = (
                arrivals.caller[a] == found.caller[d]
                and abs(off_face) <= np.pi / 2
                and arrivals.level_db[a] >= FAINTEST
                and (found.face[d], a) not in taken
            )
            if possible and max(late, off) <= 1.0:
                nearest = min(nearest or (np.inf, -1), (late**2 + off**2, a))
        if nearest:
            label[d] = int(arrivals.landmark[nearest[1]])
            taken.add((found.face[d], nearest[1]))
    return label


@given(seed=SEEDS)
@law
def test_labels_match_a_slow_second_version(seed):
    found, arrivals = crowd(seed)
    label = labels(found, arrivals)
    assert label == slow_labels(found, arrivals)


@given(seed=SEEDS)
@law
def test_labels_follow_their_rows_in_any_order(seed):
    found, arrivals = crowd(seed)
    rng = np.random.default_rng(seed)
    rows, truth = rng.permutation(found.face.size), rng.permutation(arrivals.delay.size)
    columns = [f.name for f in fields(found) if f.name != "direct"]
    turned = Detections(**{name: getattr(found, name)[rows] for name in columns})
    other = arrivals_at(arrivals, truth)
    assert labels(turned, other) == np.array(labels(found, arrivals))[rows].tolist()


ONE = true_arrivals((10.0, 0.2, 1, 7, 0.0))


def test_gates_hold_in_delay_and_in_bearing_both():
    for late, off, label in (
        (0.69, 0.099, 7), (-0.69, -0.099, 7),
        (0.71, 0.0, UNLABELLED), (-0.71, 0.0, UNLABELLED),
        (0.0, 0.101, UNLABELLED), (0.0, -0.101, UNLABELLED),
    ):  # fmt: skip
        assert labels(detections((10.0 + late, 0.2 + off, 1, 0, 9)), ONE) == [label]
    wide = MatchingConfig(delay_gate=0.5, bearing_gate=0.2)
    assert labels(detections((11.3, 0.39, 1, 0, 9)), ONE, wide) == [7]


def test_nothing_detected_is_nothing_labelled():
    one = detections((1, 0, 0, 0, 1))
    none = {f.name: getattr(one, f.name)[:0] for f in fields(one) if f.name != "direct"}
    assert labels(Detections(**none), ONE) == []


@pytest.mark.parametrize("margin_db", [0.0, 6.0])
@pytest.mark.parametrize("alarm", [1e-3, 1e-6])
def test_the_faintest_level_is_the_margin_under_an_echo_expected_at_the_threshold(margin_db, alarm):
    config = Config.model_validate(
        {"detection": {"false_alarm": alarm}, "receiver": {"noise_level_db": 4.0}}
    )
    settled = sampling(config, callers_of(config, np.zeros(2)))
    finder = detector(config, LAYOUT, settled.tones)
    level_db = faintest_level_db(
        finder.threshold,
        elements=10,
        samples=settled.pulse * settled.block,
        noise_std=settled.noise_std,
        margin_db=margin_db,
    )
    sums = np.zeros((40, 4, 2, 10), dtype=complex)
    echo = true_arrivals((5.0, 0.2, 1, 7, level_db + margin_db))
    add_echo_blocks(sums, echo, LAYOUT, settled)
    matched = filter_blocks(
        sums, pulse=settled.pulse, block=settled.block, noise_std=settled.noise_std
    )
    energy = np.sum(np.abs(matched[:, 0, 1]) ** 2, axis=-1).max()
    assert energy + 10.0 == pytest.approx(finder.threshold, rel=1e-9)  # the noise's mean is 10
