"""Rows of effects: what the answer's one sentence for each variable leaves to the table."""

import pytest

from pipistrelle.report.claims.contrasts import selections
from pipistrelle.report.effects.answer import HEADLINE, OTHERWISE
from pipistrelle.report.effects.comparing import effects_of
from pipistrelle.report.page.effect_tables import case_rows, effect_tables
from pipistrelle.report.reading import read_study
from report.planted import by_level, write_planted

TWO = '"beacon.level_db" = [36.8, 48.8]\n"rays.power" = [1.0, 3.0]'


@pytest.fixture
def rows(tmp_path):
    """The rows on beacon.level_db of a study whose effect is planted."""

    def rows(*args, **given):
        write_planted(tmp_path / "s", *args, **given)
        by_rule = selections(read_study(tmp_path / "s"))
        effects = [effects_of(by_rule[rule]) for rule in (HEADLINE, OTHERWISE)]
        return effect_tables(by_rule[HEADLINE], *effects)[0]["rows"]

    return rows


@pytest.mark.parametrize("second", [1.0, -1.0])
def test_each_of_few_combinations_has_a_row_and_one_with_the_opposite_is_marked(rows, second):
    def effect(case):
        sign = {1.0: 1.0, 3.0: second}[case.values["rays.power"]]
        return {"position_rmse_m": sign * 0.5 * (case.values["beacon.level_db"] > 40.0)}

    mean, *apart = rows(TWO, effect=effect)
    assert [row["label"] for row in apart] == ["at rays.power = 1", "at rays.power = 3"]
    assert [row["cells"][0]["text"][:4] for row in apart] == [
        "+0.5" if second > 0 else row["cells"][0]["text"][:4] for row in apart
    ]
    assert all(row["below"] and row["cells"][0]["shown"] for row in apart)
    assert mean["cells"][0]["shown"] is (second > 0)
    assert [row["contrary"] for row in apart] == [second < 0] * 2


def test_an_effect_that_hangs_on_what_diverged_has_a_second_row(rows):
    """In three of sixteen worlds the highest level makes the filter diverge, far off."""

    def diverged(case, world):
        return case.values["beacon.level_db"] == 48.8 and world < 3

    def effect(case):
        return {"position_rmse_m": -0.05 * (case.values["beacon.level_db"] == 48.8)}

    given = {"worlds": 16, "effect": effect, "diverged": diverged}
    labels = [row["label"] for row in rows(**given)]
    assert "without diverged cases" not in labels, "the same either way"
    found = rows(**given, far=3.0)
    assert not found[1]["cells"][0]["shown"]
    (without,) = (row for row in found if row["below"])
    assert (without["label"], without["contrary"]) == ("without diverged cases", True)
    assert without["cells"][0]["shown"]
    assert without["cells"][0]["text"].startswith("−0.0")


def test_cases_have_floor_bound_and_the_multiple_of_the_bound(tmp_path):
    write_planted(tmp_path / "s", effect=by_level(0.3))
    row = case_rows(selections(read_study(tmp_path / "s"))[HEADLINE])[0]
    assert row["position_floor_m"] is None, "the planted study has none"
    assert row["position_bound_m"] == pytest.approx(0.25, abs=0.02)
    assert row["times_the_bound"] == pytest.approx(0.8 / 0.25, rel=0.1)
