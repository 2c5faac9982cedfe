"""Which landmarks are placed, and the defaults of a belief of an outside class."""

import pytest

from pipistrelle.config import Config, InputError
from pipistrelle.estimation.beliefs import (
    NO_INNOVATIONS,
    Association,
    Belief,
    Innovations,
    completed,
    no_landmarks,
    placed,
    revises_path,
)
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.estimation.motion import Motion
from pipistrelle.experiments.runs.validate import first_belief
from reference.missions import START, map_with


def test_a_landmark_is_placed_when_it_has_a_single_row():
    assert placed(map_with([5, 2, 5, 9])).tolist() == [False, True, False, True]


def test_nothing_is_placed_in_an_empty_map():
    assert placed(no_landmarks()).tolist() == []


class Noted:
    """A belief without a base class."""

    gated, innovations = 3, Innovations(4.0, 2.0)

    def pose(self):
        return START

    def landmarks(self):
        return map_with([5])


class Heir(Belief):
    """A belief that inherits from it."""

    def pose(self):
        return START

    def landmarks(self):
        return map_with([5])


@pytest.mark.parametrize("kind", [Noted, Heir])
def test_a_belief_of_an_outside_class_has_defaults_for_missing_methods(kind):
    belief = completed(kind(), Belief)
    assert (belief.pose(), belief.landmarks().landmark.tolist()) == (START, [5])
    assert (belief.path(), belief.tracks(), belief.cloud(), belief.labels()) == (None,) * 4
    assert (belief.moving().landmark.size, belief.calibration(), belief.full) == (0, {}, None)
    of_its_own = Noted.gated, Noted.innovations
    assert (belief.gated, belief.innovations) == (
        of_its_own if kind is Noted else (0, NO_INNOVATIONS)
    )
    with pytest.raises(InputError, match=f"found a {kind.__name__}, expected one with joint"):
        belief.joint()
    with pytest.raises(InputError, match=f"but a {kind.__name__} cannot; expected a belief with"):
        belief.edited((5,), ())


def test_an_association_of_an_outside_class_has_defaults_for_missing_methods():
    association = completed(Noted(), Association)
    assert association.knowing("memory", no_landmarks(), ()) == "memory"
    assert [*association.tentative("memory")] == []
    with pytest.raises(InputError, match=r"but a Noted has no carried\(memory, later\)"):
        association.carried("memory", None)


def test_only_a_smoother_revises_its_path():
    motion = Motion(model="unicycle", control_std=(0.1, 0.1))
    beliefs = {name: first_belief(name, motion, Config()) for name in CATALOGUE}
    assert [name for name, belief in beliefs.items() if revises_path(belief)] == ["smoother"]
    assert not revises_path(Noted())
    assert not revises_path(Heir())
