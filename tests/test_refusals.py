"""What is refused is refused in words that lead back: where, found, expected, the fix."""

import pytest
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipistrelle.refusals import expectation, meant, refusal, values_expected


class Kite(BaseModel):
    model_config = ConfigDict(strict=True)

    length: float = Field(1.0, gt=0)
    wind: tuple[float, float] = Field((0.0, 0.0), strict=False)
    colours: list[str] = Field(["red"], min_length=1)


def fault_of(**kite):
    with pytest.raises(ValidationError) as refused:
        Kite(**kite)
    return refused.value.errors(include_url=False)[0]


def test_a_refusal_contains_where_found_expected_and_fix():
    error = refusal("kite.toml, key 'length'", "-1.0", "greater than 0", "correct the value")
    assert str(error) == (
        "kite.toml, key 'length': found -1.0, expected greater than 0; correct the value"
    )


@pytest.mark.parametrize(
    ("kite", "words"),
    [
        ({"length": -1.0}, "greater than 0"),
        ({"length": "long"}, "a valid number"),
        ({"wind": (1.0, "north")}, "a valid number"),
    ],
)
def test_an_expectation_is_pydantics_without_its_preamble(kite, words):
    assert expectation(fault_of(**kite)) == words


def test_values_are_counted_where_their_number_is_the_fault_and_only_there():
    wind = Kite.model_fields["wind"]
    assert values_expected(fault_of(wind=(1.0,)), wind) == 2
    assert values_expected(fault_of(wind=(1.0, 2.0, 3.0)), wind) == 2
    assert values_expected(fault_of(wind=(1.0, "north")), wind) is None
    assert values_expected({"type": "missing", "loc": ("wind",)}, wind) is None


def test_a_suggestion_has_similar_spelling_or_the_same_ending():
    known = ["rays.exponent", "rays.prune_threshold", "air.pressure_kpa"]
    assert meant("rays.powr", known) == "rays.exponent"
    assert meant("scenario.association.prune_threshold", known) == "rays.prune_threshold"
    assert meant("zzz", known) is None
