"""Beamwidths in a grid: the pistons that make them, and what cannot be one."""

import math

import pytest

from pipistrelle.acoustics.emitter import beamwidth, piston_radius
from pipistrelle.config import Config, InputError
from pipistrelle.experiments.studies.plan import cases_of, changed_settings, plan_text
from pipistrelle.experiments.studies.study import open_store
from pipistrelle.settings import from_flags
from reference.studies import plan_of

BARE = "format = 1\niterations = 3\n"
GRID = BARE + '[grid]\nbeamwidth = [180, 90, 33.2, 11]\n"rays.power" = [1.0, 2.0]\n'


def width_of(case, tone=35e3):
    return math.degrees(beamwidth(case.config.emitter.radius, frequency=tone, speed_of_sound=343.0))


def test_a_beamwidth_is_converted_to_its_radius(tmp_path):
    plan = plan_of(tmp_path, GRID)
    assert list(plan.grid) == ["emitter.radius", "rays.power"], "in the place of the beamwidths"
    cases = [case for case in cases_of(plan) if case.strategy == "active"]
    widths = [width_of(case) for case in cases[::4]]
    assert widths[0] == 180.0
    assert widths[1:] == pytest.approx([90.0, 33.2, 11.0], rel=1e-9)


def test_a_radius_is_rounded_to_12_digits(tmp_path):
    radius = plan_of(tmp_path, GRID).grid["emitter.radius"][2]
    exact = float(piston_radius(math.radians(33.2), frequency=35e3, speed_of_sound=343.0))
    assert radius == pytest.approx(exact, rel=2e-12)
    assert radius == float(f"{radius:.12g}")


def test_radii_use_the_plans_tone_and_speed_of_sound(tmp_path):
    told = plan_of(tmp_path, GRID, over=from_flags({"emitter": {"frequency": 20e3}}))
    widths = [width_of(case, tone=20e3) for case in cases_of(told) if case.strategy == "active"]
    assert sorted(set(widths)) == pytest.approx([11.0, 33.2, 90.0, 180.0], rel=1e-9)
    cold = plan_of(tmp_path, GRID + "[config]\nair.temperature_c = -10.0\n")
    assert cold.grid["emitter.radius"][0] < plan_of(tmp_path, GRID).grid["emitter.radius"][0]


def test_a_study_of_beamwidths_goes_on_by_either_way_of_writing_it(tmp_path):
    plan, folder = plan_of(tmp_path, GRID), tmp_path / "study"
    open_store(folder, plan)
    kept = plan_of(tmp_path, (folder / "plan.toml").read_text())
    assert kept == plan
    assert changed_settings(kept, plan_of(tmp_path, GRID)) == []
    assert plan_text(kept) == plan_text(plan)
    open_store(folder, plan_of(tmp_path, GRID, iterations=9))
    with pytest.raises(InputError, match=r"grid\.emitter\.radius: .* there, "):
        open_store(folder, plan_of(tmp_path, GRID.replace("33.2", "33")))


ALONE = "[grid]\nbeamwidth = [33, 11]\n"
WIDE = "expected degrees above 0 and up to 180, the widest beam of a back-baffled piston"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        *(
            (f"[grid]\nbeamwidth = [33, {value}]\n", f"found {found}, {WIDE}; correct the value")
            for value, found in (
                ("0", "0"), ("-3", "-3"), ("181", "181"), ("nan", "nan"), ("inf", "inf"),
                ("true", "True"), ('"wide"', "'wide'"), ("[33]", "[33]"),
            )
        ),
        ("[grid]\nbeamwidth = 33\n", "found 33, expected a list of degrees; write it as [180, 33"),
        ("[grid]\nbeamwidth = []\n", "found [], expected a list of degrees"),
        ("[grid]\nbeamwidth = [33, 33.0]\n", "found 33.0 twice, expected each value once"),
        (
            "[grid]\nbeamwidth = [33, 1e-12]\n",
            "radius of 1e-12: found 288889356953.0, expected less than or equal to",
        ),
        (
            ALONE + '"emitter.radius" = [0.01]\n',
            "is emitter.radius in other words; vary one of them",
        ),
        (ALONE + "[grid.emitter]\nradius = [0.01]\n", "is emitter.radius in other words"),
        (
            ALONE + '"emitter.frequency" = [3e4, 4e4]\n',
            "a beamwidth is no one radius where emitter.frequency varies too; vary emitter.radius",
        ),
        (ALONE + "[grid.air]\ntemperature_c = [0, 20]\n", "a beamwidth is no one radius where air"),
        ('strategies = ["passive"]\n' + ALONE, "the beam is that of the vehicle's call, which"),
    ],
)  # fmt: skip
def test_an_invalid_beamwidth_is_refused_by_name(tmp_path, text, said):
    with pytest.raises(InputError) as refused:
        plan_of(tmp_path, BARE + text)
    assert str(refused.value).startswith(f"{tmp_path / 'small.toml'}: grid.beamwidth: {said}")


def test_temperatures_may_vary_if_the_speed_of_sound_is_set(tmp_path):
    text = ALONE + '"air.temperature_c" = [0.0, 20.0]\n[config]\nair.speed_of_sound = 343.0\n'
    assert len(plan_of(tmp_path, BARE + text).grid["emitter.radius"]) == 2


def test_a_radius_next_to_beamwidths_is_refused(tmp_path):
    beside = "the plan varies this setting as beamwidth; take it out of"
    with pytest.raises(InputError, match=f"^--emitter.radius: {beside}"):
        plan_of(tmp_path, BARE + ALONE, over=from_flags({"emitter": {"radius": 0.01}}))
    with pytest.raises(InputError, match=f"config.emitter.radius: {beside}"):
        plan_of(tmp_path, BARE + ALONE + "[config]\nemitter.radius = 0.01\n")
    with pytest.raises(InputError, match=r"grid\.beamwith: no such setting; did you mean beamwi"):
        plan_of(tmp_path, BARE + "[grid]\nbeamwith = [33]\n")


def test_a_plan_without_beamwidths_is_read_as_ever(tmp_path):
    plain = plan_of(tmp_path, BARE + '[grid]\n"emitter.radius" = [0.0025, 0.025]\n')
    assert plain.grid == {"emitter.radius": (0.0025, 0.025)}
    assert plain.config == Config()
