from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.report.claims.published import (
    CROSSING,
    NARROW,
    TABLE_II,
    cell_of,
    papers_cases,
    row_name,
)
from pipistrelle.report.variables import BEAMWIDTHS, beam_name, setting_variable
from report.invented import BEAMWIDTH, invent, narrowed, only, with_third


def test_the_beams_of_the_papers_radii_bear_the_papers_names():
    assert [beam_name(width) for width in BEAMWIDTH] == [f"{width:.0f}°" for width in BEAMWIDTHS]
    assert [beam_name(width) for width in (12.5, 20.0, 90.0)] == ["12°", "20°", "90°"]


def test_below_begins_with_the_beam_narrower_than_the_papers_threshold():
    assert [beam_name(w) for w in BEAMWIDTH[BEAMWIDTH < CROSSING]][-1] == "33°"
    assert [beam_name(w) for w in BEAMWIDTH[BEAMWIDTH < NARROW]][-1] == "51°"


def test_every_row_of_table_ii_finds_its_case():
    study = invent(2)
    found = [cell_of(study, row) for row in TABLE_II]
    assert [cell[2] for cell in found] == [11, 5, 0, 0] * 2
    assert [cell[1] for cell in found] == ["fused", "fused", "fused", "passive"] * 2
    assert [row_name(row) for row in TABLE_II[:4]] == ["180°", "33°", "11°", "passive (0°)"]


def test_a_row_without_its_case_finds_none():
    study = only(invent(2), [("ekf", "fused")])
    assert [cell_of(study, row) is None for row in TABLE_II] == [False] * 3 + [True] * 5


@pytest.mark.parametrize("row", TABLE_II)
def test_more_landmarks_are_seen_than_placed(row):
    assert row.total[0] > row.full[0]
    assert np.all(np.array([*row.full, *row.total]) > 0)


def test_a_study_holds_the_papers_cases_with_all_of_them_and_no_other_variable():
    study = invent(2)
    assert papers_cases(study)
    assert papers_cases(with_third(study, "toy:Slam")), "another filter beside them"
    for way in study.trials:
        assert not papers_cases(only(study, [other for other in study.trials if other != way]))
    assert not papers_cases(narrowed(study, range(1, 12))), "eleven of its beams"
    level = setting_variable("beacon.level_db", [36.8, 48.8])
    assert not papers_cases(replace(study, variables=(*study.variables, level)))
    assert not papers_cases(replace(study, variables=()))
