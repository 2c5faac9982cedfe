from pipistrelle.estimation.beliefs import no_landmarks, placed
from reference.missions import map_with


def test_a_landmark_is_placed_when_it_has_a_single_row():
    assert placed(map_with([5, 2, 5, 9])).tolist() == [False, True, False, True]


def test_nothing_is_placed_in_an_empty_map():
    assert placed(no_landmarks()).tolist() == []
